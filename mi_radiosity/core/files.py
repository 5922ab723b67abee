"""Output files that are whole or not there."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import RadiosityError


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


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask
