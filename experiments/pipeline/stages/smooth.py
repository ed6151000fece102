"""Stage: batch smoothing of one robot's log, at each iteration at which maps are fused.

The smoother uses the filter's noise model and its associations, and splits landmarks whose
observations cannot be of one corner. So its map differs from the filter's by the information of the
whole batch and by the joint covariance of all landmarks.

`RobotFolders`, `stored_maps` and `smoothed_maps` read the maps of a robot at each evaluated
iteration from the files of its stages.
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job, StageKind
from experiments.pipeline.stages.slam import (
    PATHS,
    SNAPSHOTS,
    Associations,
    evaluated_iterations,
    final_path,
    log_as_filtered,
    noise_factor,
)
from experiments.pipeline.tables import COVARIANCE, INT, fields
from mapfusion.attitude import Attitude, read_attitude
from mapfusion.errors import DamagedFileError
from mapfusion.files import (
    POSE_FIELDS,
    column,
    columns,
    covariance_columns,
    covariances_from,
    float_fields,
    named_columns,
    points_from,
    read_table,
    schema,
    write_table,
)
from mapfusion.geometry.numerics import Float, with_rows
from mapfusion.landmark_map import LandmarkMap, read_map, write_map
from mapfusion.robot_log import RobotLog, first_frames, read_log
from mapfusion.smoother.smooth import SmootherParameters, smooth, smoothed_map, with_path_errors
from mapfusion.viewing import LogSightings

# Attributes describe the result: `n_steps`, the degrees of freedom of the Student-t distributions
# of observations and offsets (`observation_dof`, `offset_dof`), the estimated factor on the stated
# covariances of observations (`observation_level`), and `not_smoothed`, the reason for a missing
# path (else empty).
PATH = schema(
    "smooth.path", 3, [*fields(iteration=INT), *float_fields((*POSE_FIELDS, *COVARIANCE))]
)

# Observations whose landmark differs from that of the filter.
REASSIGNED = schema("smooth.parted", 1, fields(observation=INT, source_observation=INT))

_REASSIGNED_FILE, _PATH_FILE = "parted_{part}.parquet", "path_{part}.parquet"
WRITES = (_REASSIGNED_FILE, _PATH_FILE)
# Further files of a smoothed log; `PATH` tells if it was smoothed.
_MAP_FILES = (
    "map_{part}.parquet",
    "map_{part}.joint.parquet",
    "map_{part}.viewing.parquet",
    "map_{part}.frames.parquet",
)
# Default number of evenly spaced iterations at which maps are fused, including the last.
_FUSED_ITERATIONS = 5
_ENDED = ("n_steps", "observation_dof", "offset_dof", "observation_level", "not_smoothed")


@dataclass(frozen=True)
class SmoothSettings:
    """Settings of a robot's smoothed maps, in addition to its log and filter."""

    smoother: SmootherParameters
    noise_floor_m: float
    iterations: tuple[int, ...]
    max_memory_gb: float


def fused_iterations(n_frames: int, evaluated_every: int, fused_every: int | None) -> list[int]:
    """Return the evaluated iterations at which maps are fused: multiples or evenly spaced."""
    if fused_every is not None:
        return evaluated_iterations(n_frames, fused_every)
    known = np.array(evaluated_iterations(n_frames, evaluated_every))
    wanted = np.linspace(0, n_frames - 1, _FUSED_ITERATIONS + 1)[1:]
    return np.unique(known[np.abs(known[:, None] - wanted).argmin(axis=0)]).tolist()


def iterations_of(n_frames: int, fused: list[int]) -> tuple[int, ...]:
    """Return the iterations of a robot; after the end of its log, its last one."""
    return tuple(sorted({min(k, n_frames - 1) for k in fused}))


def parts(iterations: tuple[int, ...]) -> tuple[str, ...]:
    """Return the stage's parts, one per iteration."""
    return tuple(map(str, iterations))


