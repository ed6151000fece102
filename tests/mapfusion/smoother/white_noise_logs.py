"""Logs whose errors are what they say: Gaussian, of the stated covariances, and a stray if any."""

from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.robot_log import Observations, RobotLog
from mapfusion.se2 import Float, compose, rotation
from mapfusion.smoother.tracks import Stray

NOISE = MotionNoise()
HALF_VIEW_RAD, RANGE_M = 0.6, 4.0
NO_STRAY = Stray(0.0)


class Known(NamedTuple):
    """A log and the truth about it: path (T, 3) and landmarks (L, 3), which labels number."""

    log: RobotLog
    path: Float
    point_m: Float


def white_noise_log(
    rng: np.random.Generator,
    n_frames: int,
    n_landmarks: int,
    planar: bool = False,
    stray: Stray = NO_STRAY,
) -> Known:
    """A robot that drives in circles among landmarks that it sees now and then."""
    odometry = np.zeros((n_frames, 3))
    odometry[1:] = [0.08, 0.0, 0.08]
    path = np.zeros((n_frames, 3))
    for k in range(1, n_frames):
        disturbance = rng.standard_normal(3) * NOISE.standard_deviations(odometry[k])
        path[k] = compose(path[k - 1], odometry[k] + disturbance)
    height = np.zeros(n_landmarks) if planar else rng.uniform(0, 1, n_landmarks)
    point_m = np.column_stack([rng.uniform(-3, 4, (n_landmarks, 2)), height])
    strays = _strays(rng, stray, n_frames, n_landmarks) * [1, 1, not planar]
    seen = [_sightings(rng, path[k], point_m + strays[k], planar) for k in range(n_frames)]
    iteration = np.repeat(np.arange(n_frames), [len(label) for label, _, _ in seen])
    label, position, covariance = map(np.concatenate, zip(*seen, strict=True))
    observations = Observations(position, covariance, None, label.astype(np.int32))
    return Known(
        RobotLog("R1", planar, np.arange(n_frames) * 0.2, odometry, iteration, observations),
        path,
        point_m,
    )


def _strays(rng: np.random.Generator, stray: Stray, n_frames: int, n_landmarks: int) -> Float:
    """(T, L, 3) by the process's own recursion."""
    share = np.exp(-1 / stray.decay_frames)
    found = stray.sigma_m * rng.standard_normal((n_frames, n_landmarks, 3))
    for k in range(1, n_frames):
        found[k] = share * found[k - 1] + np.sqrt(1 - share**2) * found[k]
    return found


def _sightings(
    rng: np.random.Generator, pose: Float, point_m: Float, planar: bool
) -> tuple[np.ndarray, Float, Float]:
    """Label, observed position and covariance of what is in view."""
    at = point_m.copy()
    at[:, :2] = (at[:, :2] - pose[:2]) @ rotation(pose[2])
    range_m, bearing_rad = np.hypot(at[:, 0], at[:, 1]), np.arctan2(at[:, 1], at[:, 0])
    ahead = (np.abs(bearing_rad) < HALF_VIEW_RAD) & (range_m > 0.3) & (range_m < RANGE_M)
    label = np.flatnonzero(ahead)
    skewed = np.eye(3) + 0.3 * rng.standard_normal((len(label), 3, 3))
    sigma_m = 0.02 * range_m[label, None, None]
    covariance = sigma_m**2 * skewed @ np.swapaxes(skewed, 1, 2)
    error = np.einsum(
        "nij,nj->ni", np.linalg.cholesky(covariance), rng.standard_normal((len(label), 3))
    )
    error[:, 2] *= not planar
    return label, at[label] + error, covariance


def dead_reckoned(log: RobotLog) -> Float:
    """(T, 3) the path by odometry alone."""
    path = np.zeros((len(log), 3))
    for k in range(1, len(log)):
        path[k] = compose(path[k - 1], log.odometry[k])
    return path
