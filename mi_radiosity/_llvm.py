"""Point Dr.Jit at the LLVM that pip installed.

Dr.Jit loads LLVM while it is imported and never looks again, so this runs before anything
imports ``drjit``.  A library the user chose (``DRJIT_LIBLLVM_PATH``) always wins.
"""
import ctypes
import importlib.metadata
import os
import sys

WHEEL = "karellen-llvm-core"
OLDEST = (17,)


def _files(pattern):
    """Installed files of the LLVM wheel whose name starts with ``pattern``."""
    try:
        files = importlib.metadata.files(WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return sorted(str(f.locate().resolve()) for f in files if f.name.startswith(pattern))


def choose_llvm():
    """Set ``DRJIT_LIBLLVM_PATH`` to the wheel's libLLVM unless a choice was already made."""
    if "drjit" in sys.modules or "DRJIT_LIBLLVM_PATH" in os.environ:
        return
    libraries = _files("libLLVM")
    if not libraries:
        return
    # The wheel links its C++ runtime only at the next interpreter start: load it by hand until then.
    # Locally: a global libc++abi would take over Mitsuba's exceptions, and its errors would abort.
    for name in ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1"):
        for path in _files(name)[:1]:
            try:
                ctypes.CDLL(path, mode=ctypes.RTLD_LOCAL)
            except OSError:
                pass
    os.environ["DRJIT_LIBLLVM_PATH"] = libraries[0]


def problem():
    """One line that says what is wrong with the LLVM Dr.Jit has loaded, or None."""
    import drjit as dr
    if not dr.has_backend(dr.JitBackend.LLVM):
        return (f"Dr.Jit found no LLVM: `pip install {WHEEL}` (Linux x86_64), or install LLVM 17 or "
                "newer and set DRJIT_LIBLLVM_PATH to its library")
    if tuple(dr.detail.llvm_version()) < OLDEST:
        version = ".".join(map(str, dr.detail.llvm_version()))
        return (f"LLVM {version} is too old for Dr.Jit: set DRJIT_LIBLLVM_PATH to the library of "
                "LLVM 17 or newer")
    return None
