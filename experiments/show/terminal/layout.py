"""How tables look, and what commands show while they work and when they are done."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

# Plain rules and narrow gaps: all columns must fit into 80 characters.
LAYOUT: Any = {
    "box": box.SIMPLE_HEAD,
    "padding": (0, 1, 0, 0),
    "title_style": "bold",
    "title_justify": "left",
    "caption_justify": "left",
}


@contextmanager
def progress(*more: ProgressColumn) -> Iterator[Callable[[str, int, int], None]]:
    """A progress display on stderr; yields the function to tell (label, done, total)."""
    display = Progress(
        TextColumn("{task.description:<26}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        *more,
        console=Console(stderr=True),
    )
    bars: dict[str, Any] = {}
    with display:

        def show(label: str, done: int, total: int) -> None:
            if label not in bars or (done == 0 and bars[label][1]):
                bars[label] = [display.add_task(label, total=total), False]
            bar, _ = bars[label]
            display.update(bar, completed=done, total=total)
            bars[label][1] = done == total

        yield show


def print_table(
    columns: Sequence[tuple[str, str]],
    rows: Iterable[Sequence[Any]],
    title: str = "",
    note: str = "",
) -> None:
    """Print a table of text and numbers.

    Args:
        columns: heading, which may have two lines, and format; without one, text to the left.
        rows: their cells; what is not known is None or NaN. Styled text is taken as it is.
        title: above.
        note: below.
    """
    table = Table(title=title or None, caption=note or None, **LAYOUT)
    for heading, layout in columns:
        if layout:
            table.add_column(heading, justify="right", no_wrap=True)
        else:  # where the screen is narrow, text gives way before numbers do
            table.add_column(heading, overflow="fold")
    for row in rows:
        cells = zip(row, columns, strict=True)
        table.add_row(*(_cell(value, layout) for value, (_, layout) in cells))
    Console().print(table)


def _cell(value: Any, layout: str) -> str | Text:
    if isinstance(value, Text):
        return value
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return escape(format(value, layout))


def number(value: float, layout: str) -> str:
    """A number in a format, or a dash for what is not known."""
    return "-" if math.isnan(value) else format(value, layout)


def milliseconds(elapsed_s: float) -> str:
    """Two digits or all before the point: 0.23, 4.6, 31, 1710."""
    elapsed_ms = 1e3 * elapsed_s
    return number(elapsed_ms, ".0f" if elapsed_ms >= 10 else ".2g")


def print_lines(lines: Iterable[str]) -> None:
    """Print lines as they are, however long."""
    for line in lines:
        Console().print(line, soft_wrap=True, markup=False, highlight=False)


def print_paths(folder: Path, paths: Sequence[Path], skipped: Sequence[str] = ()) -> None:
    """Where files were written."""
    print_lines([f"{len(paths)} written to {folder}"])
    print_skipped(skipped)


def print_file(path: Path) -> None:
    """Where a file was written, and how large it is."""
    print_lines([f"{path} ({path.stat().st_size / 1e6:.1f} MB)"])


def print_skipped(skipped: Sequence[str]) -> None:
    """A line for each figure that could not be drawn."""
    print_lines(f"  not drawn: {line}" for line in skipped)
