"""All methods on made-up maps, cell by cell: one method, number of pairs and share of outliers.

Cells run one after the other in this process, warmed, so that times can be compared; each is kept
under a key of all it depends on, so an interrupted benchmark goes on where it was and a new method
costs only its own.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from experiments.methods.catalogue import find_method, known_methods
from experiments.run.frames import read_rows
from experiments.run.stage import Stage
from experiments.run.store import Store
from experiments.run.tasks import OnProgress, tasks_of
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import AlignerEntry
from experiments.study.benchmark.trials import TRIALS, TRIALS_FILE, CellSettings, run_cell
from mapfusion.errors import InputError

OUTLIER_SHARES = (0.5, 0.8, 0.9, 0.95, 0.99)
PAIR_COUNTS = (60, 200, 1000, 5000)
_LABEL = "measure the aligners"


@dataclass(frozen=True)
class BenchmarkDesign:
    """What is measured.

    Attributes:
        aligners: the methods.
        trials: of each cell, each on maps of its own, the same for all methods.
        seed: of maps and methods.
        budget_s: a cell that has taken longer ends with the trials it has.
        pair_counts: numbers of correspondences.
        outlier_shares: shares of false ones.
    """

    aligners: tuple[AlignerEntry, ...]
    trials: int = 100
    seed: int = 0
    budget_s: float = 600.0
    pair_counts: tuple[int, ...] = PAIR_COUNTS
    outlier_shares: tuple[float, ...] = OUTLIER_SHARES


def entries_of(methods: Sequence[str], scenario: Path | None = None) -> tuple[AlignerEntry, ...]:
    """The methods of these names, with their default parameters, or a scenario's aligners.

    With both, the scenario's aligners of these names; with neither, all known methods.

    Raises:
        InputError: a name or the scenario is unknown or unusable.
    """
    names = list(dict.fromkeys(methods))
    if scenario is not None:
        entries = {entry.name: entry for entry in load_scenario(scenario).align.aligners}
        for name in names:
            if name not in entries:
                raise InputError(f"{scenario}: align.aligners: none is named {name}")
        return tuple(entries[name] for name in names or entries)
    for name in names:
        try:
            find_method(name)
        except ValueError as error:
            raise InputError(f"--method: {error}") from error
    return tuple(AlignerEntry(name=name, method=name) for name in names or known_methods())


def run_benchmark(design: BenchmarkDesign, store: Store, on_progress: OnProgress) -> pd.DataFrame:
    """All trials of all cells (TRIALS), from the store where they are there."""
    cells = list(itertools.product(design.aligners, design.pair_counts, design.outlier_shares))
    trials = []
    for done, cell in enumerate(cells):
        on_progress(_LABEL, done, len(cells))
        trials.append(_cell(design, store, *cell))
    on_progress(_LABEL, len(cells), len(cells))
    return pd.concat(trials, ignore_index=True)


def _cell(
    design: BenchmarkDesign, store: Store, entry: AlignerEntry, n_pairs: int, share: float
) -> pd.DataFrame:
    method = find_method(entry.method)
    settings = CellSettings(
        **dict(entry),
        origin=method.origin(),
        n_pairs=n_pairs,
        outlier_share=share,
        trials=design.trials,
        seed=design.seed,
        budget_s=design.budget_s,
    )
    loads = (method.target.partition(":")[0],)
    stage = Stage("benchmark", _LABEL, settings, run_cell, (TRIALS_FILE,), loads=loads)
    for task in tasks_of([stage], store).values():
        task.run()
    return read_rows(store.path(stage) / TRIALS_FILE, TRIALS)
