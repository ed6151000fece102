"""One cell of the benchmark: a method's trials at one number of pairs and one share of outliers."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.methods.aligner_calls import callable_aligner
from experiments.methods.threads import single_threaded
from experiments.run.frames import FLOAT, INT, TEXT, fields, write_rows
from experiments.run.job import Job
from experiments.scenario.randomness import generator
from experiments.study.benchmark.synthetic_pairs import SyntheticPair, synthetic_pair
from mapfusion import se2
from mapfusion.align.registration import Registration
from mapfusion.storage import schema

TRIALS_FILE = "trials.parquet"
CELL = {"method": TEXT, "n_pairs": INT, "outlier_share": FLOAT}

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
class CellSettings:
    """All that one method's trials in one cell depend on, among it an aligner as scenarios have."""

    name: str
    method: str
    parameters: dict[str, Any]
    time_limit_s: float
    origin: dict[str, str]
    n_pairs: int
    outlier_share: float
    trials: int
    seed: int
    budget_s: float


def run_cell(settings: CellSettings, job: Job) -> None:
    """Run the trials of one cell and write them."""
    single_threaded()
    started = time.perf_counter()
    n_pairs, share = settings.n_pairs, settings.outlier_share
    aligner = callable_aligner(settings.method, settings.parameters, settings.time_limit_s)
    registration = Registration(aligner, judge=None)  # methods are ranked by what they find
    cell = {"method": settings.name, "n_pairs": n_pairs, "outlier_share": share}
    rows: list[dict[str, Any]] = []
    for trial in range(settings.trials):
        maps = ("benchmark", n_pairs, f"{share:g}", trial)
        pair = synthetic_pair(n_pairs, share, generator(settings.seed, *maps))
        for _ in range(2 if trial == 0 else 1):  # the first one compiles, imports and fills caches
            answer = _trial(registration, pair, generator(settings.seed, *maps, settings.name))
        rows.append(cell | {"trial": trial} | answer)
        if time.perf_counter() - started > settings.budget_s:
            break
    write_rows(job.output / TRIALS_FILE, TRIALS, rows)


def _trial(
    registration: Registration, pair: SyntheticPair, rng: np.random.Generator
) -> dict[str, Any]:
    estimated, refined, _ = registration.register(pair.map_a, pair.map_b, pair.correspondences, rng)
    row = {
        "status": str(estimated.status),
        "reason": estimated.reason,
        "refined_status": str(refined.status),
        "elapsed_s": estimated.elapsed_s,
    }
    oracle = pair.least_squares() if pair.is_true.sum() >= 2 else np.full(3, np.nan)
    for prefix, T in (("", estimated.T_a_b), ("refined_", refined.T_a_b), ("oracle_", oracle)):
        x, y, theta = T - pair.T_a_b
        row[f"{prefix}error_m"] = float(np.hypot(x, y))
        row[f"{prefix}error_rad"] = abs(float(se2.wrap(theta)))
    return row
