"""Map building: run the filter over a robot log."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.attitude import Attitude, attitude_height_errors
from mapfusion.errors import InputError
from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlam, FastSlamParameters, StepResult
from mapfusion.geometry.numerics import Float, require_shape
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import Observations, RobotLog
from mapfusion.tables import NO_LABEL
from mapfusion.viewing import viewing_of_log

# Weight of each of two sources whose correlation is unknown (covariance intersection): their fused
# information is never overestimated (Julier and Uhlmann 1997).
_HALF = 0.5


@dataclass(frozen=True)
class Frame:
    """Filter state after one frame of a log.

    Attributes:
        iteration: number of the frame.
        result: result of the step.
        slam: the filter after this step.
        landmarks: the best map at the requested iterations; None at others.
        path: (iteration + 1, 3) path of the best particle; None without a map.
        associations: (n,) source of the landmark of each observation so far, -1 for none; None
            without a map.
    """

    iteration: int
    result: StepResult
    slam: FastSlam
    landmarks: LandmarkMap | None = None
    path: Float | None = None
    associations: np.ndarray | None = None


def association_for(log: RobotLog, stated: Association) -> Association:
    """Return the criterion that associates the observations of a log.

    If no observation has what the stated criterion needs, it is the label if every observation has
    one, else the descriptor if every observation has one, else the gate.
    """
    seen = log.observations
    if not len(seen) or not _lacking(seen, stated).all():
        return stated
    if not _lacking(seen, Association.LABEL).any():
        return Association.LABEL
    if not _lacking(seen, Association.DESCRIPTOR).any():
        return Association.DESCRIPTOR
    return Association.GATE


def _lacking(seen: Observations, association: Association) -> np.ndarray:
    """Return, shape (N,), True for observations without the label or descriptor that is needed."""
    lacking = np.full(len(seen), association is not Association.GATE)
    if association is Association.LABEL and seen.label is not None:
        lacking[:] = seen.label == NO_LABEL
    elif association is Association.DESCRIPTOR and seen.descriptor is not None:
        lacking[:] = np.isnan(seen.descriptor).any(1)
    return lacking


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
        log: measurements of the robot; the log also defines whether the data are planar.
        parameters: settings.
        rng: random generator of the filter.
        snapshots: iterations at which the best map is taken.
        min_count: smallest number of observations of a landmark in the map.
        odometry_covariance: (T, 3, 3) covariance of odometry estimated from the observations. It
            replaces the motion noise except for the floor. The correlation of this odometry with
            the observations is unknown, so each has half of its information (covariance
            intersection). NaN in a frame: its odometry is independent and has the motion noise.
        attitude: attitude that levelled the observations; None for a level robot.
        viewing: add viewing evidence to the maps, from the log up to each snapshot.

    Yields:
        One `Frame` for each frame of the log.

    Raises:
        InputError: `parameters.planar` contradicts the log, or some observations have no label or
            descriptor although the association needs them (see `association_for`).
        ValueError: `odometry_covariance` has another length than the log.
    """
    # Reject unusable input before the first step: filtering a long log may take hours.
    seen, association = log.observations, association_for(log, parameters.association)
    if n := np.count_nonzero(_lacking(seen, association)):
        raise InputError(
            f"log {log.robot}: {n} of {len(seen)} observations have no {association.value}, which "
            f"association={association.value} needs; choose another association"
        )
    if odometry_covariance is not None:
        require_shape("odometry_covariance", odometry_covariance, (len(log), 3, 3))
    if parameters.planar not in (None, log.planar):
        kind = "planar data" if log.planar else "data in three dimensions"
        raise InputError(
            f"planar: is {parameters.planar}, but the log of {log.robot} holds {kind}; leave it out"
        )
    wanted = frozenset(snapshots)
    slam = FastSlam(replace(parameters, planar=log.planar, association=association), rng)
    starts = log.frame_starts()
    for iteration, odometry in enumerate(log.odometry):
        frame, sigma = log.observations[starts[iteration] : starts[iteration + 1]], None
        if odometry_covariance is not None and np.isfinite(odometry_covariance[iteration]).all():
            frame_covariance = odometry_covariance[iteration] / _HALF
            sigma = parameters.motion.with_floor(frame_covariance)
            frame = replace(frame, covariance_m2=frame.covariance_m2 / _HALF)
        result = slam.step(odometry, frame, sigma)
        if iteration not in wanted:
            yield Frame(iteration, result, slam)
            continue
        landmarks = replace(slam.best_map(min_count), name=log.robot, calibration=log.calibration)
        source, path = slam.best_associations(), slam.best_path()
        if viewing:
            seen = log.iteration, log.observations.position_m
            evidence = viewing_of_log(*seen, source, path, landmarks.source_observation)
            landmarks = replace(landmarks, viewing=evidence)
        if attitude is not None and not log.planar:
            # The attitude's uncertainty adds to the variance of the heights.
            rows = np.flatnonzero(np.isin(source, landmarks.source_observation))
            order = np.argsort(landmarks.source_observation, kind="stable")
            landmark_row = order[np.searchsorted(landmarks.source_observation[order], source[rows])]
            frame = log.iteration[rows].astype(np.int64)
            lifted = attitude_height_errors(
                attitude, path, frame, landmark_row, landmarks.position_m
            )
            covariance = landmarks.covariance_m2.copy()
            covariance[:, 2, 2] += np.sum(lifted**2, axis=0)
            landmarks = replace(landmarks, covariance_m2=covariance)
        yield Frame(iteration, result, slam, landmarks, path, source)


def build_map(
    log: RobotLog,
    parameters: FastSlamParameters,
    rng: np.random.Generator,
    min_count: int = 3,
    odometry_covariance: Float | None = None,
    attitude: Attitude | None = None,
) -> LandmarkMap:
    """Return the most probable map at the end of a log; for the arguments see `run_log`.

    Raises:
        InputError: the log holds no frame.
    """
    last = len(log) - 1
    extras = odometry_covariance, attitude
    for frame in run_log(log, parameters, rng, [last], min_count, *extras):
        if frame.landmarks is not None:
            return frame.landmarks
    raise InputError(f"log {log.robot}: holds no frame")
