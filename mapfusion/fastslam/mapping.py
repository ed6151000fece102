"""Map building: run the filter over a robot log."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.attitude import Attitude, attitude_height_errors
from mapfusion.errors import InputError
from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlam, FastSlamParameters, StepResult
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import require_shape
from mapfusion.robot_log import RobotLog
from mapfusion.tables import NO_LABEL
from mapfusion.viewing import viewing_of_log

# What one source counts for that may say again what another one says: the information of either,
# times this, is together never more than there is (Julier and Uhlmann 1997).
_HALF = 0.5


@dataclass(frozen=True)
class Frame:
    """One frame of a log, filtered.

    Attributes:
        iteration: of the log.
        result: of the step.
        slam: the filter itself, as it is after this step.
        landmarks: the best map, at the iterations that were asked for; None at others, as what
            follows.
        path: (iteration + 1, 3) that it was made along.
        associations: (n,) source of the landmark that each observation so far went into, -1 for
            none.
    """

    iteration: int
    result: StepResult
    slam: FastSlam
    landmarks: LandmarkMap | None = None
    path: Float | None = None
    associations: np.ndarray | None = None


def run_log(
    log: RobotLog,
    parameters: FastSlamParameters,
    rng: np.random.Generator,
    snapshots: Collection[int] = (),
    min_count: int = 3,
    odometry_covariance: Float | None = None,
    attitude: Attitude | None = None,
    viewing: bool = True,
) -> Iterator[Frame]:
    """Filter a log frame by frame.

    Args:
        log: what the robot measured; it also says whether the data are planar.
        parameters: settings.
        rng: of the filter.
        snapshots: iterations at which the best map is taken.
        min_count: sightings that a landmark needs to be in it.
        odometry_covariance: (T, 3, 3) of odometry that was taken from what the log observes, in
            place of the motion noise, of which only the floor is added. How much both share is not
            known, so each counts half (covariance intersection). NaN at a frame: its odometry is a
            source of its own, as noisy as the settings say.
        attitude: by which the log's observations were levelled; None: of a level body.
        viewing: whether maps come with their viewing evidence, which is of the whole log so far.

    Yields:
        One `Frame` for each row of the log's frames.

    Raises:
        InputError: `parameters.planar` contradicts the log, or observations have no labels or
            descriptors where `parameters.association` needs them.
        ValueError: `odometry_covariance` is of another length than the log.
    """
    _require_looks(log, parameters.association)
    if odometry_covariance is not None:
        require_shape("odometry_covariance", odometry_covariance, (len(log), 3, 3))
    wanted = frozenset(snapshots)
    slam = FastSlam(_as_the_log_says(log, parameters), rng)
    starts = log.frame_starts()
    for iteration, odometry in enumerate(log.odometry):
        frame, sigma = log.observations[starts[iteration] : starts[iteration + 1]], None
        if odometry_covariance is not None and np.isfinite(odometry_covariance[iteration]).all():
            own = odometry_covariance[iteration] / _HALF
            sigma = parameters.motion.with_floor(own)
            frame = replace(frame, covariance_m2=frame.covariance_m2 / _HALF)
        result = slam.step(odometry, frame, sigma)
        if iteration not in wanted:
            yield Frame(iteration, result, slam)
            continue
        landmarks = replace(slam.best_map(min_count), name=log.robot, calibration=log.calibration)
        seen = slam.best_associations(), slam.best_path()
        if viewing:
            found = viewing_of_log(log, *seen, landmarks.source_observation)
            landmarks = replace(landmarks, viewing=found)
        if attitude is not None and not log.planar:
            landmarks = _with_attitude(landmarks, log, *seen, attitude)
        yield Frame(iteration, result, slam, landmarks, seen[1], seen[0])


def build_map(
    log: RobotLog,
    parameters: FastSlamParameters,
    rng: np.random.Generator,
    min_count: int = 3,
    odometry_covariance: Float | None = None,
    attitude: Attitude | None = None,
) -> LandmarkMap:
    """The most probable map at the end of a log; arguments and errors as of `run_log`.

    Raises:
        InputError: the log holds no frame.
    """
    last = len(log) - 1
    told = odometry_covariance, attitude
    for frame in run_log(log, parameters, rng, [last], min_count, *told):
        if frame.landmarks is not None:
            return frame.landmarks
    raise InputError(f"log {log.robot}: holds no frame")


def _with_attitude(
    landmarks: LandmarkMap,
    log: RobotLog,
    source: np.ndarray,
    path: Float,
    attitude: Attitude,
) -> LandmarkMap:
    """With what is not known of the attitude in the variances of the landmarks' heights.

    `source` (n,) is what each observation so far went into.
    """
    rows = np.flatnonzero(np.isin(source, landmarks.source_observation))
    order = np.argsort(landmarks.source_observation, kind="stable")
    place = np.searchsorted(landmarks.source_observation[order], source[rows])
    frame = log.iteration[rows].astype(np.int64)
    lifted = attitude_height_errors(attitude, path, frame, order[place], landmarks.position_m)
    covariance = landmarks.covariance_m2.copy()
    covariance[:, 2, 2] += np.sum(lifted**2, axis=0)
    return replace(landmarks, covariance_m2=covariance)


def _require_looks(log: RobotLog, association: Association) -> None:
    """Refuse a log as a whole, before hours of work on its first frames."""
    seen = log.observations
    if association is Association.LABEL:
        what, lacking = "label", seen.label is None or seen.label == NO_LABEL
    elif association is Association.DESCRIPTOR:
        what, lacking = "descriptor", seen.descriptor is None or np.isnan(seen.descriptor).any(1)
    else:
        return
    n = len(seen) if lacking is True else int(np.sum(lacking))
    if n:
        raise InputError(
            f"log {log.robot}: {n} of {len(seen)} observations have no {what}, which the setting "
            f"association={association.value} needs; choose another association"
        )


def _as_the_log_says(log: RobotLog, parameters: FastSlamParameters) -> FastSlamParameters:
    """The settings with `planar` from the log."""
    if parameters.planar not in (None, log.planar):
        kind = "planar data" if log.planar else "data in three dimensions"
        raise InputError(
            f"planar: is {parameters.planar}, but the log of {log.robot} holds {kind}; leave it out"
        )
    return replace(parameters, planar=log.planar)