def run(settings: SmoothSettings, job: Job) -> None:
    """Smooth the log up to one iteration; write the map with its joint covariance, and the path.

    If the log cannot be smoothed, there is no map and an empty path with the reason.
    """
    log, smoother = log_to_smooth(job.inputs["log"], job.inputs["slam"], settings.smoother)
    inputs = smoother_inputs(job, log, int(job.part), settings.noise_floor_m)
    settings_of_log = replace(settings, smoother=smoother)
    result = smooth_log(settings_of_log, *inputs, read_attitude(job.inputs["log"]))
    landmarks, path, covariance, landmark, ended = result
    if landmarks is not None:
        write_map(_map_path(job.output, job.part), landmarks)
    _, filters, _ = inputs
    changed = np.flatnonzero(landmark != filters)
    rows = {"observation": changed, "source_observation": landmark[changed]}
    write_table(_reassigned_path(job.output, job.part), rows, REASSIGNED)
    rows = {"iteration": np.arange(len(path))} | named_columns(POSE_FIELDS, path)
    rows |= covariance_columns(COVARIANCE, covariance)
    attributes = {name: str(value) for name, value in zip(_ENDED, ended, strict=True)}
    write_table(_path_path(job.output, job.part), rows, PATH, attributes)


SMOOTH_STAGE = StageKind("smooth", "smooth the logs", run, WRITES)


def log_to_smooth(
    log: Path, slam: Path, parameters: SmootherParameters
) -> tuple[RobotLog, SmootherParameters]:
    """Return the filter's input log, and the smoother's parameters with the filter's noise."""
    filtered, covariance = log_as_filtered(log, slam)
    motion = parameters.motion.scaled(noise_factor(slam))
    return filtered, replace(parameters, motion=motion, odometry_covariance=covariance)


def log_until(log: RobotLog, iteration: int, noise_floor_m: float = 0.0) -> RobotLog:
    """Return a log up to an iteration, with the filter's covariances of observations."""
    part = first_frames(log, iteration + 1)
    covariance = part.observations.covariance_m2 + noise_floor_m**2 * np.eye(3)
    return replace(part, observations=replace(part.observations, covariance_m2=covariance))


def smoother_inputs(
    job: Job, log: RobotLog, iteration: int, noise_floor_m: float
) -> tuple[RobotLog, np.ndarray, Float]:
    """Return the log up to an iteration, and the filter's associations and path there."""
    log = log_until(log, iteration, noise_floor_m)
    landmark = Associations.read(job.inputs["slam"]).at(iteration, len(log.observations))
    return log, landmark, final_path(job.inputs["slam"])[: iteration + 1]


def smooth_log(
    settings: SmoothSettings,
    log: RobotLog,
    landmark: np.ndarray,
    path: Float,
    attitude: Attitude | None,
) -> tuple[LandmarkMap | None, Float, Float, np.ndarray, tuple[object, ...]]:
    """Return map, path, its covariances, landmark of each observation, and the values of `_ENDED`.

    If the log cannot be smoothed, the map is None and the path is empty.
    """
    try:
        smoothed_log = smooth(log, landmark, path, settings.smoother, settings.max_memory_gb)
    except MemoryError as error:
        reason = f"smoothing {error}: smooth.max_memory_gb is {settings.max_memory_gb:g}"
    except np.linalg.LinAlgError as error:
        reason = (
            f"its equations have no solution ({error}): covariances of its observations, or what "
            "slam.filter.motion states of its odometry, differ by too many orders of magnitude"
        )
    else:
        outcome = (smoothed_log.n_steps, *smoothed_log.tails, smoothed_log.observation_scale, "")
        try:
            landmarks = smoothed_map(log, smoothed_log, attitude=attitude)
            path, covariance = smoothed_log.estimate.path, smoothed_log.path_covariance
            return landmarks, path, covariance, smoothed_log.landmark, outcome
        except np.linalg.LinAlgError:
            reason = "has a map whose covariance cannot be computed"
    nothing = np.empty((0, 3)), np.empty((0, 3, 3))
    return None, *nothing, landmark, (0, np.nan, np.nan, np.nan, reason)


def map_files(folder: Path, iteration: int) -> list[Path]:
    """Return the files of the map at a smoothed iteration."""
    return [folder / name.format(part=iteration) for name in _MAP_FILES]


def _map_path(folder: Path, part: str) -> Path:
    return folder / _MAP_FILES[0].format(part=part)


def _reassigned_path(folder: Path, part: str) -> Path:
    return folder / _REASSIGNED_FILE.format(part=part)


def _path_path(folder: Path, part: str) -> Path:
    return folder / _PATH_FILE.format(part=part)


