"""Stage: correspondences and rival motions of two robots' maps, in batches of iterations."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.slam import (
    ROBOTS_KEPT,
    RobotFolders,
    Snapshots,
    folders_of_both,
    stored_maps,
)
from experiments.pipeline.tables import CORRESPONDENCES, RIVALS, read_rows, rival_rows, write_rows
from mapfusion.align.alignment import Pairs
from mapfusion.align.correspondences import MatchParameters, match
from mapfusion.align.refinement import Refinement
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.regions import EvidenceParameters, ViewedMap
from mapfusion.verification.verdict import Verifier, why_not_sought

# Evaluated iterations per part: small enough that an interruption loses little and all cores end at
# about the same time, large enough that reading the maps is fast compared to their alignment.
_ITERATIONS_PER_BATCH = 12
_Known = TypeVar("_Known")
LABEL = "align the maps"
WRITES = ("batch_{part}.parquet", "rivals_{part}.parquet")


@dataclass(frozen=True)
class MatchSettings:
    """Settings of correspondences and rivals, in addition to the maps."""

    match: MatchParameters
    acceptance: Acceptance
    evidence: EvidenceParameters
    refinement: Refinement
    iterations: tuple[int, ...]


def run(settings: MatchSettings, job: Job) -> None:
    """Find correspondences and rival motions of one batch of iterations."""
    made, rivals = [], []
    judge = Verifier(settings.acceptance, settings.evidence, settings.refinement)
    for k, map_a, map_b in pairs_of_maps(job, settings.iterations):
        pairs = match(map_a, map_b, settings.match)
        names = {"robot_a": map_a.name, "robot_b": map_b.name, "iteration": k}
        viewed_maps = None
        if not why_not_sought(map_a, map_b):
            a, b = folders_of_both(job)
            viewed_maps = _viewed_map(a, k), _viewed_map(b, k)
        if evidence := judge.on(Pairs(map_a, map_b, pairs), viewed_maps=viewed_maps).evidence:
            rivals += rival_rows(names, evidence)
        columns = names | {"index_a": pairs.index_a, "index_b": pairs.index_b}
        made.append(pd.DataFrame(columns | {"descriptor_distance": pairs.distance}))
    write_rows(batch_path(job.output, job.part), CORRESPONDENCES, pd.concat(made))
    write_rows(rivals_path(job.output, job.part), RIVALS, rivals)


@functools.lru_cache(maxsize=ROBOTS_KEPT * _ITERATIONS_PER_BATCH)
def _viewed_map(folders: RobotFolders, iteration: int) -> ViewedMap:
    """Return a robot's map with its cached queries, which all pairs of the robot share."""
    return ViewedMap(latest_at(stored_maps(folders), iteration))


def batches(iterations: tuple[int, ...]) -> tuple[str, ...]:
    """Return the numbered parts of this stage and of the aligners' stages."""
    return tuple(f"{i:03d}" for i in range(-(-len(iterations) // _ITERATIONS_PER_BATCH)))


def batch_path(folder: Path, part: str) -> Path:
    """Return the path of one batch of a stage."""
    return folder / WRITES[0].format(part=part)


def read_batches(folder: Path, table_schema: pa.Schema) -> pd.DataFrame:
    """Read all batches of a folder of this stage or of an aligner, in order."""
    paths = sorted(folder.glob(WRITES[0].format(part="*")))
    return pd.concat([read_rows(path, table_schema) for path in paths], ignore_index=True)


def rivals_path(folder: Path, part: str) -> Path:
    """Return the path of the rivals of one batch."""
    return folder / WRITES[1].format(part=part)


def maps_of_both(job: Job) -> list[Snapshots]:
    """Return all maps of the job's two robots, by iteration."""
    return [stored_maps(folders) for folders in folders_of_both(job)]


def pairs_of_maps(
    job: Job, iterations: tuple[int, ...]
) -> Iterator[tuple[int, LandmarkMap, LandmarkMap]]:
    """Yield (iteration, map a, map b) of the job's batch."""
    a, b = maps_of_both(job)
    start = int(job.part) * _ITERATIONS_PER_BATCH
    for k in iterations[start : start + _ITERATIONS_PER_BATCH]:
        yield k, latest_at(a, k), latest_at(b, k)


def latest_at(known: Mapping[int, _Known], iteration: int) -> _Known:
    """Return a robot's value at an iteration; the last one if the log ended earlier."""
    return known[max((k for k in known if k <= iteration), default=min(known))]
