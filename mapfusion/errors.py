"""The one error a person is meant to read, and what they are warned of."""

from pathlib import Path


class InputError(ValueError):
    """Something a user gave is unusable.

    Its text is one line that names the file, the field and what would be right.
    """


class DamagedFileError(InputError):
    """A file is missing or not as it was written. `path`: which."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(path, reason)
        self.path = path

    def __str__(self) -> str:
        return f"{self.path}: {self.args[1]}"


class TellingWarning(UserWarning):
    """Something a user should know, in one line; the command shows it as it is."""


class UnsealedWarning(TellingWarning):
    """A file carries no digest of itself."""


class MendedWarning(TellingWarning):
    """A damaged stage of the store is made again."""


class NameClashWarning(TellingWarning):
    """Two methods claim one name; the text says in one line which of them has it."""
