"""What `refusal`, `benchmark`, `aligners` and `scenarios` show."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from experiments.methods.catalogue import known_methods, name_clashes
from experiments.show.terminal.layout import LAYOUT, number
from mapfusion.align.result import Status

if TYPE_CHECKING:
    from experiments.scenario.suite import Entry


def print_refusals(rows: Sequence[dict[str, Any]], false_alarms: float) -> None:
    """False and missed merges of each aligner (rows of `refusal_rates`)."""
    headings = {
        "false": "false\nmerges",
        "wrong": "wrong\n",
        "missed": "missed\nof all",
        "missed_though_right": "\nof right",
        "few_missed_though_right": "20 true:\nmissed",
        "few_wrong": "\nwrong",
    }
    table = Table(
        title=f"Accepted where chance gives at most {false_alarms:g} a pair of maps",
        caption="false: accepted without common ground; wrong: accepted with some,\n"
        "0.5 m or 0.1 rad off; missed: refused with 20 or more true pairs, of\n"
        "all and of those right; 20 true: just 20 in one corner are left",
        **LAYOUT,
    )
    table.add_column("\naligner", no_wrap=True)
    for heading in headings.values():
        table.add_column(heading, justify="right", no_wrap=True)
    repeated = {
        name: f"{2 * float(name.removeprefix('poster_')):g} m\nwide"
        for name in rows[0]
        if name.startswith("poster_")
    }
    repeated |= {"posters_false": "posters,\napart", "posters_wrong": "\nin common"}
    repeated = {name: text for name, text in repeated.items() if rows[0][name].n}
    posters = Table(
        title="Accepted though wrong: texture that repeats",
        caption="wide: one such picture in two worlds; posters: few pictures all over\n"
        "a world, without and with common ground",
        **LAYOUT,
    )
    posters.add_column("\naligner", no_wrap=True)
    for heading in repeated.values():
        posters.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(row["aligner"], *(_of_all(row[name]) for name in headings))
        posters.add_row(row["aligner"], *(_of_all(row[name]) for name in repeated))
    console = Console()
    console.print(table)
    console.print(posters)


def _of_all(rate: Any) -> str:
    return f"{rate.hits}/{rate.n}"


def print_benchmark(folder: Path, summary: pd.DataFrame) -> None:
    """Successes and times for each number of pairs, and where the rest is."""
    console = Console()
    for n_pairs, rows in summary.groupby("n_pairs", sort=False):
        table = Table(title=f"{n_pairs} pairs: success in %, time in ms", **LAYOUT)
        table.add_column("outliers", no_wrap=True)
        for share in rows["outlier_share"].drop_duplicates():
            table.add_column(f"{100 * share:g} %", justify="right", no_wrap=True)
        for method, own in rows.groupby("method", sort=False):
            cells = [
                "absent"
                if row["status"] == Status.ABSENT
                else f"{100 * row['success']:.0f}, {_milliseconds(row['elapsed_s'])}"
                for row in own.to_dict("records")
            ]
            table.add_row(escape(str(method)), *cells)
        console.print(table)
    failed = summary[summary["n_failed"] > 0]
    for method, rows in failed.groupby("method", sort=False):
        text = f"  {method}: failed in {rows['n_failed'].sum()} trials, see trials.parquet"
        console.print(text, soft_wrap=True, markup=False)
    console.print(f"Table and figure: {folder}", soft_wrap=True)


def _milliseconds(elapsed_s: float) -> str:
    """Two digits or all before the point: 0.23, 4.6, 31, 1710."""
    elapsed_ms = 1e3 * elapsed_s
    return number(elapsed_ms, ".0f" if elapsed_ms >= 10 else ".2g")


def print_methods() -> None:
    """Every alignment method by name, whose it is, and what is wrong where something is."""
    table = Table(title="Alignment methods", **LAYOUT)
    for heading in ("method", "whose", "package", "version"):
        table.add_column(heading)
    methods = known_methods().values()
    for method in methods:
        version = "absent" if method.absence else method.version
        cells = (method.name, method.kind, method.distribution, version)
        table.add_row(*(escape(cell) for cell in cells))
    console = Console()
    console.print(table)
    lines = [f"{method.name}: {method.absence}" for method in methods if method.absence]
    for line in [*lines, *name_clashes().values()]:
        console.print(f"  {line}", soft_wrap=True, markup=False)


def print_scenarios(entries: "Sequence[Entry]") -> None:
    """The scenarios of a folder."""
    table = Table(**LAYOUT)
    for title in ("scenario", "tags"):
        table.add_column(title, overflow="fold")
    for title in ("robots", "iterations", "overlap"):
        table.add_column(title, justify="right")
    table.add_column("what it is", ratio=1)
    for entry in entries:
        table.add_row(
            escape(entry.name),
            escape(" ".join(entry.tags)),
            str(entry.robots),
            "recorded" if entry.iterations is None else str(entry.iterations),
            "" if entry.overlap is None else f"{entry.overlap:.2f}",
            escape(entry.description),
        )
    Console().print(table)
