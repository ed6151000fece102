"""How tables look, and what commands show while they work and when they are done."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)

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


def number(value: float, layout: str) -> str:
    """A number in a format, or a dash for what is not known."""
    return "-" if math.isnan(value) else format(value, layout)


def print_paths(folder: Path, paths: Sequence[Path], skipped: Sequence[str] = ()) -> None:
    """Where files were written."""
    console = Console()
    console.print(f"{len(paths)} written to {folder}", soft_wrap=True)
    print_skipped(console, skipped)


def print_file(path: Path) -> None:
    """Where a file was written, and how large it is."""
    Console().print(f"{path} ({path.stat().st_size / 1e6:.1f} MB)", soft_wrap=True, markup=False)


def print_skipped(console: Console, skipped: Sequence[str]) -> None:
    """A line for each figure that could not be drawn."""
    for line in skipped:
        console.print(f"  not drawn: {line}", soft_wrap=True)
