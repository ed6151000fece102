"""Formatting of numbers and of text from users, for screens, reports and files."""

import math
from collections.abc import Sequence
from functools import partial


def plain(text: str) -> str:
    """Replace control and unprintable characters by their escapes in Python.

    A no-break space, which Python does not count as printable, becomes a space.
    """
    text = text.replace(_SPACE, " ")
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


_SPACE = "\u00a0"  # keeps a number and its unit on one line
UNKNOWN = "–"


def percent(share: float) -> str:
    """Write a share as a percentage; only exact values give 100 % and 0 %."""
    if math.isnan(share):
        return UNKNOWN
    value = 100 * share
    if 0 < value < 1:
        return f"<{_SPACE}1{_SPACE}%"
    if 99 < value < 100:
        return f">{_SPACE}99{_SPACE}%"
    return f"{value:.0f}{_SPACE}%"


def two_digits(value: float) -> str:
    """Write a number with about two significant digits and without its unit."""
    if not math.isfinite(value):
        return UNKNOWN if math.isnan(value) else str(value)
    digits = 0 if value >= 100 else max(0, min(5, 1 - math.floor(math.log10(abs(value) or 1))))
    return f"{value:.{digits}f}"


def with_unit(unit: str, value: float) -> str:
    """Write a number with two digits and its unit; unknown and infinite values have no unit."""
    return f"{two_digits(value)}{_SPACE}{unit}" if math.isfinite(value) else two_digits(value)


metres, radians, milliseconds = (partial(with_unit, unit) for unit in ("m", "rad", "ms"))


def ratio(value: float) -> str:
    """Write a ratio of two quantities."""
    if math.isnan(value):
        return UNKNOWN
    return f"{value:.2f}" if value < 10 else f"{value:.0f}"


def number(value: float, layout: str) -> str:
    """Write a number in a format; NaN is unknown."""
    return UNKNOWN if math.isnan(value) else format(value, layout)


def interval(value: float, low: float, high: float, layout: str) -> str:
    """Write a number with its interval, if known, in brackets without units."""
    text = number(value, layout)
    if math.isnan(low) or math.isnan(high) or (math.isinf(low) and math.isinf(high)):
        return text
    to = " to " if layout.startswith("+") else "–"  # signs need room between them
    return f"{text} ({to.join(number(end, layout) for end in (low, high)).replace('%', '')})"


def listed(names: Sequence[str]) -> str:
    """Join names for a sentence: "a, b and c"."""
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else "".join(names)
