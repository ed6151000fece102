"""An order of robots that does not depend on which was named first: that of their names."""

import re
from itertools import zip_longest
from typing import Any

_DIGITS = re.compile("([0-9]+)")


def name_order(name: str) -> tuple[list[Any], str]:
    """A sorting key of names, in which R2 stands before R10."""
    parts = _DIGITS.split(name)  # words and numbers in turn, a word first
    numbers = [(len(digits), digits) for digits in (part.lstrip("0") for part in parts[1::2])]
    return [
        key for both in zip_longest(parts[::2], numbers) for key in both if key is not None
    ], name
