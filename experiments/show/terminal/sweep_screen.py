"""What `mapfusion sweep` shows: progress, what is to be done, and a summary."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq
from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from experiments.judge.criteria import ANSWERABLE_PAIRS as MIN_TRUE_PAIRS_SHOWN
from experiments.show.terminal.layout import STAGE_TEXT
from experiments.study.sweep.dataset import Dataset
from experiments.study.sweep.driver import Progress as SweepProgress
from experiments.study.sweep.driver import Survey
from experiments.study.sweep.grid import Run

MAX_ROWS_SHOWN = 60
MAX_FAILURES_SHOWN = 10
_LAYOUT: Any = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "title_justify": "left"}


@contextmanager
def progress() -> Iterator[Callable[[SweepProgress], None]]:
    """A progress display on stderr: one bar of runs, with the time left, one of each stage."""
    display = Progress(
        TextColumn("{task.description:<26}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
    with display:
        bars: dict[str, Any] = {"runs": display.add_task("runs", total=None)}

        def show(now: SweepProgress) -> None:
            failed = f" ({now.failed} failed)" if now.failed else ""
            display.update(
                bars["runs"], description=f"runs{failed}", completed=now.done, total=now.runs
            )
            for kind, total in now.tasks.items():
                if kind not in bars:
                    bars[kind] = display.add_task(STAGE_TEXT.get(kind, kind), total=total)
                display.update(bars[kind], completed=now.tasks_done[kind], total=total)

        yield show


@contextmanager
def timing_progress() -> Iterator[Callable[[int, int], None]]:
    """Progress of the serial measurement."""
    with Progress(console=Console(stderr=True)) as display:
        bar = display.add_task("time the aligners")
        yield lambda done, total: display.update(bar, completed=done, total=total)


def print_survey(found: Survey) -> None:
    """How many tasks there are, by stage."""
    console = Console()
    refused = f", {found.runs_refused} that cannot be run" if found.runs_refused else ""
    console.print(f"{found.runs} runs, {found.runs_finished} of them finished{refused}")
    table = Table(title="Tasks", caption="shared: wanted by several runs, done once", **_LAYOUT)
    for heading in ("stage", "wanted", "shared", "finished", "to do"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    for kind, wanted in found.wanted.items():
        done, left = found.finished[kind], found.left[kind]
        cells = (wanted, wanted - done - left, done, left)
        table.add_row(STAGE_TEXT.get(kind, kind), *map(str, cells))
    console.print(table)


def print_sweep(dataset: Dataset, runs: list[Run], failed: Mapping[str, str]) -> None:
    """Medians over the runs, and the failures."""
    console = Console()
    summary = summarise(dataset, [run for run in runs if run.run_id not in failed])
    console.print(_summary_table(summary, dataset.keys))
    if len(summary) > MAX_ROWS_SHOWN:
        console.print(f"... and {len(summary) - MAX_ROWS_SHOWN} more rows")
    for run_id in sorted(failed)[:MAX_FAILURES_SHOWN]:
        console.print(f"  {run_id} failed: {failed[run_id]}", soft_wrap=True, markup=False)
    if len(failed) > MAX_FAILURES_SHOWN:
        console.print(f"  ... and {len(failed) - MAX_FAILURES_SHOWN} more failed")
    console.print(
        f"{len(runs) - len(failed)} of {len(runs)} runs finished; tables: {dataset.folder}",
        soft_wrap=True,
    )


def summarise(dataset: Dataset, runs: list[Run]) -> pd.DataFrame:
    """One row for each scenario, values and aligner: medians over the runs' own medians.

    Run by run, so that memory does not grow with the sweep.
    """
    columns = ["aligner", "n_true", "translation_error_m", "refined_translation_error_m"]
    medians = []
    for run in runs:
        errors = _read(dataset.path("errors", run), columns)
        used = errors[errors["n_true"] >= MIN_TRUE_PAIRS_SHOWN]
        values = used.groupby("aligner", sort=False)[columns[2:]].median().reset_index()
        values["setting"] = " ".join((run.scenario, *run.settings))
        medians.append(values)
    if not medians:
        return pd.DataFrame(columns=pd.Index(["setting", "aligner", *columns[2:], "runs"]))
    joined = pd.concat(medians, ignore_index=True)
    grouped = joined.groupby(["setting", "aligner"], sort=False)[columns[2:]]
    summary = grouped.median()
    summary["runs"] = grouped.size()
    return summary.reset_index()


def _read(path: Path, columns: list[str]) -> pd.DataFrame:
    return pq.read_table(path, columns=columns).to_pandas()


def _summary_table(summary: pd.DataFrame, keys: tuple[str, ...]) -> Table:
    table = Table(
        title=f"Median translation errors over runs, {MIN_TRUE_PAIRS_SHOWN}+ true pairs", **_LAYOUT
    )
    heading = " ".join(("scenario", *(key.rpartition(".")[2] for key in keys)))
    for text in (heading, "aligner", "estim., m", "refined, m", "runs"):
        table.add_column(text, justify="left" if text in (heading, "aligner") else "right")
    for row in summary.head(MAX_ROWS_SHOWN).to_dict("records"):
        errors = (row["translation_error_m"], row["refined_translation_error_m"])
        cells = ("-" if math.isnan(value) else f"{value:.3f}" for value in errors)
        table.add_row(str(row["setting"]), str(row["aligner"]), *cells, str(row["runs"]))
    return table