def read_smoothed(folder: Path, only_last_joint: bool = False) -> dict[int, LandmarkMap]:
    """Read the smoothed map of a robot at each smoothed iteration.

    If `only_last_joint`, only the last map has its joint covariance and viewing evidence, which are
    most of the data.

    Raises:
        DamagedFileError: a file of a map is damaged or missing.
    """
    iterations = list(read_smoothed_path(folder))
    for k in iterations:
        for file in map_files(folder, k):
            if not file.is_file():
                raise DamagedFileError(file, "is missing")
    without_joint = iterations[:-1] if only_last_joint else ()
    return {k: read_map(_map_path(folder, str(k)), alone=k in without_joint) for k in iterations}


def read_smoothed_path(folder: Path) -> dict[int, Float]:
    """Read the smoothed path (k + 1, 3) up to each smoothed iteration k, in order."""
    return {k: columns(table, POSE_FIELDS) for k, table in _path_tables(folder)}


def read_path_covariance(folder: Path) -> dict[int, Float]:
    """Read the covariances (k + 1, 3, 3) of the poses of `read_smoothed_path`."""
    return {k: covariances_from(table, COVARIANCE) for k, table in _path_tables(folder)}


def _path_tables(folder: Path) -> Iterator[tuple[int, pa.Table]]:
    """Yield each smoothed iteration and its table PATH, in order."""
    for k in _iterations(folder):
        table, attributes = read_table(_path_path(folder, str(k)), PATH)
        if not attributes["not_smoothed"]:
            yield k, table


def smoothed_owners(smooth: Path, slam: Path, iteration: int, n_observations: int) -> np.ndarray:
    """Return the source of each observation's landmark in the smoothed map, -1 for none.

    Args:
        smooth: folder of this stage.
        slam: folder of the filter, whose associations hold except for split landmarks.
        iteration: an iteration with a smoothed map.
        n_observations: number of observations of the log up to the iteration.
    """
    owner = Associations.read(slam).at(iteration, n_observations)
    table, _ = read_table(_reassigned_path(smooth, str(iteration)), REASSIGNED)
    owner[column(table, "observation")] = column(table, "source_observation")
    return owner


def read_endings(folder: Path) -> pd.DataFrame:
    """Read the outcome of smoothing, one row per iteration.

    Columns: iteration, n_steps, observation_dof, offset_dof, observation_level, not_smoothed.
    """
    ends = {k: read_table(_path_path(folder, str(k)), PATH)[1] for k in _iterations(folder)}
    rows = pd.DataFrame([{name: end[name] for name in _ENDED} for end in ends.values()])
    kinds = dict.fromkeys(_ENDED[1:-1], float)
    return rows.astype({"n_steps": int} | kinds).assign(iteration=list(ends))


def _iterations(folder: Path) -> list[int]:
    """Return the iterations of the stage's files."""
    begin, _, end = _PATH_FILE.partition("{part}")
    files = (path.name for path in folder.glob(f"{begin}[0-9]*{end}"))
    return sorted(int(name.removeprefix(begin).removesuffix(end)) for name in files)


_Known = TypeVar("_Known")


class RobotFolders(NamedTuple):
    """Folders of a robot's log (with its truth), of its SLAM result and of its smoothed maps.

    Maps have a joint covariance of their errors where a smoothed map is known.
    """

    log: Path
    slam: Path
    smooth: Path | None = None


def folders_of_both(job: Job) -> list[RobotFolders]:
    """Return the folders of the two robots of a pair's job."""
    folders, inputs = [], job.inputs
    for side in "ab":
        smooth = inputs.get(f"smooth_{side}")
        folders.append(RobotFolders(inputs[f"log_{side}"], inputs[f"slam_{side}"], smooth))
    return folders


def latest_at(known: Mapping[int, _Known], iteration: int) -> _Known:
    """Return a robot's value at an iteration; the last one if the log ended earlier."""
    return known[max((k for k in known if k <= iteration), default=min(known))]


ROBOTS_KEPT = 4  # robots whose maps a process keeps; tens of megabytes for minutes of driving


