"""The errors a user can cause and mend; each message is one line that says what to do."""
from contextlib import contextmanager


class RadiosityError(ValueError):
    """A scene, an option or a file that cannot be used as it is."""


@contextmanager
def interruptible():
    """Let Ctrl-C out of the body as KeyboardInterrupt: loops of Dr.Jit and imports of extensions wrap it in other errors."""
    try:
        yield
    except Exception as error:
        cause = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            cause = cause.__cause__ or cause.__context__
        raise
