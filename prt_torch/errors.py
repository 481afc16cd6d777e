"""The one exception that a user's mistake raises."""


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one line that names the file or the key, the field and the limit. Command
    lines print it and exit with status 2; library callers may catch it as a ``ValueError``.
    """