class Snapshots(Mapping[int, LandmarkMap]):
    """Map of a robot at each evaluated iteration, created at the first access.

    Descriptors, labels and viewing evidence of the landmarks are taken from the log.

    Args:
        slam: folder of the stage.
        log: the filter's input log.
        viewing: True if maps have viewing evidence, which depends on the whole log up to then.
        smoothed: smoothed maps by iteration. The last one until an iteration determines the joint
            covariance of the errors of the filter's map.
    """

    def __init__(
        self,
        slam: Path,
        log: RobotLog,
        viewing: bool = True,
        smoothed: Mapping[int, LandmarkMap] = MappingProxyType({}),
    ) -> None:
        self._slam, self._log, self._viewing, self._smoothed = slam, log, viewing, smoothed
        table, attributes = read_table(slam / "snapshots.parquet", SNAPSHOTS)
        about = (column(table, "count"), column(table, "source_observation"))
        self._landmarks = LandmarkMap(*points_from(table), *about)
        iteration, evaluated = (
            column(table, "iteration"),
            map(int, attributes["iterations"].split(",")),
        )
        self._rows = {k: slice(*np.searchsorted(iteration, [k, k + 1])) for k in evaluated}
        self._made: dict[int, LandmarkMap] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[int]:
        return iter(self._rows)

    def __getitem__(self, iteration: int) -> LandmarkMap:
        if iteration not in self._made:
            landmarks, log = with_rows(self._landmarks, self._rows[iteration]), self._log
            origin, seen = landmarks.source_observation, log.observations
            viewing = None
            if self._viewing:  # along the path from which the map was computed
                sightings, evaluated, poses = self._viewed
                path = poses[slice(*np.searchsorted(evaluated, [iteration, iteration + 1]))]
                n_seen = int(np.searchsorted(log.iteration, iteration + 1))
                owner = self.associations.at(iteration, n_seen)
                viewing = sightings.viewing(owner, path, origin)
            snapshot = replace(
                landmarks,
                descriptor=None if seen.descriptor is None else seen.descriptor[origin],
                descriptor_kind=seen.descriptor_kind,
                label=None if seen.label is None else seen.label[origin],
                planar=log.planar,
                name=log.robot,
                viewing=viewing,
                calibration=log.calibration,
            )
            known = [k for k in self._smoothed if k <= iteration]
            if known:
                last = max(known)
                snapshot = with_path_errors(
                    snapshot, self._smoothed[last], complete=last == iteration
                )
            self._made[iteration] = snapshot
        return self._made[iteration]

    @cached_property
    def associations(self) -> Associations:
        """Landmark of each of the log's observations."""
        return Associations.read(self._slam)

    @cached_property
    def _viewed(self) -> tuple[LogSightings, np.ndarray, Float]:
        """Sightings of the log; evaluated iteration and pose of each row of the paths."""
        seen = LogSightings.of(self._log.iteration, self._log.observations.position_m)
        table, _ = read_table(self._slam / "paths.parquet", PATHS)
        return seen, column(table, "evaluated"), columns(table, POSE_FIELDS)


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def stored_maps(folders: RobotFolders, *, viewing: bool) -> Snapshots:
    """Return a robot's maps, with or without viewing evidence.

    Maps of a few robots stay in memory, because several stages read them. The name of their folder
    depends on the content of the log.
    """
    smoothed = {} if folders.smooth is None else read_smoothed(folders.smooth)
    return Snapshots(folders.slam, read_log(folders.log), viewing, smoothed)


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def smoothed_maps(folders: RobotFolders, *, viewing: bool) -> Mapping[int, LandmarkMap]:
    """Return a robot's maps at the iterations at which maps are fused: smoothed ones if possible.

    Where smoothing failed, the last smoothed map until then stands in. Before the first one, the
    filter's map does.
    """
    assert folders.smooth is not None
    smoothed, filtered = read_smoothed(folders.smooth), stored_maps(folders, viewing=viewing)
    first = min(smoothed, default=np.inf)
    before = [k for k in read_endings(folders.smooth)["iteration"].tolist() if k < first]
    return {k: latest_at(filtered, k) for k in before} | smoothed


def maps_of(
    folders: RobotFolders, *, smoothed: bool, viewing: bool = True
) -> Mapping[int, LandmarkMap]:
    """Return a robot's smoothed maps or those of the filter."""
    return (smoothed_maps if smoothed else stored_maps)(folders, viewing=viewing)
