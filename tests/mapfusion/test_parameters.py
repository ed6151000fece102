"""Ranges of settings, and the line that an error is."""

import pickle
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

from mapfusion.errors import MOST_CHARACTERS, InputError, OutOfRangeError, did_you_mean, one_line
from mapfusion.parameters import Range, require_in_range

Side = Annotated[float, Range(1, 5, "m")]


@dataclass(frozen=True)
class Made:
    n: Annotated[int, Range(1, 9, "things")] = 3
    sides: tuple[Side, ...] = (1, 2)
    place: tuple[Side, Annotated[float, Range(-1, 0, "rad")]] = (5, -1)
    perhaps: Annotated[float, Range(0, 1, "1")] | None = None
    other: str = ""

    def __post_init__(self) -> None:
        require_in_range(self)


def test_both_ends_and_none_are_allowed() -> None:
    for kept in ({"n": 1}, {"n": 9}, {"sides": (1, 5, 3)}, {"perhaps": None}, {"perhaps": 1}):
        Made(**kept)
    Made(n=np.int64(3), perhaps=np.float64(0.5))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"n": 0}, "n: is 0, must be in [1, 9] things"),
        ({"n": 2.0}, "n: is 2.0, expected an integer"),
        ({"n": True}, "n: is True, expected an integer"),
        ({"n": None}, "n: is None, expected an integer"),
        ({"sides": (1, 5.5)}, "sides.1: is 5.5, must be in [1, 5] m"),
        ({"place": (1, 1)}, "place.1: is 1, must be in [-1, 0] rad"),
        ({"perhaps": float("nan")}, "perhaps: is nan, must be finite and in [0, 1]"),
        ({"perhaps": "x"}, "perhaps: is 'x', expected a number"),
    ],
)
def test_what_lies_outside_is_refused_by_name(given: dict, said: str) -> None:
    with pytest.raises(OutOfRangeError) as told:
        Made(**given)
    assert str(told.value) == said
    assert str(pickle.loads(pickle.dumps(told.value))) == said


def test_an_error_is_one_short_line_whatever_was_put_in() -> None:
    for text in ("a\nb", "x" * 9999, "word " * 999, "\x1b[31m\x00", "\ud800" * 400, "\u202e"):
        line = str(InputError(f"file.yaml: name: {text}: expected less"))
        assert line.startswith("file.yaml: name: ")
        assert line.endswith(": expected less")
        assert len(line) <= MOST_CHARACTERS
        assert line.isprintable()
    assert one_line("as  it\tis") == "as it is"


def test_a_long_line_loses_whole_words_of_its_middle() -> None:
    words = [f"{k}." for k in range(400)]
    line = one_line(" ".join(words))
    first, last = (part.split() for part in line.split(" ... "))
    assert words[: len(first)] == first
    assert words[-len(last) :] == last
    assert len(last) > 20
    assert MOST_CHARACTERS - 10 < len(line) <= MOST_CHARACTERS
    assert one_line("x" * MOST_CHARACTERS + " y").endswith("x y")


def test_names_that_look_alike_are_offered() -> None:
    assert did_you_mean("ransak", ["svd", "ransac"]) == "; did you mean ransac?"
    assert did_you_mean("ipc", ["svd", "icp"]) == "; did you mean icp?"
    assert did_you_mean("magic", ["svd", "ransac"]) == ""
    assert did_you_mean("nope", ["svd", "opencv"]) == ""
