"""A sweep from what a user asks for to its tables: prepared, run on Dask, its aligners timed."""

import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.methods.threads import single_threaded
from experiments.run.dask_cluster import connected
from experiments.run.dask_worker import Terms, code_version
from experiments.run.store import Store
from experiments.run.tasks import OnProgress
from experiments.scenario.suite import scenarios_of
from experiments.study.sweep.combinations import Axis, SweepRun, parse_axes, runs_of
from experiments.study.sweep.planned_run import write_aligner_timings
from experiments.study.sweep.sweep_dataset import ALIGNER_TIMINGS, SweepDataset, open_dataset
from experiments.study.sweep.sweep_driver import SweepDriver, SweepProgress

SWEEPS_FOLDER = "sweeps"
# A worker may be killed for no fault of its task (a machine that goes away); four times in a row
# while at the same task it is the task.
RETRIES = 3
_ATTEMPTS_PREFIX = ".attempts-"
_OLD_S = 24 * 3600  # in a sweep that runs, tasks begin and end in the meantime
_LONGEST_NAME = 80


@dataclass(frozen=True)
class Sweep:
    """What is to be run, and where it goes."""

    runs: list[SweepRun]
    axes: list[Axis]
    results: Path
    output: Path

    @property
    def dataset(self) -> SweepDataset:
        """Where its tables go."""
        return SweepDataset(self.output, tuple(axis.key for axis in self.axes))

    @property
    def store(self) -> Store:
        """Where stages are kept, shared with `mapfusion run`."""
        return Store.of(self.results)


def prepare(
    asked: Sequence[str | Path],
    seeds: Sequence[int],
    settings: Sequence[str],
    results: Path,
    output: Path | None = None,
) -> Sweep:
    """Check everything a user gave; nothing is written.

    Args:
        asked: scenario files, names and tags; they name the sweep without `output`.
        seeds: of all scenarios.
        settings: entries of `--set`.
        results: folder of results; the store is in it.
        output: folder of the sweep, `RESULTS/sweeps/NAME` without.

    Raises:
        InputError: a scenario, key or value is wrong.
    """
    axes = parse_axes(settings)
    runs = runs_of(scenarios_of(asked), seeds, axes)
    name = "-".join(Path(part).stem for part in asked)[:_LONGEST_NAME]
    folder = output or results / SWEEPS_FOLDER / name
    # absolute: workers may have been started elsewhere
    return Sweep(runs, axes, results.resolve(), folder.resolve())


def execute(
    sweep: Sweep,
    jobs: int,
    scheduler: str | None,
    on_progress: Callable[[SweepProgress], None],
) -> dict[str, str]:
    """Run a sweep; returns the failed runs with their reasons.

    Raises:
        InputError: the output folder is of another sweep, no scheduler or no worker is of use.
    """
    dataset = open_dataset(sweep.output, sweep.axes)
    for left_behind in sweep.output.glob(f"{_ATTEMPTS_PREFIX}*"):
        _remove_if_old(left_behind)
    with (
        tempfile.TemporaryDirectory(
            prefix=_ATTEMPTS_PREFIX, dir=sweep.output, ignore_cleanup_errors=True
        ) as attempts,
        connected(jobs, scheduler) as client,
    ):
        terms = Terms(Path(attempts), RETRIES, code_version())
        driver = SweepDriver(client, sweep.store, dataset, terms, on_progress)
        driver.execute(sweep.runs)
    return driver.progress.failed


def _remove_if_old(folder: Path) -> None:
    """Of a sweep that was killed; one that is younger may belong to a sweep that is running."""
    if time.time() - folder.stat().st_mtime > _OLD_S:
        shutil.rmtree(folder, ignore_errors=True)


def measure_times(sweep: Sweep, failed: Collection[str], on_progress: OnProgress) -> None:
    """Aligners' times, serial, for all runs without that did not fail: nothing else may run."""
    single_threaded()
    runs = [run for run in sweep.runs if run.run_id not in failed]
    for done, run in enumerate(runs):
        on_progress("time the aligners", done, len(runs))
        if not sweep.dataset.path(ALIGNER_TIMINGS, run).is_file():
            write_aligner_timings(run, sweep.store, sweep.dataset)
    on_progress("time the aligners", len(runs), len(runs))
