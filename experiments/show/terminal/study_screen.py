"""What the commands `study ...` and `scenarios` show."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.methods.catalogue import known_methods, name_clashes
from experiments.show.independence_files import SHOWN, shown_numbers
from experiments.show.numbers import two_digits
from experiments.show.terminal.layout import (
    columns,
    print_frame,
    print_lines,
    print_skipped,
    print_table,
)
from experiments.study.independence.strategies import STRATEGIES
from mapfusion.align.result import Status


def print_benchmark(folder: Path, summary: pd.DataFrame) -> None:
    """Successes and times for each number of pairs, and where the rest is."""
    for n_pairs, rows in summary.groupby("n_pairs", sort=False):
        shares = rows["outlier_share"].drop_duplicates()
        shown = [("outliers", ""), *((f"{100 * share:g} %", ">") for share in shares)]
        cells = [
            [method, *(_benchmark_cell(row) for row in own.to_dict("records"))]
            for method, own in rows.groupby("method", sort=False)
        ]
        print_table(shown, cells, f"{n_pairs} pairs: success in %, time in ms")
    failed = summary.groupby("method", sort=False)["n_failed"].sum()
    print_lines(
        f"  {method}: failed in {n} trials, see trials.parquet"
        for method, n in failed[failed > 0].items()
    )
    print_lines([f"Table and figure: {folder}"])


def _benchmark_cell(row: dict[Any, Any]) -> str:
    if row["status"] == Status.ABSENT:
        return "absent"
    return f"{100 * row['success']:.0f}, {two_digits(1e3 * row['elapsed_s'])}"


def print_independence(folder: Path, summary: pd.DataFrame, skipped: Sequence[str]) -> None:
    """Costs and errors of each way to one map (rows of `at_the_end`), and where the rest is."""
    headings = [("way", ""), *((heading, ">") for _, heading in SHOWN.values())]
    note = "; ".join(f"{strategy.name}: {strategy.label}" for strategy in STRATEGIES)
    for n_robots, rows in summary.groupby("n_robots"):
        numbers = (shown_numbers(rows, name).map(two_digits) for name in SHOWN)
        cells = zip(rows["strategy"], *numbers, strict=True)
        whole = f"{rows['n_whole'].min()} of {rows['n_seeds'].max()} runs"
        title = f"{n_robots} robots, at the end (one map of all in {whole})"
        print_table(headings, cells, title, note)
    print_lines([f"Tables and figure: {folder}"])
    print_skipped(skipped)


def print_methods() -> None:
    """Every alignment method by name, whose it is, and what is wrong where something is."""
    methods = known_methods().values()
    rows = [
        (each.name, each.kind, each.distribution, "absent" if each.absence else each.version)
        for each in methods
    ]
    headings = ("method", "whose", "package", "version")
    print_table([(heading, "") for heading in headings], rows, "Alignment methods")
    absent = [f"{each.name}: {each.absence}" for each in methods if each.absence]
    print_lines(f"  {line}" for line in (*absent, *name_clashes().values()))


def print_scenarios(entries: Sequence[dict[str, Any]]) -> None:
    """The scenarios of a folder."""
    shown = columns("", name="scenario", tags="tags") | columns("d", robots="robots")
    shown |= columns(">", iterations="iterations") | columns(".2f", overlap="overlap")
    shown |= columns("", description="what it is")
    frame = pd.DataFrame(entries)
    iterations = [str(each["iterations"] or "recorded") for each in entries]
    print_frame(frame.assign(tags=frame["tags"].map(" ".join), iterations=iterations), shown)
