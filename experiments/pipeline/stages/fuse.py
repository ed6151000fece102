"""Stage: one fuser's maps of all robots together, at each iteration that maps are fused at.

The maps, the alignments and what the team says of them are the same for all fusers; those that
take smoothed maps are given these, where there are any.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job
from experiments.pipeline.stages import match
from experiments.pipeline.stages.slam import RobotFolders, log_as_filtered, stored_maps
from experiments.pipeline.stages.smooth import (
    log_until,
    read_smoothed,
    read_smoothed_path,
    smoothed_owners,
)
from experiments.pipeline.tables import (
    CORRESPONDENCES,
    COVARIANCE,
    ESTIMATES,
    FLOAT,
    INT,
    TEXT,
    alignment_of,
    correspondences_of,
    covariances_of,
    fields,
    read_rows,
    write_rows,
)
from mapfusion.files import (
    COVARIANCE_FIELDS,
    POSE_FIELDS,
    POSITION_FIELDS,
    covariance_columns,
    float_fields,
    named_columns,
    point_columns,
    point_fields,
    points_from,
    schema,
)
from mapfusion.fusion.aligned_landmarks import ABSENT
from mapfusion.fusion.fused_map import AlignedPair, FusedMap, MergeParameters
from mapfusion.fusion.fusers import make_fuser
from mapfusion.fusion.merge import ConnectedMaps, connect
from mapfusion.landmark_map import LandmarkMap, read_map, write_map
from mapfusion.smoother.joint_smoothing import Recording
from mapfusion.smoother.smooth import SmootherParameters

LABEL = "fuse the maps"
WRITES = ("landmarks.parquet", "parents.parquet", "motions.parquet", "map.parquet")
_OF = {"iteration": INT, "component": INT}  # the component of the most robots is 1
LANDMARKS = schema("fuse.landmarks", 1, [*fields(**_OF, count=INT), *point_fields()])
# Which landmarks of the robots' maps at that iteration went into the fused ones.
PARENTS = schema("fuse.parents", 1, fields(**_OF, landmark=INT, robot=TEXT, parent=INT))
# How the robots' maps were moved; of robots that are in no component nothing is said.
MOTIONS = schema(
    "fuse.motions",
    1,
    [
        *fields(**_OF, robot=TEXT),
        *float_fields([*POSE_FIELDS, *COVARIANCE]),
        *fields(drift_sigma_m=FLOAT, duplicate_share=FLOAT, fallback=TEXT),
    ],
)


@dataclass(frozen=True)
class FuseSettings:
    """All that a fuser's maps depend on, beside the robots' and their alignments.

    `origin` says where a fuser that is not ours comes from; empty for ours.
    """

    fuser: str
    origin: str
    parameters: MergeParameters
    smoother: SmootherParameters
    noise_floor_m: float
    robots: tuple[str, ...]
    iterations: tuple[int, ...]


@dataclass(frozen=True)
class GivenTeam:
    """What a team's robots have at an iteration, in their order, and how their maps were aligned.

    Attributes:
        maps: the filter's.
        pairs: the alignments of these.
        smoothed: for fusers that take them; the filter's where there is none.
        recordings: what those were smoothed from.
    """

    maps: Sequence[LandmarkMap]
    pairs: Sequence[AlignedPair]
    smoothed: Sequence[LandmarkMap]
    recordings: Sequence[Recording | None]

    def connected(self, settings: FuseSettings) -> ConnectedMaps:
        """The maps placed by the alignments that the team believes."""
        return connect(self.maps, self.pairs, settings.parameters.team)

    def fused(self, connected: ConnectedMaps, settings: FuseSettings) -> Sequence[FusedMap]:
        """All components made maps."""
        fuser, given = make_fuser(settings.fuser), (self.smoothed, self.recordings)
        return connected.fused_by(fuser, settings.parameters, *given).fused


@dataclass(frozen=True)
class _Robot:
    """What is known of a robot at all iterations."""

    filtered: Mapping[int, LandmarkMap]
    smoothed: Mapping[int, LandmarkMap]  # none for a fuser that does not take them


def run(settings: FuseSettings, job: Job) -> dict[str, float]:
    """Fuse the maps at each iteration; write the maps, their parents and their motions."""
    fusions, times = {}, {}
    for k, given in given_teams(settings, job):
        connected = given.connected(settings)
        started_s = time.perf_counter()
        fusions[k] = given.fused(connected, settings)
        times[f"{settings.fuser}:{k}"] = time.perf_counter() - started_s
    write_fusions(job.output, fusions, settings.robots)
    return times


def given_teams(settings: FuseSettings, job: Job) -> Iterator[tuple[int, GivenTeam]]:
    """What there is to be fused, at each iteration."""
    takes, viewing = make_fuser(settings.fuser).smoothed, bool(settings.origin)
    robots = {name: _read_robot(job, name, takes, viewing) for name in settings.robots}
    alignments = _alignments(settings, job)
    for k in settings.iterations:
        given, recordings = [], list[Recording | None]()
        for name, robot in robots.items():
            known = {i: own for i, own in robot.smoothed.items() if i <= k}
            given.append(_at(known, k) if known else _at(robot.filtered, k))
            recordings.append(_recording(settings, job, name, known))
        maps = [_at(robot.filtered, k) for robot in robots.values()]
        pairs = [pair for each in alignments if (pair := each.at(k)) is not None]
        yield k, GivenTeam(maps, pairs, given, recordings)


def _read_robot(job: Job, name: str, smoothed: bool, viewing: bool) -> _Robot:
    """What there is of a robot; with viewing evidence, which none of our fusers looks at, if so."""
    folders = RobotFolders(job.inputs[f"log {name}"], job.inputs[f"slam {name}"])
    maps = read_smoothed(job.inputs[f"smooth {name}"]) if smoothed else {}
    return _Robot(stored_maps(folders, viewing), maps)


def _at(maps: Mapping[int, LandmarkMap], iteration: int) -> LandmarkMap:
    """A robot's map at an iteration; its last one if its log ended earlier."""
    return maps[max(k for k in maps if k <= iteration)]


