"""All methods on made-up maps, cell by cell: one method, number of pairs and share of outliers.

Cells run one after the other in this process, warmed, so that times can be compared; each is kept
under a key of all it depends on, so an interrupted benchmark goes on where it was and a new method
costs only its own.
"""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.methods.aligner_calls import CallableAligner, callable_aligner, refine_estimate
from experiments.methods.one_thread import single_threaded
from experiments.run.frames import FLOAT, INT, TEXT, fields, read_rows, write_rows
from experiments.run.sources import imported_sources, method_sources
from experiments.run.store import StageFolder, Store
from experiments.run.tasks import OnProgress
from experiments.scenario.randomness import generator
from experiments.scenario.settings import AlignerEntry, load_scenario
from experiments.study.benchmark.synthetic_pairs import SyntheticPair, synthetic_pair
from mapfusion import se2
from mapfusion.align.refine import Refinement
from mapfusion.align.registry import find_method, known_methods
from mapfusion.errors import InputError
from mapfusion.se2 import Float
from mapfusion.storage import schema

OUTLIER_SHARES = (0.5, 0.8, 0.9, 0.95, 0.99)
PAIR_COUNTS = (60, 200, 1000, 5000)
CELL = {"method": TEXT, "n_pairs": INT, "outlier_share": FLOAT}
_OWN_SOURCES = (
    "experiments/methods/aligner_calls.py",
    "experiments/study/benchmark/cells.py",
    "experiments/methods/isolated_child.py",
    "experiments/methods/isolation.py",
    "experiments/scenario/randomness.py",
    "experiments/methods/one_thread.py",
    "mapfusion/align/sanity.py",
)

# One row a trial. All but the time are the same at every run.
TRIALS = schema(
    "benchmark.trials",
    1,
    fields(
        **CELL,
        trial=INT,
        status=TEXT,
        reason=TEXT,
        error_m=FLOAT,  # of the translation, at the middle of the world
        error_rad=FLOAT,
        refined_status=TEXT,
        refined_error_m=FLOAT,
        refined_error_rad=FLOAT,
        oracle_error_m=FLOAT,  # least squares on the true pairs
        oracle_error_rad=FLOAT,
        elapsed_s=FLOAT,
    ),
)


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
    single_threaded()
    cells = list(itertools.product(design.aligners, design.pair_counts, design.outlier_shares))
    trials = []
    for done, cell in enumerate(cells):
        on_progress("benchmark", done, len(cells))
        trials.append(_cell(design, store, *cell))
    on_progress("benchmark", len(cells), len(cells))
    return pd.concat(trials, ignore_index=True)


def _cell(
    design: BenchmarkDesign, store: Store, entry: AlignerEntry, n_pairs: int, share: float
) -> pd.DataFrame:
    method = find_method(entry.method)
    settings = {
        "entry": entry.model_dump(mode="json"),
        "origin": method.origin(),
        "n_pairs": n_pairs,
        "outlier_share": share,
        "trials": design.trials,
        "seed": design.seed,
        "budget_s": design.budget_s,
    }
    sources = _OWN_SOURCES + method_sources(method)
    sources += imported_sources(
        "experiments.study.benchmark.synthetic_pairs", "mapfusion.align.refine"
    )
    folder = store.stage("benchmark", settings, [], sources)
    path = folder.path / "trials.parquet"
    if not folder.finished:
        _measure(design, entry, n_pairs, share, folder, path)
    return read_rows(path, TRIALS)


def _measure(
    design: BenchmarkDesign,
    entry: AlignerEntry,
    n_pairs: int,
    share: float,
    folder: StageFolder,
    path: Path,
) -> None:
    started = time.perf_counter()
    aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
    rows: list[dict[str, Any]] = []
    for trial in range(design.trials):
        maps = ("benchmark", n_pairs, f"{share:g}", trial)
        pair = synthetic_pair(n_pairs, share, generator(design.seed, *maps))
        draws = (*maps, entry.name)
        if trial == 0:  # compilation, imports and caches; not counted
            _trial(aligner, pair, generator(design.seed, *draws))
        cell = {"method": entry.name, "n_pairs": n_pairs, "outlier_share": share, "trial": trial}
        rows.append(cell | _trial(aligner, pair, generator(design.seed, *draws)))
        if time.perf_counter() - started > design.budget_s:
            break
    write_rows(path, TRIALS, rows)
    folder.finish(elapsed_s=time.perf_counter() - started)


def _trial(
    aligner: CallableAligner, pair: SyntheticPair, rng: np.random.Generator
) -> dict[str, Any]:
    maps = (pair.map_a, pair.map_b, pair.correspondences)
    estimated = aligner.align(*maps, rng)
    refined = refine_estimate(Refinement(), *maps, estimated)
    row = {
        "status": str(estimated.status),
        "reason": estimated.reason,
        "refined_status": str(refined.status),
        "elapsed_s": estimated.elapsed_s,
    }
    oracle = pair.least_squares() if pair.is_true.sum() >= 2 else np.full(3, np.nan)
    for prefix, T in (("", estimated.T_a_b), ("refined_", refined.T_a_b), ("oracle_", oracle)):
        row[f"{prefix}error_m"], row[f"{prefix}error_rad"] = _errors(T, pair.T_a_b)
    return row


def _errors(T_estimated: Float, T_true: Float) -> tuple[float, float]:
    """Of the translation (m) and the rotation (rad), both 0 or more, NaN without an estimate."""
    difference = T_estimated - T_true
    return float(np.hypot(difference[0], difference[1])), abs(float(se2.wrap(difference[2])))
