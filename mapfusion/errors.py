"""Errors and warnings that a user reads."""

import difflib
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

MOST_CHARACTERS = 500  # of a line: our longest messages fit, with two long paths in them
_MOST_OF_A_WORD = 120  # a path, as a rule
_GAP = "..."
_MOST_SUGGESTED = 3  # names; more are no help
# Share of letters in common, as `difflib` counts them, of names that are alike: two letters of
# three changed places (ipc, icp) give 2/3; words that only share some letters (nope, opencv) 0.6.
_LEAST_ALIKE = 0.65


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


class StoreRepairWarning(TellingWarning):
    """A damaged stage of the store is made again."""


class NameClashWarning(TellingWarning):
    """Two methods claim one name; the text says in one line which of them has it."""


def did_you_mean(wrong: str, known: Iterable[str]) -> str:
    """The end of a line about an unknown name: those of the known ones that look like it."""
    like = difflib.get_close_matches(wrong, list(known), _MOST_SUGGESTED, _LEAST_ALIKE)
    return f"; did you mean {' or '.join(like)}?" if like else ""


def one_line(text: str) -> str:
    """Return the text as one line of printable characters, without its middle if it is too long.

    Long words are shortened first, so that a quoted value does not displace what is said about it.
    What is left out of the line are whole words.
    """
    words = [_shortened(_printable(word)) for word in text.split()]
    line = " ".join(words)
    if len(line) <= MOST_CHARACTERS:
        return line
    last = _first_of(words[::-1], MOST_CHARACTERS // 3)[::-1]
    room = MOST_CHARACTERS - len(_GAP) - 2 - len(" ".join(last))
    return " ".join([*_first_of(words, room), _GAP, *last])


def _first_of(words: Sequence[str], most: int) -> list[str]:
    """Return the first of the words that take at most so many characters, with blanks between."""
    ends = itertools.accumulate(len(word) + 1 for word in words)
    return [word for word, end in zip(words, ends, strict=True) if end - 1 <= most]


def _printable(word: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in word)


def _shortened(word: str) -> str:
    """Return the first two thirds and the end of a word that is too long."""
    if len(word) <= _MOST_OF_A_WORD:
        return word
    first = 2 * _MOST_OF_A_WORD // 3
    return word[:first] + _GAP + word[len(word) - _MOST_OF_A_WORD + first + len(_GAP) :]
