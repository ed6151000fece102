"""What `mapfusion sweep` shows: progress, what is to be done, and a summary."""

from collections.abc import Callable, Mapping, Sequence

from experiments.judge.criteria import ANSWERABLE_PAIRS
from experiments.show.terminal.layout import (
    NO_ESTIMATE,
    columns,
    print_frame,
    print_lines,
    print_table,
)
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.run_medians import ERRORS, GIVEN, medians_over_runs
from experiments.study.sweep.sweep_dataset import SweepDataset
from experiments.study.sweep.sweep_driver import SweepProgress
from experiments.study.sweep.sweep_plan import Survey

MAX_ROWS_SHOWN = 60
MAX_FAILURES_SHOWN = 10


def shown_by(show: Callable[[str, int, int], None]) -> Callable[[SweepProgress], None]:
    """One progress bar of runs, one of each stage."""

    def show_sweep(now: SweepProgress) -> None:
        show("runs", now.done, now.runs)
        if now.failed:
            show("runs that failed", len(now.failed), now.runs)
        for label, total in now.tasks.items():
            show(label, now.tasks_done[label], total)

    return show_sweep


def print_survey(found: Survey) -> None:
    """How many tasks there are, by stage."""
    refused = f", {found.runs_refused} that cannot be run" if found.runs_refused else ""
    print_lines([f"{found.runs} runs, {found.runs_finished} of them finished{refused}"])
    headings = [("stage", ""), *((name, "d") for name in ("wanted", "shared", "finished", "to do"))]
    rows = []
    for label, wanted in found.wanted.items():
        done, left = found.finished[label], found.left[label]
        rows.append((label, wanted, wanted - done - left, done, left))
    print_table(headings, rows, "Tasks", "shared: wanted by several runs, done once")


def print_sweep(dataset: SweepDataset, runs: Sequence[SweepRun], failed: Mapping[str, str]) -> None:
    """Medians over the runs, and the failures."""
    finished = [run for run in runs if run.run_id not in failed]
    lines = []
    if finished:
        summary = medians_over_runs(dataset, finished)
        keys = (key.rpartition(".")[2] for key in dataset.keys)
        shown = columns("", setting=" ".join(("scenario", *keys)), aligner="aligner")
        for error, given, stage in zip(ERRORS, GIVEN, ("estim.", "refined"), strict=True):
            shown |= columns(".3f", **{error: f"{stage}\nm"})
            shown |= columns(".0%", **{given: "\ngiven"})
        shown |= columns("d", runs="runs")
        title = f"Median translation errors over runs, {ANSWERABLE_PAIRS}+ true pairs"
        print_frame(summary.head(MAX_ROWS_SHOWN), shown, title, NO_ESTIMATE)
        if len(summary) > MAX_ROWS_SHOWN:
            lines.append(f"... and {len(summary) - MAX_ROWS_SHOWN} more rows")
    shown = sorted(failed)[:MAX_FAILURES_SHOWN]
    lines += [f"  {run_id} failed: {failed[run_id]}" for run_id in shown]
    if len(failed) > MAX_FAILURES_SHOWN:
        lines.append(f"  ... and {len(failed) - MAX_FAILURES_SHOWN} more failed")
    print_lines([*lines, f"{len(finished)} of {len(runs)} runs finished; tables: {dataset.folder}"])
