"""The errors a user can cause and mend; each message is one line that says what to do."""


class RadiosityError(ValueError):
    """A scene, an option or a file that cannot be used as it is."""
