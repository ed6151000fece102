"""Stage: all aligners on the correspondences of one robot pair, at each evaluated iteration."""

import functools
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments import tables
from experiments.methods.aligner_calls import callable_aligner
from experiments.methods.catalogue import find_method
from experiments.methods.installed import KnownMethod
from experiments.randomness import generator
from experiments.scenario import AlignerEntry, Scenario
from experiments.sources import imported_sources, method_sources
from experiments.stages.slam import RobotFolders, read_snapshots
from experiments.store import StageFolder, Store
from mapfusion.align.acceptance import Verdict
from mapfusion.align.correspondences import Correspondences, match
from mapfusion.align.registration import Registration
from mapfusion.align.result import Alignment, Status
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import read_log

_OWN_SOURCES = (
    "experiments/stages/align.py",
    "experiments/tables.py",
    "experiments/randomness.py",
    "experiments/methods",
)

# Evaluated iterations a task: small enough that an interruption loses little and two cores end
# at about the same time, large enough that reading the maps costs little beside aligning them.
ITERATIONS_PER_BATCH = 12
_UPPER = np.triu_indices(3)
_COVARIANCE_COLUMNS = ("cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt")


def match_sources() -> tuple[str, ...]:
    """Source behind the correspondences; not the methods', which change more often."""
    return _OWN_SOURCES + imported_sources("mapfusion.align.correspondences", "mapfusion.robot_log")


def aligner_sources(method: KnownMethod) -> tuple[str, ...]:
    """Source behind one method's estimates, refined and judged; no other method's."""
    return _OWN_SOURCES + imported_sources("mapfusion.align.registration") + method_sources(method)


class Parts(NamedTuple):
    """Where the batches of one robot pair lie, apart for each aligner.

    So a run in which one aligner has changed takes all others' estimates as they are.
    """

    match: StageFolder
    aligners: tuple[StageFolder, ...]


def stage(store: Store, made: Parts) -> StageFolder:
    """Where the joined estimates of this pair of robots are or will be."""
    return store.stage("align", {}, [made.match, *made.aligners], _OWN_SOURCES)


def parts(store: Store, scenario: Scenario, slam_a: StageFolder, slam_b: StageFolder) -> Parts:
    """Where the pair's batches are or will be."""
    resolved = scenario.align.model_dump(mode="json")
    match_folder = store.stage("match", resolved["match"], [slam_a, slam_b], match_sources())
    common = {"seed": scenario.seed}
    common |= {name: resolved[name] for name in ("refinement", "acceptance", "repetitions")}

    def of(entry: AlignerEntry) -> StageFolder:
        method = find_method(entry.method)
        settings = common | {"entry": entry.model_dump(mode="json"), "origin": method.origin()}
        return store.stage("aligner", settings, [match_folder], aligner_sources(method))

    return Parts(match_folder, tuple(of(entry) for entry in scenario.align.aligners))


def batches(iterations: list[int]) -> list[list[int]]:
    """Evaluated iterations shared out into tasks."""
    starts = range(0, len(iterations), ITERATIONS_PER_BATCH)
    return [iterations[start : start + ITERATIONS_PER_BATCH] for start in starts]


def batch_path(folder: StageFolder, index: int) -> Path:
    """Where a part keeps one batch."""
    return folder.path / f"batch_{index:03d}.parquet"


# The maps of one pair of robots stay in memory: each aligner of the pair wants the same.
@functools.lru_cache(maxsize=2)
def _maps(log: Path, slam: Path) -> dict[int, LandmarkMap]:
    return read_snapshots(slam, read_log(log))


def _pairs_of_maps(
    robots: tuple[RobotFolders, RobotFolders], iterations: list[int]
) -> Iterator[tuple[int, LandmarkMap, LandmarkMap]]:
    a, b = (_maps(*folders) for folders in robots)
    return ((k, map_at(a, k), map_at(b, k)) for k in iterations)


def run_match(
    scenario: Scenario,
    robots: tuple[RobotFolders, RobotFolders],
    output: StageFolder,
    index: int,
    iterations: list[int],
) -> None:
    """Find the correspondences of one batch of iterations."""
    started = time.perf_counter()
    made = []
    for k, map_a, map_b in _pairs_of_maps(robots, iterations):
        names = {"robot_a": map_a.name, "robot_b": map_b.name, "iteration": k}
        made.append(_offered(names, match(map_a, map_b, scenario.align.match)))
    tables.write(batch_path(output, index), "correspondences", pd.concat(made))
    output.note(f"{index:03d}", elapsed_s=time.perf_counter() - started)


