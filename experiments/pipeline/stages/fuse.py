"""Stage: maps of all robots fused by one fuser, at each iteration at which maps are fused.

Fusers of smoothed maps get the smoothed maps and their alignments, other fusers those of the
filter. The alignments of the same maps are the same for all fusers.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job, StageKind
from experiments.pipeline.stages import align
from experiments.pipeline.stages.align import alignment_of, correspondences_of
from experiments.pipeline.stages.smooth import (
    RobotFolders,
    latest_at,
    log_to_smooth,
    log_until,
    maps_of,
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
from mapfusion.fusion.fusers import AlignedPair, FusedMap, MergeParameters, make_fuser
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import ConnectedMaps, connect
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap, read_map, write_map
from mapfusion.smoother.smooth import AssociatedLog, SmootherParameters

WRITES = ("landmarks.parquet", "parents.parquet", "motions.parquet", "map.parquet")
_OF = {"iteration": INT, "component": INT}  # component 1 has the most robots
LANDMARKS = schema("fuse.landmarks", 1, [*fields(**_OF, count=INT), *point_fields()])
# Landmarks of the robots' maps that were fused into each landmark.
PARENTS = schema("fuse.parents", 1, fields(**_OF, landmark=INT, robot=TEXT, parent=INT))
# Motions of the robots' maps; robots outside all components have no row.
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
    """Settings of fused maps, in addition to the robots' maps and their alignments.

    `origin` identifies a plug-in fuser; empty for ours.
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
    """Maps and alignments of a team at an iteration, in the order of the robots.

    Attributes:
        maps: smoothed maps for fusers that take them, else maps of the filter.
        pairs: alignments of these maps.
        recordings: inputs of the smoothed maps; None for maps of the filter.
    """

    maps: Sequence[LandmarkMap]
    pairs: Sequence[AlignedPair]
    recordings: Sequence[AssociatedLog | None]

    def connected(self, settings: FuseSettings) -> ConnectedMaps:
        """Connect the maps by the alignments that the team accepts."""
        return connect(self.maps, self.pairs, settings.parameters.team)

    def fused(self, connected: ConnectedMaps, settings: FuseSettings) -> Sequence[FusedMap]:
        """Fuse the maps of each component."""
        fuser = make_fuser(settings.fuser)
        return connected.fused_by(fuser, settings.parameters, self.recordings).fused


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


FUSE_STAGE = StageKind("fuse", "fuse the maps", run, WRITES)


def given_teams(settings: FuseSettings, job: Job) -> Iterator[tuple[int, GivenTeam]]:
    """Yield each iteration with the maps to be fused and their alignments."""
    takes_smoothed = make_fuser(settings.fuser).smoothed
    # our fusers do not use viewing evidence
    viewing = bool(settings.origin)
    maps: dict[str, Mapping[int, LandmarkMap]] = {}
    paths: dict[str, Mapping[int, Float]] = {}
    for name in settings.robots:
        log, slam, smooth = (job.inputs[f"{stage} {name}"] for stage in ("log", "slam", "smooth"))
        folders = RobotFolders(log, slam, smooth if takes_smoothed else None)
        maps[name] = maps_of(folders, smoothed=takes_smoothed, viewing=viewing)
        paths[name] = read_smoothed_path(smooth) if takes_smoothed else {}
    asked = (name.split(" ") for name in job.inputs)
    alignments = [_Alignments(settings, job, *both) for kind, *both in asked if kind == "aligner"]
    for k in settings.iterations:
        recordings: list[AssociatedLog | None] = []
        for name in settings.robots:
            known = [i for i in paths[name] if i <= k]
            if not known:
                recordings.append(None)
                continue
            smooth, slam = (job.inputs[f"{stage} {name}"] for stage in ("smooth", "slam"))
            log, smoother = log_to_smooth(job.inputs[f"log {name}"], slam, settings.smoother)
            log = log_until(log, max(known), settings.noise_floor_m)
            landmark = smoothed_owners(smooth, slam, max(known), len(log.observations))
            path = paths[name][max(known)]
            recordings.append(AssociatedLog(log, landmark, path, smoother))
        pairs = [pair for each in alignments if (pair := each.at(k)) is not None]
        given = [latest_at(maps[name], k) for name in settings.robots]
        yield k, GivenTeam(given, pairs, recordings)


