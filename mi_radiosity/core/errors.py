"""The errors a user can cause and mend; each message is one line that says what to do."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class RadiosityError(ValueError):
    """A scene, an option or a file that cannot be used as it is."""


class RadiosityWarning(UserWarning):
    """Something of a scene that a result does not hold; one line that names the shape, sensor or option."""


def warn_of(message: str) -> None:
    """Issue a RadiosityWarning; commands print it on standard error."""
    warnings.warn(message, RadiosityWarning, stacklevel=3)


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C out of the body as KeyboardInterrupt.

    Loops of Dr.Jit and imports of extensions wrap it in other errors.
    """
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            cause = cause.__cause__ or cause.__context__
        raise
