"""The command `mapfusion sweep`, apart from what it shows."""

import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.judge.result import measure_aligners
from experiments.methods.threads import single_threaded
from experiments.run.dask_cluster import connected
from experiments.run.dask_worker import Terms, code_version
from experiments.run.store import Store
from experiments.study.sweep.dataset import ALIGNER_TIMINGS, Dataset, open_dataset
from experiments.study.sweep.driver import Progress, Survey, SweepDriver, survey
from experiments.study.sweep.grid import Axis, Run, parse_axes, runs_of
from experiments.study.sweep.planned import PlannedRun, planned

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

    runs: list[Run]
    axes: list[Axis]
    results: Path
    output: Path

    @property
    def dataset(self) -> Dataset:
        """Where its tables go."""
        return Dataset(self.output, tuple(axis.key for axis in self.axes))

    @property
    def store(self) -> Store:
        """Where stages are kept, shared with `mapfusion run`."""
        return Store.of(self.results)


def prepare(
    asked: Sequence[str],
    paths: Sequence[Path],
    seeds: Sequence[int],
    entries: Sequence[str],
    results: Path,
    output: Path | None,
) -> Sweep:
    """Check everything a user gave; nothing is written.

    Args:
        asked: scenarios and tags as they were given; they name the sweep without `output`.
        paths: the scenarios' files.
        seeds: of all scenarios.
        entries: of `--set`.
        results: folder of results; the store is in it.
        output: folder of the sweep, `RESULTS/sweeps/NAME` without.
    """
    axes = parse_axes(entries)
    runs = runs_of(paths, seeds, axes)
    name = "-".join(Path(part).stem for part in asked)[:_LONGEST_NAME]
    folder = output or results / SWEEPS_FOLDER / name
    # absolute: workers may have been started elsewhere
    return Sweep(runs, axes, results.resolve(), folder.resolve())


def look_ahead(sweep: Sweep) -> Survey:
    """What the sweep would compute; nothing is written."""
    return survey(sweep.runs, sweep.store, sweep.dataset)


def execute(
    sweep: Sweep,
    jobs: int,
    scheduler: str | None,
    on_progress: Callable[[Progress], None],
    retries: int = RETRIES,
) -> dict[str, str]:
    """Run a sweep; returns the failed runs with their reasons.

    Raises:
        InputError: the output folder is of another sweep, no scheduler or no worker is of use.
    """
    dataset = open_dataset(sweep.output, sweep.axes)
    for left_behind in sweep.output.glob(f"{_ATTEMPTS_PREFIX}*"):
        _remove_if_old(left_behind)
    attempts = Path(tempfile.mkdtemp(prefix=_ATTEMPTS_PREFIX, dir=sweep.output))
    try:
        with connected(jobs, scheduler) as client:
            terms = Terms(attempts, retries, code_version())
            driver = SweepDriver(client, sweep.store, dataset, terms, on_progress)
            driver.execute(sweep.runs)
    finally:
        shutil.rmtree(attempts, ignore_errors=True)
    return driver.failed_runs


def measure_times(
    sweep: Sweep, failed: Collection[str], on_progress: Callable[[int, int], None]
) -> None:
    """Aligners' times, serial, for all runs without that did not fail: nothing else may run."""
    dataset = sweep.dataset
    single_threaded()
    runs = [run for run in sweep.runs if run.run_id not in failed]
    for done, run in enumerate(runs):
        on_progress(done, len(runs))
        if not dataset.path(ALIGNER_TIMINGS, run).is_file():
            _measure(planned(run, sweep.store, dataset), dataset)
    on_progress(len(runs), len(runs))


def _measure(laid_out: PlannedRun, dataset: Dataset) -> None:
    judged = laid_out.judged
    measure_aligners(judged, judged.load_robots())
    dataset.write(ALIGNER_TIMINGS, laid_out.run, judged.pair_table(ALIGNER_TIMINGS))


def _remove_if_old(folder: Path) -> None:
    """Of a sweep that was killed; one that is younger may belong to a sweep that is running."""
    if time.time() - folder.stat().st_mtime > _OLD_S:
        shutil.rmtree(folder, ignore_errors=True)
