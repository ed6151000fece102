"""How tables look, and what commands show while they work and when they are done."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from experiments.show.numbers import UNKNOWN, interval, number

Column = tuple[str, str]  # heading and format


@contextmanager
def progress() -> Iterator[Callable[[str, int, int], None]]:
    """A progress display on stderr; yields the function to tell (label, done, total)."""
    bars: dict[str, TaskID] = {}
    with Progress(
        "{task.description:<26}",
        BarColumn(),
        "{task.completed:.0f}/{task.total:.0f}",
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    ) as display:

        def show(label: str, done: int, total: int) -> None:
            if label not in bars or (done == 0 and display.tasks[bars[label]].finished):
                bars[label] = display.add_task(label, total=total)
            display.update(bars[label], completed=done, total=total)

        yield show


def print_table(
    columns: Collection[Column], rows: Iterable[Sequence[Any]], title: str = "", note: str = ""
) -> None:
    """Print a table, if it has any rows, with a title above and a note below.

    A heading may have two lines; without a format its column is text. A cell is None or NaN where
    nothing is known, (value, low, high) with an interval, or styled text.
    """
    # Plain rules and narrow gaps: all columns must fit into 80 characters.
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading, layout in columns:
        if layout:
            table.add_column(Text(heading), justify="right", no_wrap=True)
        else:  # where the screen is narrow, text gives way before numbers do
            table.add_column(Text(heading), overflow="fold")
    layouts = [layout for _, layout in columns]
    for row in rows:
        table.add_row(*map(_cell, row, layouts))
    if table.row_count:
        console = Console()
        if title:
            console.print(Text(title, "bold"))
        console.print(table)
        if note:
            console.print(Text(f"{note}\n", "dim"))


def columns(layout: str, **headings: str) -> dict[str, Column]:
    """Columns of one format, by their names in a frame."""
    return {name: (heading, layout) for name, heading in headings.items()}


def print_frame(
    frame: pd.DataFrame, shown: Mapping[str, Column], title: str = "", note: str = ""
) -> None:
    """Print columns of a frame by name, with the intervals in their NAME_low and NAME_high."""
    if frame.empty:  # a table that could not be made has no columns either
        return
    cells = [
        frame[[name, f"{name}_low", f"{name}_high"]].itertuples(index=False, name=None)
        if f"{name}_low" in frame
        else frame[name]
        for name in shown
    ]
    print_table(shown.values(), zip(*cells, strict=True), title, note)


def _cell(value: Any, layout: str) -> Text:
    if isinstance(value, Text):
        return value
    if value is None:
        return Text(UNKNOWN)
    if isinstance(value, tuple):
        return Text(interval(*value, layout=layout))
    return Text(number(value, layout) if isinstance(value, float) else format(value, layout))


def print_lines(lines: Iterable[str]) -> None:
    """Print lines as they are, however long."""
    for line in lines:
        Console().print(line, soft_wrap=True, markup=False, highlight=False)


def print_paths(folder: Path, paths: Sequence[Path], skipped: Sequence[str] = ()) -> None:
    """Where files were written."""
    print_lines([f"{len(paths)} written to {folder}"])
    print_skipped(skipped)


def print_skipped(skipped: Sequence[str]) -> None:
    """A line for each figure that could not be drawn."""
    print_lines(f"  not drawn: {line}" for line in skipped)