def _recording(
    settings: FuseSettings,
    job: Job,
    name: str,
    smoothed: Mapping[int, LandmarkMap],
) -> Recording | None:
    """What the last smoothed map was made of, and the path that was found; None without a map."""
    if not smoothed:
        return None
    k = max(smoothed)
    smooth, slam = (job.inputs[f"{stage} {name}"] for stage in ("smooth", "slam"))
    log, covariance = log_as_filtered(job.inputs[f"log {name}"], slam)
    log = log_until(log, k, settings.noise_floor_m)
    landmark = smoothed_owners(smooth, slam, k, len(log.observations))
    path = read_smoothed_path(smooth)[k]
    smoother = replace(settings.smoother, odometry_covariance=covariance)
    return Recording(log, landmark, path, smoother)


class _Alignments:
    """What the aligner that maps are merged by said of two robots' maps, its first repetition."""

    def __init__(self, settings: FuseSettings, job: Job, name_a: str, name_b: str) -> None:
        self._a, self._b = (settings.robots.index(name) for name in (name_a, name_b))
        self._offered = match.read_batches(job.inputs[f"match {name_a} {name_b}"], CORRESPONDENCES)
        rows = match.read_batches(job.inputs[f"aligner {name_a} {name_b}"], ESTIMATES)
        self._rows = rows[rows["repetition"] == 0].sort_values("iteration")

    def at(self, iteration: int) -> AlignedPair | None:
        """At an iteration; None before the aligner was first asked."""
        known = self._rows[self._rows["iteration"] <= iteration]
        if known.empty:
            return None
        row = known.iloc[-1].to_dict()
        pairs = correspondences_of(self._offered[self._offered["iteration"] == row["iteration"]])
        alignment = alignment_of(row, len(pairs))
        return AlignedPair(self._a, self._b, alignment, pairs, row["log10_false_alarms"])


def _alignments(settings: FuseSettings, job: Job) -> list[_Alignments]:
    """Of all pairs of robots that were aligned."""
    asked = (name.split(" ") for name in job.inputs)
    return [_Alignments(settings, job, *both) for kind, *both in asked if kind == "aligner"]


def _map_path(folder: Path, component: int = 1) -> Path:
    """Where the last map of a component is; those beyond the first have their number in it."""
    return folder / ("map.parquet" if component == 1 else f"map.{component}.parquet")


