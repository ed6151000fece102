"""Errors and warnings with one-line messages for users."""

import difflib
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

MOST_CHARACTERS = 500  # of a message: enough for the longest one with two long paths
_MAX_WORD = 120  # characters of a word, usually a path
_GAP = "..."
_MAX_SUGGESTIONS = 3  # names in one message
# Smallest similarity ratio of `difflib` for a suggestion. Swapped letters in a word of three (ipc,
# icp) have the ratio 2/3; different words with some common letters (nope, opencv) have 0.6.
_MIN_SIMILARITY = 0.65


class InputError(ValueError):
    """Unusable input of a user.

    The message is one line that names the file, the field and the remedy.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class InputErrors(InputError):  # noqa: N818  # several errors
    """Several unusable inputs of a user; the message has one line for each of `lines`."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(one_line(line) for line in lines)
        super().__init__(*self.lines)

    def __str__(self) -> str:
        return "\n".join(self.lines)


class OutOfRangeError(InputError):
    """Setting with a value outside its range.

    Attributes:
        name: name of the setting.
        problem: description of the problem.
        also: name and problem of each further setting of the same class.
    """

    def __init__(self, name: str, problem: str, also: Iterable[tuple[str, str]] = ()) -> None:
        super().__init__(name, problem)
        self.name, self.problem, self.also = name, problem, tuple(also)

    def __str__(self) -> str:
        return one_line(f"{self.name}: {self.problem}")


class DamagedFileError(InputError):
    """File at `path` that is missing or damaged."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(path, reason)
        self.path = path

    def __str__(self) -> str:
        return f"{self.path}: {self.args[1]}"


class TellingWarning(UserWarning):
    """Warning with a one-line message for users; commands print the message unchanged."""


class StoreRepairWarning(TellingWarning):
    """Warning that a damaged stage of the store is computed again."""


class NameClashWarning(TellingWarning):
    """Warning that two methods have the same name; the message tells which one is used."""


def did_you_mean(wrong: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: similar known names, or nothing."""
    like = difflib.get_close_matches(wrong, list(known), _MAX_SUGGESTIONS, _MIN_SIMILARITY)
    return f"; did you mean {' or '.join(like)}?" if like else ""


def one_line(text: str) -> str:
    """Return the text as one line of printable characters, and omit its middle if it is too long.

    Long words are shortened first, so that a long value does not displace the rest of the message.
    Then whole words are omitted.
    """
    escaped = "".join(
        c if c.isprintable() or c.isspace() else c.encode("unicode_escape").decode() for c in text
    )
    words = [_shortened(word) for word in escaped.split()]
    line = " ".join(words)
    if len(line) <= MOST_CHARACTERS:
        return line
    last = _first_of(words[::-1], MOST_CHARACTERS // 3)[::-1]
    room = MOST_CHARACTERS - len(_GAP) - 2 - len(" ".join(last))
    return " ".join([*_first_of(words, room), _GAP, *last])


def _first_of(words: Sequence[str], most: int) -> list[str]:
    """Return as many of the first words as fit into `most` characters, with blanks between."""
    ends = itertools.accumulate(len(word) + 1 for word in words)
    return [word for word, end in zip(words, ends, strict=True) if end - 1 <= most]


def _shortened(word: str) -> str:
    """Return the beginning and the end of a word that is too long."""
    if len(word) <= _MAX_WORD:
        return word
    first = 2 * _MAX_WORD // 3
    return word[:first] + _GAP + word[len(word) - _MAX_WORD + first + len(_GAP) :]
