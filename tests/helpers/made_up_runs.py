"""Tables of many made-up runs, as result folders and as a sweep; for tests alone."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from experiments.evaluation import tables
from experiments.evaluation.alignment_criteria import ERROR_COLUMNS

Tables = dict[str, pd.DataFrame]
ITERATIONS = (25, 50, 75, 100)
PAIRS = (("R1", "R2"), ("R1", "R3"))
# Factor on the oracle's error, how much it scatters, and the share of maps it is lost on.
METHODS = {"ransac": (1.1, 0.1, 0.02), "icp": (8.0, 0.8, 0.4)}
LOST_M, LOST_RAD = 6.0, 1.5
_EMPTY = {pa.string(): "", pa.bool_(): False}


def errors_of(
    seed: int,
    methods: Mapping[str, tuple[float, float, float]] = METHODS,
    repetitions: int = 3,
    oracle_m: float = 0.08,
) -> pd.DataFrame:
    """A table `errors`: each run has a drift of its own that all methods share."""
    rng = np.random.default_rng(seed)
    drift = np.exp(0.3 * rng.normal())
    rows = []
    for a, b in PAIRS:
        for place, iteration in enumerate(ITERATIONS):
            oracle = oracle_m * drift * np.exp(0.1 * rng.normal())
            n_pairs, n_true = 100, int(rng.integers(5, 30)) * (place + 1)
            names = {"robot_a": a, "robot_b": b, "iteration": iteration}
            names |= {"n_correspondences": n_pairs, "n_true": min(n_true, n_pairs)}
            names |= {"n_common": 2 * n_true, "status": "accepted", "refined_status": "accepted"}
            rows.append(names | _row("oracle", 0, oracle, 0.002, oracle, 0.002))
            for method, (factor, scatter, lost) in methods.items():
                for repetition in range(repetitions):
                    own = oracle * factor * np.exp(scatter * rng.normal())
                    if rng.uniform() < lost:
                        values = (LOST_M, LOST_RAD, LOST_M, LOST_RAD)
                    else:
                        values = (own, 0.01, oracle * 1.01, 0.002)
                    rows.append(names | _row(method, repetition, *values))
    return pd.DataFrame(rows)


def many_errors(n_runs: int, **made: object) -> pd.DataFrame:
    """Tables `errors` of many runs, the runs' columns in front."""
    parts = []
    for seed in range(n_runs):
        run = {"run_id": f"world-{seed}", "scenario": "world", "seed": seed}
        rows = errors_of(seed, **made)  # type: ignore[arg-type]
        parts.append(rows.assign(**run)[[*run, *rows.columns]])
    return pd.concat(parts, ignore_index=True)


def _row(
    method: str, repetition: int, m: float, rad: float, fine_m: float, fine_rad: float
) -> dict:
    return {
        "aligner": method,
        "repetition": repetition,
        "translation_error_m": m,
        "rotation_error_rad": -rad,
        "refined_translation_error_m": fine_m,
        "refined_rotation_error_rad": -fine_rad,
    }


def robots_of(seed: int, error_m: float = 0.05) -> pd.DataFrame:
    """A table `robots`."""
    rng = np.random.default_rng(100 + seed)
    scale = error_m * np.exp(0.1 * rng.normal(size=(3, 1)))
    frame = pd.DataFrame({"robot": np.repeat(["R1", "R2", "R3"], 20)})
    frame["iteration"] = np.tile(np.arange(20), 3)
    frame["path_error_m"] = (scale * rng.uniform(0.5, 1.5, (3, 20))).ravel()
    return frame.assign(odometry_error_m=10 * frame["path_error_m"])


def map_fits_of(seed: int, rmse_m: float = 0.04) -> pd.DataFrame:
    """A table `map_fits`."""
    rng = np.random.default_rng(200 + seed)
    rows = {"map": ["R1", "R2", "R3", "fused"], "n_landmarks": 50}
    return pd.DataFrame(rows | {"rmse_m": rmse_m * np.exp(0.1 * rng.normal(size=4))})


def timings_of(seed: int, elapsed_s: float = 1e-3) -> pd.DataFrame:
    """A table `aligner_timings`."""
    rng = np.random.default_rng(300 + seed)
    rows = [
        {"robot_a": a, "robot_b": b, "iteration": k, "aligner": method}
        | {"n_correspondences": 2 * k, "n_common": k, "elapsed_s": elapsed_s * k / 50}
        for a, b in PAIRS
        for k in ITERATIONS
        for method in METHODS
    ]
    frame = pd.DataFrame(rows)
    frame["elapsed_s"] *= np.exp(0.1 * rng.normal(size=len(frame)))
    return frame.assign(
        elapsed_low_s=0.9 * frame["elapsed_s"], elapsed_high_s=1.2 * frame["elapsed_s"]
    )