def run_aligner(
    scenario: Scenario,
    entry: AlignerEntry,
    robots: tuple[RobotFolders, RobotFolders],
    offered: StageFolder,
    output: StageFolder,
    index: int,
    iterations: list[int],
) -> None:
    """Let one aligner estimate at one batch of iterations, on what the match stage offers."""
    started = time.perf_counter()
    pairs = tables.read(batch_path(offered, index), "correspondences")
    aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
    settings = scenario.align
    registration = Registration(aligner, settings.refinement, settings.acceptance)
    rows = []
    for k, map_a, map_b in _pairs_of_maps(robots, iterations):
        offered_here = correspondences_of(pairs[pairs["iteration"] == k])
        rows += _estimate(scenario, entry.name, registration, map_a, map_b, offered_here, k)
    tables.write(batch_path(output, index), "estimates", rows)
    output.note(f"{index:03d}", elapsed_s=time.perf_counter() - started)


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
    name: str,
    registration: Registration,
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    pairs: Correspondences,
    iteration: int,
) -> list[dict[str, Any]]:
    names = {"robot_a": map_a.name, "robot_b": map_b.name, "iteration": iteration}
    rows = []
    on_pair = registration.on(map_a, map_b, pairs)
    for repetition in range(scenario.align.repetitions if registration.randomised else 1):
        purpose = (map_a.name, map_b.name, iteration, name, repetition)
        done = on_pair.register(generator(scenario.seed, "align", *purpose))
        rows.append(
            names | {"aligner": name, "repetition": repetition} | estimate_row(len(pairs), *done)
        )
    return rows


def estimate_row(
    n_correspondences: int, estimated: Alignment, refined: Alignment, verdict: Verdict
) -> dict[str, Any]:
    """One estimate, its refinement and the verdict on it as columns of the table `estimates`."""
    upper = refined.covariance[_UPPER]
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
        "accepted": verdict.accepted,
        "log10_false_alarms": verdict.log10_false_alarms,
        "acceptance_reason": verdict.reason,
        "drift_sigma_m": refined.drift_sigma_m,
        **dict(zip(_COVARIANCE_COLUMNS, upper, strict=True)),
        "inliers": np.packbits(estimated.inlier).tobytes(),
        "refined_inliers": np.packbits(refined.inlier).tobytes(),
    }


def inlier_mask(bits: bytes, n_correspondences: int) -> np.ndarray:
    """The mask (n,) that `estimate_row` packed."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=n_correspondences).astype(bool)


def alignment_of(row: Mapping[Any, Any], n_correspondences: int) -> Alignment:
    """The refined alignment a row of `estimates` tells of, refused where the verdict says so."""
    covariance = np.empty((3, 3))
    covariance[_UPPER] = [row[name] for name in _COVARIANCE_COLUMNS]
    covariance.T[_UPPER] = covariance[_UPPER]
    verdict = Verdict(bool(row["accepted"]), row["log10_false_alarms"], row["acceptance_reason"])
    refined = Alignment(
        np.array([row["refined_tx_m"], row["refined_ty_m"], row["refined_theta_rad"]]),
        covariance,
        inlier_mask(row["refined_inliers"], n_correspondences),
        np.nan,
        Status(row["refined_status"]),
        row["refined_reason"],
        row["drift_sigma_m"],
    )
    return verdict.applied_to(refined)


def correspondences_of(rows: pd.DataFrame) -> Correspondences:
    """The correspondences that rows of one pair and iteration hold."""
    return Correspondences(
        rows["index_a"].to_numpy(dtype=np.int64),
        rows["index_b"].to_numpy(dtype=np.int64),
        rows["descriptor_distance"].to_numpy(dtype=np.float64),
    )


def finish(output: StageFolder, made: Parts, n_batches: int) -> None:
    """Join the batches in order of iteration and mark the stage as finished."""
    started = time.perf_counter()
    sources = {"estimates": made.aligners, "correspondences": (made.match,)}
    for name, folders in sources.items():
        paths = [batch_path(folder, i) for i in range(n_batches) for folder in folders]
        joined = pd.concat([tables.read(path, name) for path in paths], ignore_index=True)
        # within an iteration the aligners stay in their order
        joined = joined.sort_values("iteration", kind="stable", ignore_index=True)
        tables.write(output.path / f"{name}.parquet", name, joined)
    parts_s = sum(folder.noted().get("elapsed_s", 0.0) for folder in (made.match, *made.aligners))
    output.finish(elapsed_s=parts_s + time.perf_counter() - started)
