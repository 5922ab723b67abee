"""Output files that are whole or not there."""

import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import RadiosityError

MARKED = 2048  # bytes at the beginning of a file that its mark is looked for in


@contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[str]:
    """Yield a temporary path beside ``path`` that takes its place if the body succeeds.

    Raises RadiosityError, naming the file, if it cannot be written.
    """
    path = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
        os.close(handle)
    except OSError as error:
        raise RadiosityError(f"cannot write {path} ({error.strerror}): choose another place") from None
    try:
        yield temporary
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        raise RadiosityError(f"cannot write {path} ({error.strerror or error}): choose another place") from None
    finally:
        if os.path.exists(temporary):
            os.unlink(temporary)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise RadiosityError now if ``path`` could not be written later."""
    path = Path(path)
    if path.is_dir():
        raise RadiosityError(f"cannot write {path}: it is a folder")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        why = "may not be written to" if path.parent.is_dir() else "does not exist"
        raise RadiosityError(f"cannot write {path}: the folder {path.parent} {why}")


def check_outputs(
    outputs: Iterable[str | os.PathLike[str] | None], inputs: Iterable[str | os.PathLike[str] | None] = ()
) -> None:
    """Raise RadiosityError now if files could not be written later, if two of them are one, or if one is an input."""
    taken = [Path(path) for path in inputs if path is not None]
    kept = len(taken)
    for path in (Path(path) for path in outputs if path is not None):
        check_writable(path)
        if any(same_file(path, other) for other in taken[:kept]):
            raise RadiosityError(f"cannot write {path}: it is read by this command; choose another name")
        if any(same_file(path, other) for other in taken[kept:]):
            raise RadiosityError(f"cannot write {path} twice: give every file a name of its own")
        taken.append(path)


def check_side_file(path: str | os.PathLike[str], mark: bytes, main: Path) -> None:
    """Raise RadiosityError if ``path``, which goes beside ``main``, cannot be written, or is a file without ``mark``.

    An earlier run has left the mark in the file that it wrote beside ``main``; any other file is not to be overwritten.
    """
    path = Path(path)
    check_writable(path)
    try:
        with open(path, "rb") as file:
            known = mark in file.read(MARKED)
    except FileNotFoundError:
        return
    except OSError as error:
        raise RadiosityError(
            f"cannot read {path} ({error.strerror}), which {main} needs: choose another name"
        ) from None
    if not known:
        raise RadiosityError(f"{path} goes beside {main.name}, and is another file: move it, or choose another name")


def same_file(a: Path, b: Path) -> bool:
    """Do two paths name one file, which need not exist?"""
    return a.resolve() == b.resolve()


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask
