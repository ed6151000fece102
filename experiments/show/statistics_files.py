"""The commands `statistics` and `compare`: load, compute, write, show."""

from collections.abc import Sequence
from pathlib import Path

from experiments.show.export import write_tables
from experiments.show.figures.over_runs import draw_over_runs
from experiments.show.terminal.statistics_screen import print_comparison, print_summary
from experiments.study.compare.versions import compare
from experiments.study.statistics.run_tables import find_runs
from experiments.study.statistics.summary import summarise


def run_statistics(paths: Sequence[Path], output: Path | None) -> None:
    """Show the main tables; write all, and figures 4 to 6, where an output folder is given.

    Raises:
        InputError: a path that holds no runs, or a damaged table.
    """
    summary = summarise(find_runs(paths))
    skipped: list[str] = []
    if output is not None:
        write_tables(output, summary.tables)
        skipped = draw_over_runs(summary, output / "figures")
    print_summary(summary, output, skipped)


def run_compare(first: Path, second: Path, show_all: bool, output: Path | None) -> bool:
    """Show what changed; returns whether anything got worse.

    Raises:
        InputError: a path that holds no runs, or runs that have nothing in common.
    """
    found = compare(first, second)
    if output is not None:
        write_tables(output, {"comparison": found.table})
    print_comparison(found, show_all, output)
    return found.worse
