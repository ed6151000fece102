"""Stage: one robot's log smoothed in one batch, at each iteration that maps are fused at.

It takes the filter's noise model and its associations, of which it parts what cannot be one corner.
So what it finds differs from the filter's map by what a batch knows more, and by the correlations
of all landmarks that come with it.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.slam import (
    Associations,
    evaluated_iterations,
    final_path,
    log_as_filtered,
)
from experiments.pipeline.tables import INT, fields
from mapfusion.attitude import Attitude, read_attitude
from mapfusion.errors import DamagedFileError
from mapfusion.files import (
    POSE_FIELDS,
    column,
    columns,
    float_fields,
    named_columns,
    read_table,
    schema,
    write_table,
)
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap, read_map, write_map
from mapfusion.robot_log import RobotLog, first_frames
from mapfusion.smoother.smooth import Smoothed, SmootherParameters, smooth, smoothed_map

# Its attributes tell how smoothing ended: `n_steps`, the degrees of freedom of the Student-t's of
# observations and offsets (`observation_dof`, `offset_dof`), the factor on the observations' stated
# covariances that the log told (`observation_level`), and `not_smoothed`, why there is no path
# (else empty).
PATH = schema("smooth.path", 2, [*fields(iteration=INT), *float_fields(POSE_FIELDS)])

# Observations that are of another landmark than the filter took them for.
PARTED = schema("smooth.parted", 1, fields(observation=INT, source_observation=INT))

LABEL = "smooth the logs"
WRITES = ("parted_{part}.parquet", "path_{part}.parquet")
# Beside these where the log was smoothed: `PATH` tells whether it was.
_MAP_FILES = (
    "map_{part}.parquet",
    "map_{part}.joint.parquet",
    "map_{part}.viewing.parquet",
    "map_{part}.frames.parquet",
)
# Unless they are said, maps are fused at so many evenly spread iterations, the last among them.
_FUSED_ITERATIONS = 5
_ENDED = ("n_steps", "observation_dof", "offset_dof", "observation_level", "not_smoothed")


@dataclass(frozen=True)
class SmoothSettings:
    """All that a robot's smoothed maps depend on, beside its log and its filter."""

    smoother: SmootherParameters
    noise_floor_m: float
    iterations: tuple[int, ...]
    max_memory_gb: float


def fused_iterations(n_frames: int, evaluated_every: int, fused_every: int | None) -> list[int]:
    """The evaluated iterations that maps are fused at: each multiple, or evenly spread ones."""
    if fused_every is not None:
        return evaluated_iterations(n_frames, fused_every)
    known = np.array(evaluated_iterations(n_frames, evaluated_every))
    wanted = np.linspace(0, n_frames - 1, _FUSED_ITERATIONS + 1)[1:]
    return np.unique(known[np.abs(known[:, None] - wanted).argmin(axis=0)]).tolist()


def iterations_of(n_frames: int, fused: list[int]) -> tuple[int, ...]:
    """Those of a robot; one whose log ends earlier takes part with its last map from then on."""
    return tuple(sorted({min(k, n_frames - 1) for k in fused}))


def parts(iterations: tuple[int, ...]) -> tuple[str, ...]:
    """The stage's parts, one an iteration."""
    return tuple(map(str, iterations))


def run(settings: SmoothSettings, job: Job) -> None:
    """Smooth the log up to one iteration; write the map with its joint covariance, and the path.

    A log that cannot be smoothed has no map and an empty path, with the reason.
    """
    log, covariance = log_as_filtered(job.inputs["log"], job.inputs["slam"])
    given = smoother_inputs(job, log, int(job.part), settings.noise_floor_m)
    own = replace(settings, smoother=replace(settings.smoother, odometry_covariance=covariance))
    made = smooth_log(own, *given, read_attitude(job.inputs["log"]))
    landmarks, path, landmark, ended = made
    if landmarks is not None:
        write_map(_map_path(job.output, job.part), landmarks)
    _, filters, _ = given
    changed = np.flatnonzero(landmark != filters)
    rows = {"observation": changed, "source_observation": landmark[changed]}
    write_table(_parted_path(job.output, job.part), rows, PARTED)
    rows = {"iteration": np.arange(len(path))} | named_columns(POSE_FIELDS, path)
    attributes = {name: str(value) for name, value in zip(_ENDED, ended, strict=True)}
    write_table(_path_path(job.output, job.part), rows, PATH, attributes)


def log_until(log: RobotLog, iteration: int, noise_floor_m: float = 0.0) -> RobotLog:
    """A log as it was at an iteration, its observations as noisy as the filter takes them."""
    part = first_frames(log, iteration + 1)
    covariance = part.observations.covariance_m2 + noise_floor_m**2 * np.eye(3)
    return replace(part, observations=replace(part.observations, covariance_m2=covariance))


