"""Stage: all aligners on the correspondences of one robot pair, at each evaluated iteration."""

import functools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from experiments.methods.aligner_calls import CallableAligner, callable_aligner, refine_estimate
from experiments.run.estimates import correspondences_of, estimate_row
from experiments.run.frames import read_rows, write_rows
from experiments.run.sources import imported_sources, method_sources
from experiments.run.stage_tables import CORRESPONDENCES, ESTIMATES
from experiments.run.stages.slam import RobotFolders, read_snapshots
from experiments.run.store import StageFolder, Store
from experiments.scenario.randomness import generator
from experiments.scenario.settings import AlignerEntry, Scenario
from mapfusion.align.acceptance import Verdict
from mapfusion.align.correspondences import Correspondences, match
from mapfusion.align.plugins import Method
from mapfusion.align.registry import find_method
from mapfusion.align.result import Alignment
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import read_log

_OWN_SOURCES = (
    "experiments/run/stages/align.py",
    "experiments/run/estimates.py",
    "experiments/run/frames.py",
    "experiments/run/stage_tables.py",
    "experiments/scenario/randomness.py",
    "experiments/methods/aligner_calls.py",
    "experiments/methods/isolation.py",
    "experiments/methods/isolated_child.py",
    "experiments/methods/one_thread.py",
    "mapfusion/align/sanity.py",
)

# Evaluated iterations a task: small enough that an interruption loses little and two cores end
# at about the same time, large enough that reading the maps costs little beside aligning them.
ITERATIONS_PER_BATCH = 12


def match_sources() -> tuple[str, ...]:
    """Source behind the correspondences; not the methods', which change more often."""
    return _OWN_SOURCES + imported_sources("mapfusion.align.correspondences", "mapfusion.robot_log")


def aligner_sources(method: Method) -> tuple[str, ...]:
    """Source behind one method's estimates, refined and judged; no other method's."""
    return (
        _OWN_SOURCES
        + imported_sources("mapfusion.align.refine", "mapfusion.align.acceptance")
        + method_sources(method)
    )


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
    write_rows(batch_path(output, index), CORRESPONDENCES, pd.concat(made))
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
    pairs = read_rows(batch_path(offered, index), CORRESPONDENCES)
    aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
    rows = []
    for k, map_a, map_b in _pairs_of_maps(robots, iterations):
        offered_here = correspondences_of(pairs[pairs["iteration"] == k])
        rows += _estimate(scenario, entry, aligner, map_a, map_b, offered_here, k)
    write_rows(batch_path(output, index), ESTIMATES, rows)
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
    # repetitions often come to the very same estimate
    refinements: dict[object, tuple[Alignment, Verdict]] = {}
    chance = settings.acceptance.against_chance(map_a, map_b, pairs)
    for repetition in range(settings.repetitions if aligner.randomised else 1):
        purpose = (map_a.name, map_b.name, iteration, entry.name, repetition)
        estimated = aligner.align(map_a, map_b, pairs, generator(seed, "align", *purpose))
        known = (estimated.T_a_b.tobytes(), estimated.status, estimated.reason)
        if known not in refinements:
            refined = refine_estimate(settings.refinement, map_a, map_b, pairs, estimated)
            refinements[known] = refined, chance.judge(refined)
        rows.append(
            names
            | {"aligner": entry.name, "repetition": repetition}
            | estimate_row(len(pairs), estimated, *refinements[known])
        )
    return rows


def finish(output: StageFolder, made: Parts, n_batches: int) -> None:
    """Join the batches in order of iteration and mark the stage as finished."""
    started = time.perf_counter()
    sources = (("estimates", ESTIMATES, made.aligners),)
    sources += (("correspondences", CORRESPONDENCES, (made.match,)),)
    for name, schema, folders in sources:
        paths = [batch_path(folder, i) for i in range(n_batches) for folder in folders]
        joined = pd.concat([read_rows(path, schema) for path in paths], ignore_index=True)
        # within an iteration the aligners stay in their order
        joined = joined.sort_values("iteration", kind="stable", ignore_index=True)
        write_rows(output.path / f"{name}.parquet", schema, joined)
    parts_s = sum(folder.noted().get("elapsed_s", 0.0) for folder in (made.match, *made.aligners))
    output.finish(elapsed_s=parts_s + time.perf_counter() - started)
