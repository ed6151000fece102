"""The one error a person is meant to read, and what they are warned of."""

import difflib
from collections.abc import Iterable
from pathlib import Path

MOST_CHARACTERS = 300  # of a line that a person reads at one glance
_MOST_OF_A_WORD = 120  # a path, as a rule
_GAP = " ... "
_MOST_SUGGESTED = 3  # names; more are no help


class InputError(ValueError):
    """Something a user gave is unusable.

    Its text is one line that names the file, the field and what would be right.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class InputErrors(InputError):  # noqa: N818  # several of them
    """Several things a user gave are unusable; the text has one line for each of `lines`."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(one_line(line) for line in lines)
        super().__init__(*self.lines)

    def __str__(self) -> str:
        return "\n".join(self.lines)


class OutOfRangeError(InputError):
    """A setting that cannot have its value: its `name`, and the `problem`.

    `also` holds the name and problem of each further setting of the same class.
    """

    def __init__(self, name: str, problem: str, also: Iterable[tuple[str, str]] = ()) -> None:
        super().__init__(name, problem)
        self.name, self.problem, self.also = name, problem, tuple(also)

    def __str__(self) -> str:
        return one_line(f"{self.name}: {self.problem}")


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


def did_you_mean(wrong: str, known: Iterable[str]) -> str:
    """The end of a line about an unknown name: those of the known ones that look like it."""
    like = difflib.get_close_matches(wrong, list(known), _MOST_SUGGESTED)
    return f"; did you mean {' or '.join(like)}?" if like else ""


def one_line(text: str) -> str:
    """The text as one line of printable characters, cut in the middle where it is too long.

    Long words are cut first, so that what was put in does not push out what is said about it.
    """
    words = (_cut(_printable(word), _MOST_OF_A_WORD, "...") for word in text.split())
    return _cut(" ".join(words), MOST_CHARACTERS, _GAP)


def _printable(word: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in word)


def _cut(text: str, most: int, gap: str) -> str:
    """The first two thirds and the end of what is too long."""
    if len(text) <= most:
        return text
    first = 2 * most // 3
    return text[:first] + gap + text[len(text) - most + first + len(gap) :]