def smoother_inputs(
    job: Job, log: RobotLog, iteration: int, noise_floor_m: float
) -> tuple[RobotLog, np.ndarray, Float]:
    """What is smoothed: the log until then, the filter's associations as they were, its path."""
    log = log_until(log, iteration, noise_floor_m)
    landmark = Associations.read(job.inputs["slam"]).at(iteration, len(log.observations))
    return log, landmark, final_path(job.inputs["slam"])[: iteration + 1]


def smooth_log(
    settings: SmoothSettings,
    log: RobotLog,
    landmark: np.ndarray,
    path: Float,
    attitude: Attitude | None,
) -> tuple[LandmarkMap | None, Float, np.ndarray, tuple[object, ...]]:
    """Map, path, which landmark observations are of, and how smoothing ended, see `_ENDED`.

    There is no map, and no pose in the path, where the log cannot be smoothed.
    """
    found = _smoothed(log, landmark, path, settings)
    if not isinstance(found, str):
        ended = (found.n_steps, *found.tails, found.observation_level, "")
        try:
            made = smoothed_map(log, found, attitude=attitude)
            return made, found.estimate.path, found.landmark, ended
        except np.linalg.LinAlgError:
            found = "has a map whose covariance cannot be computed"
    return None, np.empty((0, 3)), landmark, (0, np.nan, np.nan, np.nan, found)


def _smoothed(
    log: RobotLog, landmark: np.ndarray, path: Float, settings: SmoothSettings
) -> Smoothed | str:
    """Return what the smoother finds, or why it finds nothing and what can be done."""
    try:
        return smooth(log, landmark, path, settings.smoother, settings.max_memory_gb)
    except MemoryError as error:
        return f"smoothing {error}: smooth.max_memory_gb is {settings.max_memory_gb:g}"
    except np.linalg.LinAlgError as error:
        return (
            f"its equations have no solution ({error}): covariances of its observations, or what "
            "slam.filter.motion states of its odometry, differ by too many orders of magnitude"
        )


def map_files(folder: Path, iteration: int) -> list[Path]:
    """The files of the map at an iteration that has one: the map, and what lies beside it."""
    return [folder / name.format(part=iteration) for name in _MAP_FILES]


def _map_path(folder: Path, part: str) -> Path:
    return folder / _MAP_FILES[0].format(part=part)


def _parted_path(folder: Path, part: str) -> Path:
    return folder / WRITES[0].format(part=part)


def _path_path(folder: Path, part: str) -> Path:
    return folder / WRITES[1].format(part=part)


def read_smoothed(folder: Path, last_whole: bool = False) -> dict[int, LandmarkMap]:
    """The robot's smoothed map, with its joint covariance, at each iteration that has one.

    If `last_whole` only the last one has that, and viewing evidence: it is most of what is read.

    Raises:
        DamagedFileError: a file of a map is damaged or missing.
    """
    known = list(read_smoothed_path(folder))
    for k in known:
        for file in map_files(folder, k):
            if not file.is_file():
                raise DamagedFileError(file, "is missing")
    alone = known[:-1] if last_whole else ()
    return {k: read_map(_map_path(folder, str(k)), alone=k in alone) for k in known}


def read_smoothed_path(folder: Path) -> dict[int, Float]:
    """The smoothed path (k + 1, 3) up to each iteration k that has one, in order."""
    paths = {}
    for k in _iterations(folder):
        table, attributes = read_table(_path_path(folder, str(k)), PATH)
        if not attributes["not_smoothed"]:
            paths[k] = columns(table, POSE_FIELDS)
    return paths


def smoothed_owners(smooth: Path, slam: Path, iteration: int, n_observations: int) -> np.ndarray:
    """(n_observations,) source of the smoothed map's landmark that each is of, -1 for none.

    Args:
        smooth: this stage's folder.
        slam: the filter's, whose associations hold where nothing was parted.
        iteration: that has a smoothed map.
        n_observations: of the log until then.
    """
    owner = Associations.read(slam).at(iteration, n_observations)
    table, _ = read_table(_parted_path(smooth, str(iteration)), PARTED)
    owner[column(table, "observation")] = column(table, "source_observation")
    return owner


def read_endings(folder: Path) -> pd.DataFrame:
    """How smoothing ended, one row an iteration.

    Columns: iteration, n_steps, observation_dof, offset_dof, observation_level, not_smoothed.
    """
    ends = {k: read_table(_path_path(folder, str(k)), PATH)[1] for k in _iterations(folder)}
    rows = pd.DataFrame([{name: end[name] for name in _ENDED} for end in ends.values()])
    kinds = dict.fromkeys(_ENDED[1:-1], float)
    return rows.astype({"n_steps": int} | kinds).assign(iteration=list(ends))


def _iterations(folder: Path) -> list[int]:
    begin, _, end = WRITES[1].partition("{part}")
    files = (path.name for path in folder.glob(f"{begin}[0-9]*{end}"))
    return sorted(int(name.removeprefix(begin).removesuffix(end)) for name in files)
