"""Point Dr.Jit at the LLVM that pip installed.

Dr.Jit loads LLVM while it is imported and never looks again, so `choose_llvm` runs before anything
imports ``drjit``.  A library the user chose (``DRJIT_LIBLLVM_PATH``) always wins.
"""

import ctypes
import importlib.metadata
import os
import sys
from pathlib import Path

from .errors import RadiosityError

WHEEL = "karellen-llvm-core"
OLDEST = (17,)


def _files(pattern: str) -> list[str]:
    """Installed files of the LLVM wheel whose name starts with ``pattern``."""
    try:
        files = importlib.metadata.files(WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return sorted(str(Path(f.locate()).resolve()) for f in files if f.name.startswith(pattern))


def choose_llvm() -> None:
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


def problem() -> str | None:
    """One line that says what is wrong with the LLVM Dr.Jit has loaded and what mends it, or None."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        found = "Dr.Jit found no LLVM"
    elif tuple(dr.detail.llvm_version()) < OLDEST:
        found = f"LLVM {'.'.join(map(str, dr.detail.llvm_version()))} is too old for Dr.Jit"
    else:
        return None
    if "DRJIT_LIBLLVM_PATH" in os.environ:
        chosen = os.environ["DRJIT_LIBLLVM_PATH"]
        return (
            f"{found}: DRJIT_LIBLLVM_PATH is {chosen}; set it to the library of LLVM {OLDEST[0]} or newer, or unset it"
        )
    libraries = _files("libLLVM")
    if libraries:
        return f"{found}: import mi_radiosity before mitsuba and drjit, or `export DRJIT_LIBLLVM_PATH={libraries[0]}`"
    return (
        f"{found}: `pip install {WHEEL}` (Linux x86_64), or install LLVM {OLDEST[0]} or newer and set "
        "DRJIT_LIBLLVM_PATH to its library"
    )


def require_variant(variant: str | None = None) -> None:
    """Raise RadiosityError unless a Mitsuba variant, the active one by default, can run here.

    Every public function calls this first; commands call it before they choose a variant, because Dr.Jit's own error
    comes from within `mi.set_variant`.
    """
    import mitsuba as mi

    variant = variant or mi.variant() or "none"
    known = [name for name in mi.variants() if name.startswith(("llvm_", "cuda_")) and name.endswith("_rgb")]
    if variant not in known:
        unknown = variant != "none" and variant not in mi.variants()
        raise RadiosityError(
            (f"unknown variant '{variant}'" if unknown else f"the Mitsuba variant '{variant}' cannot be used")
            + f": choose {' or '.join([name for name in known if not _lacking(name)] or known)} "
            "with mi.set_variant(...) or -m"
        )
    if wrong := _lacking(variant):
        raise RadiosityError(wrong)


def _lacking(variant):
    """One line that says what a variant lacks on this machine and what to do, or None."""
    import drjit as dr

    if variant.startswith("llvm_"):
        return problem()
    if dr.has_backend(dr.JitBackend.CUDA):
        return None
    return (
        f"the Mitsuba variant '{variant}' needs an NVIDIA GPU with its driver, and Dr.Jit found none: "
        "choose llvm_ad_rgb with mi.set_variant(...) or -m"
    )
