"""Text files of recordings: rows of numbers and times. Errors name file and line."""

from collections.abc import Iterator, Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float

NS = 1_000_000_000  # nanoseconds in a second
_LATEST_NS = 2**62  # the year 2116, from 1970; the sum of two times fits 64 bits
_MAX_VALUE = 1e12  # of any number
# Pose formats by their number of columns, which are often confused.
POSES = {8: "TUM's poses have 8", 12: "KITTI's poses have 12", 17: "EuRoC's true states have 17"}
_SEPARATORS = {",": "commas", ";": "semicolons", None: "spaces"}


def read_rows(
    path: Path, what: str, separator: str | None = None
) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and words of each line that is neither empty nor a comment (#).

    Args:
        path: text file.
        what: contents of the file, for messages.
        separator: separator of the words; None for white space.

    Raises:
        InputError: the file is missing or no text file.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file ({what})") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable text file ({what})") from error
    for number, line in enumerate(text.splitlines(), start=1):
        words = [word.strip() for word in line.split(separator)]
        if any(words) and not words[0].startswith("#"):
            yield number, words


def require_columns(
    path: Path,
    line: int,
    words: list[str],
    columns: str,
    formats: Mapping[int, str] | None = None,
    more: bool = False,
) -> None:
    """Raise InputError if a line has a wrong number of columns.

    Args:
        path: text file, for messages.
        line: line number, for messages.
        words: all words of the line.
        columns: names of the columns, separated by spaces.
        formats: hints at other formats by their number of columns.
        more: further columns may follow.
    """
    n, wanted = len(words), len(columns.split())
    if n == wanted or (more and n > wanted):
        return
    other = f"; {formats[n]}" if formats and n in formats else ""
    for separator, named in _SEPARATORS.items():
        parts = " ".join(words).split(separator)
        if n < wanted <= len(parts) and (more or len(parts) == wanted):
            other = f"; its columns are separated by {named}"
    least = " or more" if more else ""
    raise InputError(
        f"{path}, line {line}: has {n} columns, expected {wanted}{least} ({columns}){other}"
    )


def parse_numbers(path: Path, line: int, words: list[str]) -> list[float]:
    """Parse the numbers of a line; raise InputError for other words or huge numbers."""
    try:
        found = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{path}, line {line}: not a number in {' '.join(words)!r}") from None
    if not all(abs(each) <= _MAX_VALUE for each in found):  # NaN is not
        raise InputError(f"{path}, line {line}: not finite, or above {_MAX_VALUE:g}")
    return found


def parse_time_ns(path: Path, line: int, word: str, unit_ns: int) -> int:
    """Parse a time in units of `unit_ns` nanoseconds; return nanoseconds or raise InputError."""
    try:
        exact = Decimal(word) * unit_ns
        time_ns = int(exact.to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise InputError(f"{path}, line {line}: {word!r} is no time") from None
    if abs(time_ns) > _LATEST_NS:
        raise InputError(f"{path}, line {line}: {word} is beyond all clocks; another unit?")
    if unit_ns == 1 and exact != time_ns:
        reason = "must be a whole number of nanoseconds; is it in seconds or another unit?"
        raise InputError(f"{path}, line {line}: time {word} {reason}")
    return time_ns


def require_increasing(path: Path, lines: list[int], time_ns: np.ndarray) -> None:
    """Raise InputError for the first line whose time does not increase."""
    wrong = np.flatnonzero(np.diff(time_ns) <= 0)
    if len(wrong):
        k = int(wrong[0]) + 1
        step_s = (int(time_ns[k]) - int(time_ns[k - 1])) / NS
        back = "repeats the time before" if step_s == 0 else f"runs back by {-step_s:g} s"
        unit = "; are they rounded, or in another unit?" if step_s == 0 else ""
        raise InputError(f"{path}, line {lines[k]}: {back}; times must increase{unit}")


def read_time_series(
    path: Path,
    what: str,
    columns: str,
    unit_ns: int,
    separator: str | None = None,
    formats: Mapping[int, str] | None = None,
    more: bool = False,
) -> tuple[np.ndarray, Float]:
    """Read a table of times and numbers; the times must increase.

    Args:
        path: text file.
        what: contents of the file, for messages.
        columns: names of the columns, separated by spaces; the first one is the time.
        unit_ns: unit of the time in nanoseconds.
        separator: separator of the columns; None for white space.
        formats: hints at other formats by their number of columns.
        more: further columns may follow, which are ignored.

    Returns:
        Times in ns, shape (N,), int64, and the other columns, shape (N, n).

    Raises:
        InputError: the file is missing or damaged; the message names file and line.
    """
    wanted = len(columns.split())
    lines, times, values = [], [], []
    for line, words in read_rows(path, what, separator):
        require_columns(path, line, words, columns, formats, more)
        lines.append(line)
        times.append(parse_time_ns(path, line, words[0], unit_ns))
        values.append(parse_numbers(path, line, words[1:wanted]))
    time_ns = np.array(times, dtype=np.int64)
    require_increasing(path, lines, time_ns)
    return time_ns, np.array(values, dtype=np.float64).reshape(-1, wanted - 1)