def write_fusions(
    folder: Path, fusions: Mapping[int, Sequence[FusedMap]], robots: Sequence[str]
) -> None:
    """All components by iteration; those of the last also whole, with their joint covariances."""
    names = np.array(robots, dtype=object)
    landmarks, parents, motions = [], [], []
    for k, fused in fusions.items():
        for component, each in enumerate(fused, start=1):
            of, own = {"iteration": k, "component": component}, each.landmarks
            points = point_columns(own.position_m, own.covariance_m2) | {"count": own.count}
            landmarks.append(pd.DataFrame(points).assign(**of))
            row, place = np.nonzero(each.parents != ABSENT)
            went = {"landmark": row, "robot": names[place], "parent": each.parents[row, place]}
            parents.append(pd.DataFrame(went).assign(**of))
            motions.append(_motion_rows(each, robots).assign(**of))
    for component, each in enumerate(fusions[max(fusions)], start=1):
        write_map(_map_path(folder, component), each.landmarks)
    tables = ((LANDMARKS, landmarks), (PARENTS, parents), (MOTIONS, motions))
    for file, (table, rows) in zip(WRITES[:3], tables, strict=True):
        write_rows(folder / file, table, pd.concat(rows))


def _motion_rows(fused: FusedMap, robots: Sequence[str]) -> pd.DataFrame:
    members = fused.members
    motion = named_columns(POSE_FIELDS, fused.T_first_map[members])
    motion |= covariance_columns(COVARIANCE, fused.motion_covariance[members])
    motion |= {"robot": [robots[k] for k in members]}
    motion["drift_sigma_m"] = fused.drift_sigma_m[members]
    about = {"duplicate_share": fused.duplicate_share, "fallback": fused.fallback}
    return pd.DataFrame(motion).assign(**about)


def read_fusions(folder: Path, robots: Sequence[str]) -> dict[int, FusedMap]:
    """The map of the most robots at each iteration, without the reasons of those left out.

    The last one is whole; earlier ones have neither descriptors nor joint covariances.
    """
    last, place = read_map(_map_path(folder)), {name: k for k, name in enumerate(robots)}
    tables = (
        read_rows(folder / file, table)
        for file, table in zip(WRITES[:3], (LANDMARKS, PARENTS, MOTIONS), strict=True)
    )
    landmarks, *of_robots = (rows[rows["component"] == 1] for rows in tables)
    parents, motions = (rows.assign(robot=rows["robot"].map(place)) for rows in of_robots)
    found = {}
    for k in sorted(motions["iteration"].unique().tolist()):  # a map may have no landmarks
        own, of, moved = (rows[rows["iteration"] == k] for rows in (landmarks, parents, motions))
        found[k] = _fused(own, of, moved, len(robots), last)
    if found:
        found[k] = replace(found[k], landmarks=last)
    return found


def _fused(
    landmarks: pd.DataFrame,
    parents: pd.DataFrame,
    motions: pd.DataFrame,
    n_robots: int,
    last: LandmarkMap,
) -> FusedMap:
    columns = {name: landmarks[name].to_numpy() for name in POSITION_FIELDS + COVARIANCE_FIELDS}
    origin = np.full(len(landmarks), ABSENT, dtype=np.int64)
    count = landmarks["count"].to_numpy(np.int32)
    made = LandmarkMap(
        *points_from(pa.table(columns)), count, origin, planar=last.planar, name=last.name
    )
    of = np.full((len(landmarks), n_robots), ABSENT)
    of[parents["landmark"], parents["robot"]] = parents["parent"]
    at = motions["robot"].to_numpy()
    T, covariance = np.full((n_robots, 3), np.nan), np.full((n_robots, 3, 3), np.nan)
    drift = np.full(n_robots, np.nan)
    T[at], drift[at] = motions[POSE_FIELDS], motions["drift_sigma_m"]
    covariance[at] = covariances_of(motions)
    said = motions.iloc[0]
    duplicates, fallback = float(said["duplicate_share"]), str(said["fallback"])
    return FusedMap(made, of, T, covariance, drift, duplicates, (), fallback)


def fused_map_files(folder: Path) -> list[Path]:
    """The files of the last maps of all components, that of the most robots first."""
    motions = read_rows(folder / WRITES[2], MOTIONS)
    of_last = motions[motions["iteration"] == motions["iteration"].max()]
    return [_map_path(folder, k) for k in range(1, 1 + int(of_last["component"].max()))]
