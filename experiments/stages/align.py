"""Stage: all aligners on the correspondences of one robot pair, at each evaluated iteration."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments import tables
from experiments.aligner_calls import CallableAligner, callable_aligner, refine_estimate
from experiments.randomness import generator
from experiments.scenario import AlignerEntry, Scenario
from experiments.stages.slam import read_snapshots
from experiments.store import StageFolder, Store
from mapfusion.align.correspondences import Correspondences, match
from mapfusion.align.registry import find_method
from mapfusion.align.result import Alignment, Status
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import read_log

SOURCES = (
    "mapfusion/align",
    "mapfusion/landmark_map.py",
    "mapfusion/robot_log.py",
    "mapfusion/storage.py",
    "mapfusion/se2.py",
)
SOURCES += ("experiments/stages/align.py", "experiments/tables.py", "experiments/randomness.py")
SOURCES += ("experiments/aligner_calls.py", "experiments/isolation.py", "experiments/workers.py")
SOURCES += ("experiments/isolated_child.py",)

# Evaluated iterations a task: small enough that an interruption loses little and two cores end
# at about the same time, large enough that reading the maps costs little beside aligning them.
ITERATIONS_PER_BATCH = 12
_COVARIANCE_COLUMNS = ("cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt")


class Parts(NamedTuple):
    """Where the batches of one robot pair lie, apart for each aligner.

    So a run in which one aligner has changed takes all others' estimates as they are.
    """

    match: StageFolder
    aligners: tuple[StageFolder, ...]


def stage(
    store: Store, scenario: Scenario, slam_a: StageFolder, slam_b: StageFolder
) -> StageFolder:
    """Where the joined estimates of this pair of robots are or will be."""
    settings = {"seed": scenario.seed, "align": scenario.align.model_dump(mode="json")}
    settings["origins"] = [_origin(entry) for entry in scenario.align.aligners]
    return store.stage("align", settings, [slam_a, slam_b], SOURCES)


def parts(store: Store, scenario: Scenario, slam_a: StageFolder, slam_b: StageFolder) -> Parts:
    """Where the pair's batches are or will be."""
    resolved = scenario.align.model_dump(mode="json")
    match_folder = store.stage("match", resolved["match"], [slam_a, slam_b], SOURCES)
    common = {"seed": scenario.seed}
    common |= {name: resolved[name] for name in ("refinement", "repetitions")}
    aligners = tuple(
        store.stage(
            "aligner",
            common | {"entry": entry.model_dump(mode="json"), "origin": _origin(entry)},
            [match_folder],
            SOURCES,
        )
        for entry in scenario.align.aligners
    )
    return Parts(match_folder, aligners)


def _origin(entry: AlignerEntry) -> dict[str, str]:
    """Package, version and files of an aligner that is not our own."""
    return find_method(entry.method).origin()


def batches(iterations: list[int]) -> list[list[int]]:
    """Evaluated iterations shared out into tasks."""
    starts = range(0, len(iterations), ITERATIONS_PER_BATCH)
    return [iterations[start : start + ITERATIONS_PER_BATCH] for start in starts]


def _batch_path(folder: StageFolder, index: int) -> Path:
    return folder.path / f"batch_{index:03d}.parquet"


def run_batch(
    scenario: Scenario,
    robots: tuple[tuple[Path, Path], tuple[Path, Path]],
    output: Parts,
    index: int,
    iterations: list[int],
) -> None:
    """Align at some iterations; `robots` are the (log, slam) folders of both.

    What is already on disk is kept: an interrupted run goes on after it.
    """
    wanted = {_batch_path(folder, index) for folder in (output.match, *output.aligners)}
    if all(path.is_file() for path in wanted):
        return
    a, b = (read_snapshots(slam_folder, read_log(log_folder)) for log_folder, slam_folder in robots)
    maps = {k: (map_at(a, k), map_at(b, k)) for k in iterations}
    offered = _offered_batch(scenario, maps, _batch_path(output.match, index))
    for entry, folder in zip(scenario.align.aligners, output.aligners, strict=True):
        path = _batch_path(folder, index)
        if not path.is_file():
            aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
            rows = [
                row
                for k, (map_a, map_b) in maps.items()
                for row in _estimate(scenario, entry, aligner, map_a, map_b, offered[k], k)
            ]
            tables.write(path, "estimates", rows)


def _offered_batch(
    scenario: Scenario, maps: dict[int, tuple[LandmarkMap, LandmarkMap]], path: Path
) -> dict[int, Correspondences]:
    """Correspondences by iteration, from the file if it is there, else made and written."""
    if not path.is_file():
        made = []
        for k, (map_a, map_b) in maps.items():
            names = {"robot_a": map_a.name, "robot_b": map_b.name, "iteration": k}
            made.append(_offered(names, match(map_a, map_b, scenario.align.match)))
        tables.write(path, "correspondences", pd.concat(made))
    rows = tables.read(path, "correspondences")
    return {k: correspondences_of(rows[rows["iteration"] == k]) for k in maps}


