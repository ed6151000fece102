"""Text of numbers; tables, lines, progress displays and listings on the terminal.

All output goes through `_console`, which interprets no markup: texts may come from users.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from mapfusion.errors import InputError, did_you_mean

if TYPE_CHECKING:  # listings without data frames skip this slow import
    import pandas as pd

Column = tuple[str, str]  # heading and format
MANUAL = Path(__file__).parents[1] / "docs"  # folder of the manual's pages
_WHOLE_WORD = 20  # characters; names of methods are not folded
_LEAST_TEXT = 8  # characters of a column of text: folded names stay legible
NO_ESTIMATE = "given: share with an estimate; without one the error is infinite"
_GAP = 2  # characters between columns
_SPACE = "\u00a0"  # keeps a number and its unit on one line
UNKNOWN = "–"


OnProgress = Callable[[str, int, int], None]
_LINE_EVERY_S = 30.0  # between lines of progress in a log file


def plain(text: str) -> str:
    """Replace control and unprintable characters by their escapes in Python.

    A no-break space, which Python does not count as printable, becomes a space.
    """
    text = text.replace(_SPACE, " ")
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


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


def _console(stderr: bool = False) -> Console:
    """Return a console that interprets no styles, links or emoji, and cuts no line."""
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=True)


@contextmanager
def progress(quiet: bool = False) -> Iterator[OnProgress]:
    """Show progress on stderr; yield the function to call with (label, done, total).

    A terminal gets bars. Other outputs get a line at the start and at the end of each task, and
    every `_LINE_EVERY_S` seconds between. A quiet one shows nothing.
    """
    console = _console(stderr=True)
    if quiet:
        yield lambda label, done, total: None
        return
    if not console.is_terminal:
        printed: dict[str, tuple[int, float]] = {}  # number done and time of the last line

        def print_line(label: str, done: int, total: int) -> None:
            now_s = time.monotonic()
            last, at_s = printed.get(label, (-1, -_LINE_EVERY_S))
            if done != last and (done in (0, total) or now_s - at_s >= _LINE_EVERY_S):
                console.print(Text(plain(f"{label}: {done}/{total}")))
                printed[label] = done, now_s

        yield print_line
        return
    bars: dict[str, TaskID] = {}
    with Progress(
        TextColumn("{task.description:<26}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
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

    A heading may have two lines. A column without a format is text. A cell is a value, None or NaN
    if it is unknown, (value, low, high) with an interval, or styled text. On a narrow screen text
    is folded and numbers are not; a table that is still too wide exceeds the screen.
    """
    layouts = [layout for _, layout in columns]
    cells = [[*map(_cell, row, layouts)] for row in rows]
    if not cells:
        return
    # Plain rules and narrow gaps: all columns should fit into 80 characters.
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    needed = wanted = least = 0
    for place, (heading, layout) in enumerate(columns):
        shown = Text(plain(heading))
        widest = max(*map(len, heading.split("\n")), *(row[place].cell_len for row in cells))
        if layout:
            table.add_column(shown, justify="right", no_wrap=True, min_width=widest)
        else:
            words = [word for row in cells for word in row[place].plain.split()]
            least = max([_LEAST_TEXT, *(len(word) for word in words if len(word) <= _WHOLE_WORD)])
            table.add_column(shown, overflow="fold", min_width=min(least, widest))
        needed += (widest if layout else min(widest, least)) + 1
        wanted += widest + _GAP
    for row in cells:
        table.add_row(*row)
    console = _console()
    if wanted > console.width:
        table.padding = 0
    console.width = max(console.width, needed)
    if title:
        console.print(Text(plain(title), "bold"))
    console.print(table)
    console.print(Text(f"{plain(note)}\n" if note else "", "dim"), soft_wrap=False)


def columns(layout: str, **headings: str) -> dict[str, Column]:
    """Return columns of one format, by their names in a data frame."""
    return {name: (heading, layout) for name, heading in headings.items()}