def complete(name: str, frame: pd.DataFrame) -> pd.DataFrame:
    """All columns of the table `name`; what a test does not care about is empty."""
    empty = {
        column.name: np.nan if pa.types.is_floating(column.type) else _EMPTY.get(column.type, 0)
        for column in tables.ALL[name]
        if column.name not in frame
    }
    return frame.assign(**empty)[tables.ALL[name].names]


def tables_of(seed: int, **errors: object) -> dict[str, pd.DataFrame]:
    """All made-up tables of one run."""
    return {
        "errors": errors_of(seed, **errors),  # type: ignore[arg-type]
        "robots": robots_of(seed),
        "map_fits": map_fits_of(seed),
        "aligner_timings": timings_of(seed),
    }


def write_result(
    results: Path, seed: int, made: Mapping[str, pd.DataFrame], name: str = "world"
) -> Path:
    """A result folder with these tables; returns it."""
    folder = results / f"{name}-{seed}"
    for table, frame in made.items():
        tables.write(tables.table_path(folder, table), table, complete(table, frame.copy()))
    align = {"aligners": [{"name": method} for method in METHODS]}
    scenario = {"name": name, "seed": seed, "align": align}
    (folder / "scenario.json").write_text(json.dumps(scenario), encoding="utf-8")
    return folder


def write_sweep(
    folder: Path,
    seeds: Sequence[int],
    settings: Sequence[Mapping[str, str]] = ({},),
    scenarios: Sequence[str] = ("world",),
    made: Mapping[int, Mapping[str, pd.DataFrame]] | None = None,
    file_a_run: bool = False,
) -> Path:
    """A sweep folder, the run's columns in front of each table; returns it.

    Each table is one file of all runs, which is quicker than the file a run that `sweep` writes.
    """
    folder.mkdir(parents=True)
    (folder / "sweep.json").write_text("{}", encoding="utf-8")
    of_table: dict[str, list[pd.DataFrame]] = {}
    for scenario in scenarios:
        for number, setting in enumerate(settings):
            for seed in seeds:
                run_id = f"{scenario}-{seed}-{number}"
                keys = {"run_id": run_id, "scenario": scenario, "seed": seed} | dict(setting)
                run = pd.DataFrame([{"status": "finished", "reason": ""}])
                own = made[seed] if made and seed in made else tables_of(seed)
                for table, frame in {"runs": run, **own}.items():
                    described = frame.assign(**keys)[[*keys, *frame]]
                    of_table.setdefault(table, []).append(described)
    for table, frames in of_table.items():
        rows = pd.concat(frames, ignore_index=True)
        if table != "runs":
            keys = [name for name in rows if name not in tables.ALL[table].names]
            rows = rows[keys].join(complete(table, rows))
        for run_id, own in rows.groupby("run_id") if file_a_run else [("all", rows)]:
            write_rows(folder, table, str(run_id), own)
    return folder


def write_rows(sweep: Path, table: str, file: str, rows: pd.DataFrame) -> None:
    """A file of a sweep's table."""
    (sweep / table).mkdir(exist_ok=True)
    data = pa.Table.from_pandas(rows, preserve_index=False)
    pq.write_table(data.replace_schema_metadata(None), sweep / table / f"{file}.parquet")


def two_sweeps(
    folder: Path, change: Callable[[int, Tables], Tables], seeds: int = 12
) -> tuple[Path, Path]:
    """The same runs, and what another version makes of them."""
    made = {seed: tables_of(seed) for seed in range(seeds)}
    changed = {seed: change(seed, {k: t.copy() for k, t in made[seed].items()}) for seed in made}
    of_a = write_sweep(folder / "a", [*made], made=made)
    return of_a, write_sweep(folder / "b", [*changed], made=changed)


def scaled(factor: float, aligner: str, scatter: float = 0.0) -> Callable[[int, Tables], Tables]:
    """A change of one aligner's errors by a factor, with scatter."""

    def change(seed: int, made: Tables) -> Tables:
        rng = np.random.default_rng(900 + seed)
        own = made["errors"]["aligner"] == aligner
        factors = factor * np.exp(scatter * rng.normal(size=(int(own.sum()), 1)))
        made["errors"].loc[own, list(ERROR_COLUMNS)] *= factors
        return made

    return change