def map_at(maps: dict[int, LandmarkMap], iteration: int) -> LandmarkMap:
    """A robot's map at an iteration; a robot whose log ended earlier keeps its last map."""
    return maps[max((k for k in maps if k <= iteration), default=min(maps))]


def _offered(names: dict[str, Any], pairs: Correspondences) -> pd.DataFrame:
    return pd.DataFrame(
        {
            **names,
            "index_a": pairs.index_a,
            "index_b": pairs.index_b,
            "descriptor_distance": pairs.distance,
        }
    )


def _estimate(
    scenario: Scenario,
    entry: AlignerEntry,
    aligner: CallableAligner,
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    pairs: Correspondences,
    iteration: int,
) -> list[dict[str, Any]]:
    settings, seed = scenario.align, scenario.seed
    names = {"robot_a": map_a.name, "robot_b": map_b.name, "iteration": iteration}
    rows = []
    refinements: dict[object, Alignment] = {}  # repetitions often come to the very same estimate
    for repetition in range(settings.repetitions if aligner.randomised else 1):
        purpose = (map_a.name, map_b.name, iteration, entry.name, repetition)
        estimated = aligner.align(map_a, map_b, pairs, generator(seed, "align", *purpose))
        known = (estimated.T_a_b.tobytes(), estimated.status, estimated.reason)
        if known not in refinements:
            refinements[known] = refine_estimate(
                settings.refinement, map_a, map_b, pairs, estimated
            )
        rows.append(
            names
            | {"aligner": entry.name, "repetition": repetition}
            | estimate_row(len(pairs), estimated, refinements[known])
        )
    return rows


def estimate_row(
    n_correspondences: int, estimated: Alignment, refined: Alignment
) -> dict[str, Any]:
    """One estimate and its refinement as columns of the table `estimates`."""
    upper = refined.covariance[np.triu_indices(3)]
    return {
        "n_correspondences": n_correspondences,
        "status": str(estimated.status),
        "reason": estimated.reason,
        "tx_m": estimated.T_a_b[0],
        "ty_m": estimated.T_a_b[1],
        "theta_rad": estimated.T_a_b[2],
        "refined_status": str(refined.status),
        "refined_reason": refined.reason,
        "refined_tx_m": refined.T_a_b[0],
        "refined_ty_m": refined.T_a_b[1],
        "refined_theta_rad": refined.T_a_b[2],
        "drift_sigma_m": refined.drift_sigma_m,
        **dict(zip(_COVARIANCE_COLUMNS, upper, strict=True)),
        "inliers": np.packbits(estimated.inlier).tobytes(),
        "refined_inliers": np.packbits(refined.inlier).tobytes(),
    }


def inlier_mask(bits: bytes, n_correspondences: int) -> np.ndarray:
    """The mask (n,) that `estimate_row` packed."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=n_correspondences).astype(bool)


def alignment_of(row: Mapping[Any, Any], n_correspondences: int) -> Alignment:
    """The refined alignment that a row of the table `estimates` tells of."""
    covariance = np.empty((3, 3))
    covariance[np.triu_indices(3)] = [row[name] for name in _COVARIANCE_COLUMNS]
    covariance.T[np.triu_indices(3)] = covariance[np.triu_indices(3)]
    return Alignment(
        np.array([row["refined_tx_m"], row["refined_ty_m"], row["refined_theta_rad"]]),
        covariance,
        inlier_mask(row["refined_inliers"], n_correspondences),
        np.nan,
        Status(row["refined_status"]),
        row["refined_reason"],
        row["drift_sigma_m"],
    )


def correspondences_of(rows: pd.DataFrame) -> Correspondences:
    """The correspondences that rows of one pair and iteration hold."""
    return Correspondences(
        rows["index_a"].to_numpy(dtype=np.int64),
        rows["index_b"].to_numpy(dtype=np.int64),
        rows["descriptor_distance"].to_numpy(dtype=np.float64),
    )


def finish(output: StageFolder, made: Parts, n_batches: int, started: float) -> None:
    """Join the batches in order of iteration and mark the stage as finished."""
    sources = {"estimates": made.aligners, "correspondences": (made.match,)}
    for name, folders in sources.items():
        paths = [_batch_path(folder, i) for i in range(n_batches) for folder in folders]
        joined = pd.concat([tables.read(path, name) for path in paths], ignore_index=True)
        # within an iteration the aligners stay in their order
        joined = joined.sort_values("iteration", kind="stable", ignore_index=True)
        tables.write(output.path / f"{name}.parquet", name, joined)
    output.finish(elapsed_s=time.perf_counter() - started)
