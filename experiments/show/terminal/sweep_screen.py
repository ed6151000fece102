"""What `mapfusion sweep` shows: progress, what is to be done, and a summary."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import pandas as pd
from rich.console import Console
from rich.progress import TimeRemainingColumn
from rich.table import Table

from experiments.judge.criteria import ANSWERABLE_PAIRS
from experiments.show.terminal.layout import LAYOUT, number, progress
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.sweep_dataset import ERRORS, SweepDataset, medians_over_runs
from experiments.study.sweep.sweep_driver import SweepProgress
from experiments.study.sweep.sweep_plan import Survey

MAX_ROWS_SHOWN = 60
MAX_FAILURES_SHOWN = 10


@contextmanager
def sweep_progress() -> Iterator[Callable[[SweepProgress], None]]:
    """A progress display on stderr: one bar of runs, with the time left, one of each stage."""
    with progress(TimeRemainingColumn()) as show:

        def show_sweep(now: SweepProgress) -> None:
            show("runs", now.done, now.runs)
            if now.failed:
                show("runs that failed", len(now.failed), now.runs)
            for label, total in now.tasks.items():
                show(label, now.tasks_done[label], total)

        yield show_sweep


def print_survey(found: Survey) -> None:
    """How many tasks there are, by stage."""
    console = Console()
    refused = f", {found.runs_refused} that cannot be run" if found.runs_refused else ""
    console.print(f"{found.runs} runs, {found.runs_finished} of them finished{refused}")
    table = Table(title="Tasks", caption="shared: wanted by several runs, done once", **LAYOUT)
    for heading in ("stage", "wanted", "shared", "finished", "to do"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    for label, wanted in found.wanted.items():
        done, left = found.finished[label], found.left[label]
        cells = (wanted, wanted - done - left, done, left)
        table.add_row(label, *map(str, cells))
    console.print(table)


def print_sweep(dataset: SweepDataset, runs: Sequence[SweepRun], failed: Mapping[str, str]) -> None:
    """Medians over the runs, and the failures."""
    console = Console()
    finished = [run for run in runs if run.run_id not in failed]
    if finished:
        summary = medians_over_runs(dataset, finished)
        console.print(_summary_table(summary, dataset.keys))
        if len(summary) > MAX_ROWS_SHOWN:
            console.print(f"... and {len(summary) - MAX_ROWS_SHOWN} more rows")
    for run_id in sorted(failed)[:MAX_FAILURES_SHOWN]:
        console.print(f"  {run_id} failed: {failed[run_id]}", soft_wrap=True, markup=False)
    if len(failed) > MAX_FAILURES_SHOWN:
        console.print(f"  ... and {len(failed) - MAX_FAILURES_SHOWN} more failed")
    console.print(
        f"{len(finished)} of {len(runs)} runs finished; tables: {dataset.folder}",
        soft_wrap=True,
    )


def _summary_table(summary: pd.DataFrame, keys: tuple[str, ...]) -> Table:
    table = Table(
        title=f"Median translation errors over runs, {ANSWERABLE_PAIRS}+ true pairs", **LAYOUT
    )
    table.add_column(" ".join(("scenario", *(key.rpartition(".")[2] for key in keys))))
    table.add_column("aligner")
    for heading in ("estim., m", "refined, m", "runs"):
        table.add_column(heading, justify="right")
    for row in summary.head(MAX_ROWS_SHOWN).to_dict("records"):
        errors = (number(row[name], ".3f") for name in ERRORS)
        table.add_row(row["setting"], row["aligner"], *errors, str(row["runs"]))
    return table