class _Alignments:
    """Alignments of two robots' maps by the aligner that maps are merged by."""

    def __init__(self, settings: FuseSettings, job: Job, name_a: str, name_b: str) -> None:
        self._a, self._b = (settings.robots.index(name) for name in (name_a, name_b))
        self._offered = align.read_batches(job.inputs[f"match {name_a} {name_b}"], CORRESPONDENCES)
        rows = align.read_batches(job.inputs[f"aligner {name_a} {name_b}"], ESTIMATES)
        self._rows = rows[rows["repetition"] == 0].sort_values("iteration")

    def at(self, iteration: int) -> AlignedPair | None:
        """Return the alignment at an iteration; None before the first one."""
        known = self._rows[self._rows["iteration"] <= iteration]
        if known.empty:
            return None
        row = known.iloc[-1].to_dict()
        pairs = correspondences_of(self._offered[self._offered["iteration"] == row["iteration"]])
        alignment = alignment_of(row, len(pairs))
        return AlignedPair(self._a, self._b, alignment, pairs, row["log10_false_alarms"])


def _map_path(folder: Path, component: int = 1) -> Path:
    """Return the path of the last map of a component."""
    return folder / ("map.parquet" if component == 1 else f"map.{component}.parquet")


def write_fusions(
    folder: Path, fusions: Mapping[int, Sequence[FusedMap]], robots: Sequence[str]
) -> None:
    """Write all components by iteration, and the last maps with their joint covariances."""
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
            members = each.members
            motion = named_columns(POSE_FIELDS, each.T_first_map[members])
            motion |= covariance_columns(COVARIANCE, each.motion_covariance[members])
            motion |= {"robot": [robots[k] for k in members]}
            motion["drift_sigma_m"] = each.drift_sigma_m[members]
            about = {"duplicate_share": each.duplicate_share, "fallback": each.fallback}
            motions.append(pd.DataFrame(motion).assign(**about, **of))
    for component, each in enumerate(fusions[max(fusions)], start=1):
        write_map(_map_path(folder, component), each.landmarks)
    tables = ((LANDMARKS, landmarks), (PARENTS, parents), (MOTIONS, motions))
    for file, (table, rows) in zip(WRITES[:3], tables, strict=True):
        write_rows(folder / file, table, pd.concat(rows))


def read_fusions(folder: Path, robots: Sequence[str]) -> dict[int, FusedMap]:
    """Read the map of the most robots at each iteration, without reasons for excluded robots.

    Maps before the last one have neither descriptors nor joint covariances.
    """
    last, place = read_map(_map_path(folder)), {name: k for k, name in enumerate(robots)}
    tables = (
        read_rows(folder / file, table)
        for file, table in zip(WRITES[:3], (LANDMARKS, PARENTS, MOTIONS), strict=True)
    )
    landmarks, *of_robots = (rows[rows["component"] == 1] for rows in tables)
    parents, motions = (rows.assign(robot=rows["robot"].map(place)) for rows in of_robots)
    n_robots, found = len(robots), {}
    for k in sorted(motions["iteration"].unique().tolist()):  # a map may have no landmarks
        own, of, moved = (rows[rows["iteration"] == k] for rows in (landmarks, parents, motions))
        columns = {name: own[name].to_numpy() for name in POSITION_FIELDS + COVARIANCE_FIELDS}
        origin = np.full(len(own), ABSENT, dtype=np.int64)
        about = own["count"].to_numpy(np.int32), origin
        made = LandmarkMap(
            *points_from(pa.table(columns)), *about, planar=last.planar, name=last.name
        )
        parent = np.full((len(own), n_robots), ABSENT)
        parent[of["landmark"], of["robot"]] = of["parent"]
        T, covariance = np.full((n_robots, 3), np.nan), np.full((n_robots, 3, 3), np.nan)
        drift, at = np.full(n_robots, np.nan), moved["robot"].to_numpy()
        T[at], drift[at] = moved[POSE_FIELDS], moved["drift_sigma_m"]
        covariance[at] = covariances_of(moved)
        duplicates, fallback = moved.iloc[0][["duplicate_share", "fallback"]]
        outcome = float(duplicates), (), str(fallback)
        found[k] = FusedMap(made, parent, T, covariance, drift, *outcome)
    if found:
        found[k] = replace(found[k], landmarks=last)
    return found


def fused_map_files(folder: Path) -> list[Path]:
    """Return the files of the last maps of all components; the first has the most robots."""
    motions = read_rows(folder / WRITES[2], MOTIONS)
    of_last = motions[motions["iteration"] == motions["iteration"].max()]
    return [_map_path(folder, k) for k in range(1, 1 + int(of_last["component"].max()))]
