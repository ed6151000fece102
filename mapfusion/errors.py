"""The one error a person is meant to read."""


class InputError(ValueError):
    """Something a user gave is unusable.

    Its text is one line that names the file, the field and what would be right.
    """


class NameClashWarning(UserWarning):
    """Two methods claim one name; the text says in one line which of them has it."""