def print_frame(
    frame: pd.DataFrame, shown: Mapping[str, Column], title: str = "", note: str = ""
) -> None:
    """Print columns of a data frame by name, with intervals from NAME_low and NAME_high."""
    if frame.empty:  # without rows there may be no columns
        return
    cells = [
        frame[[name, f"{name}_low", f"{name}_high"]].itertuples(index=False, name=None)
        if f"{name}_low" in frame
        else frame[name]
        for name in shown
    ]
    print_table(shown.values(), zip(*cells, strict=True), title, note)


def _cell(value: Any, layout: str) -> Text:
    """Return the text of a cell."""
    if isinstance(value, Text):
        return value
    if value is None:
        return Text(UNKNOWN)
    if isinstance(value, tuple):
        return Text(interval(*value, layout=layout))
    text = number(value, layout) if isinstance(value, float) else format(value, layout)
    return Text(plain(text))


def print_lines(lines: Iterable[str]) -> None:
    """Print lines without folding them."""
    console = _console()
    for line in lines:
        console.print(Text(plain(line)))


def print_paths(folder: Path, paths: Sequence[Path], skipped: Sequence[str] = ()) -> None:
    """Print the number of files, their folder, and figures that were not drawn."""
    print_lines([f"{len(paths)} written to {folder}"])
    print_skipped(skipped)


def print_skipped(skipped: Sequence[str]) -> None:
    """Print a line for each figure that could not be drawn."""
    print_lines(f"  not drawn: {line}" for line in skipped)


def print_methods() -> None:
    """Print every aligner by name with kind, package and version, and reasons of absence.

    Aligners are the alignment methods, and the methods with parameters of the default list.
    """
    from experiments.plugins.discovery import known_methods, name_clashes
    from experiments.scenario.settings import DEFAULT_ALIGNERS

    methods = known_methods()
    rows = [
        (each.name, str(each.kind), each.distribution, "absent" if each.absence else each.version)
        for each in methods.values()
    ]
    for entry in DEFAULT_ALIGNERS:
        if entry.name not in methods:
            given = ", ".join(f"{key}: {value}" for key, value in entry.parameters.items())
            rows.append((entry.name, f"{entry.method} with {given}", "", ""))
    headings = ("aligner", "kind", "package", "version")
    print_table([(heading, "") for heading in headings], rows, "Aligners")
    absent = [f"{each.name}: {each.absence}" for each in methods.values() if each.absence]
    print_lines(f"  {line}" for line in (*absent, *name_clashes().values()))


def print_pages() -> None:
    """Print the names and titles of the manual's pages, and their folder."""
    titles = [
        (page.stem, page.open(encoding="utf-8").readline().strip("# \n")) for page in _pages()
    ]
    print_table([("page", ""), ("title", "")], titles)
    print_lines(["`mapfusion docs PAGE` shows a page.", f"The pages are in {MANUAL}."])


def print_page(name: str) -> None:
    """Print a page of the manual: formatted on a terminal, else as it is.

    Raises:
        InputError: no page has this name.
    """
    from rich.markdown import Markdown

    page = MANUAL / f"{name.removesuffix('.md')}.md"
    if page not in _pages():
        known = [each.stem for each in _pages()]
        unknown = f"docs {name}: no such page, known are {', '.join(known)}"
        raise InputError(unknown + did_you_mean(name, known))
    text, console = page.read_text(encoding="utf-8"), _console()
    if console.is_terminal:
        console.print(Markdown(text), soft_wrap=False)
    else:
        console.print(Text(text.rstrip("\n")))


def _pages() -> list[Path]:
    return sorted(page for page in MANUAL.glob("*.md") if page.stem != "index")  # the site's


def print_scenarios(entries: Sequence[dict[str, Any]]) -> None:
    """Print the scenarios of a folder."""
    shown = [("scenario", ""), ("tags", ""), ("robots", "g"), ("iterations", ">")]
    shown += [("overlap", ".2f"), ("description", "")]
    rows = [
        (
            each["name"],
            " ".join(each["tags"]),
            each["robots"],
            "recorded" if each["recorded"] else each["iterations"],
            each["overlap"],
            each["description"],
        )
        for each in entries
    ]
    print_table(shown, rows)
