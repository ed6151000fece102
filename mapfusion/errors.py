"""The one error a person is meant to read."""

MOST_CHARACTERS = 300  # of a line that a person reads at one glance
_MOST_OF_A_WORD = 120  # a path, as a rule
_GAP = " ... "


class InputError(ValueError):
    """Something a user gave is unusable.

    Its text is one line that names the file, the field and what would be right.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class OutOfRangeError(InputError):
    """A setting that cannot have its value: its `name`, and the `problem`."""

    def __init__(self, name: str, problem: str) -> None:
        super().__init__(name, problem)
        self.name, self.problem = name, problem

    def __str__(self) -> str:
        return one_line(f"{self.name}: {self.problem}")


class NameClashWarning(UserWarning):
    """Two methods claim one name; the text says in one line which of them has it."""


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
