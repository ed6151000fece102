"""What a sweep would do, for `mapfusion sweep --dry-run`; nothing is computed."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from experiments.run.store import Store
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.planned_run import planned
from experiments.study.sweep.sweep_dataset import SweepDataset
from mapfusion.errors import InputError


@dataclass
class Survey:
    """What a sweep would do: runs, and tasks by label.

    Attributes:
        runs, runs_finished, runs_refused: refused are those that cannot be laid out.
        wanted: over all runs, as if nothing were shared.
        finished: on disk.
        left: to be computed.
    """

    runs: int = 0
    runs_finished: int = 0
    runs_refused: int = 0
    wanted: Counter[str] = field(default_factory=Counter)
    finished: Counter[str] = field(default_factory=Counter)
    left: Counter[str] = field(default_factory=Counter)


def survey(runs: Iterable[SweepRun], store: Store, dataset: SweepDataset) -> Survey:
    """Count the tasks of runs, how many are shared between runs and how many are done."""
    found = Survey()
    known: set[str] = set()
    for run in runs:
        found.runs += 1
        try:
            laid_out = planned(run, store, dataset)
        except InputError:
            found.runs_refused += 1
            continue
        found.runs_finished += laid_out.finished
        todo = {task.name for task in laid_out.left()}
        for name, task in laid_out.tasks.items():
            found.wanted[task.label] += 1
            if name not in known:
                known.add(name)
                (found.left if name in todo else found.finished)[task.label] += 1
    return found
