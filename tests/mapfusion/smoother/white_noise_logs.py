"""Logs whose errors are what they say: independent, Gaussian, of the stated covariances."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, rotation
from mapfusion.robot_log import Observations, RobotLog

NOISE = MotionNoise()
HALF_VIEW_RAD, RANGE_M = 0.6, 4.0


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
    point_m: Float | None = None,
) -> Known:
    """A robot that drives in circles among landmarks, drawn unless given, that it sees at times."""
    odometry = np.zeros((n_frames, 3))
    odometry[1:] = [0.08, 0.0, 0.08]
    path = np.zeros((n_frames, 3))
    for k in range(1, n_frames):
        disturbance = rng.standard_normal(3) * NOISE.standard_deviations(odometry[k])
        path[k] = compose(path[k - 1], odometry[k] + disturbance)
    point_m = scattered(rng, n_landmarks, planar) if point_m is None else point_m
    obs = [_sightings(rng, path[k], point_m, planar) for k in range(n_frames)]
    iteration = np.repeat(np.arange(n_frames), [len(label) for label, _, _ in obs])
    label, position, covariance = map(np.concatenate, zip(*obs, strict=True))
    observations = Observations(position, covariance, None, label.astype(np.int32))
    return Known(
        RobotLog("R1", planar, np.arange(n_frames) * 0.2, odometry, iteration, observations),
        path,
        point_m,
    )


def scattered(rng: np.random.Generator, n_landmarks: int, planar: bool) -> Float:
    """Landmarks (L, 3) all around."""
    height = np.zeros(n_landmarks) if planar else rng.uniform(0, 1, n_landmarks)
    return np.column_stack([rng.uniform(-3, 4, (n_landmarks, 2)), height])


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


def with_tracks(
    known: Known, rng: np.random.Generator, stray_m: float, most_frames: int = 6
) -> Known:
    """The same log, where each track is of a point beside the landmark.

    A track holds a landmark's observations in consecutive frames, but no more than `most_frames`;
    every tenth observation is of the landmark itself and belongs to none.
    """
    log, obs = known.log, known.log.observations
    assert obs.label is not None
    track, open_tracks, n_tracks = np.full(len(obs), -1, dtype=np.int32), {}, 0
    for row, (label, frame) in enumerate(zip(obs.label, log.iteration, strict=True)):
        if rng.uniform() < 0.1:
            continue
        own, last, count = open_tracks.get(label, (-1, -2, 0))
        if last != frame - 1 or count == most_frames:
            own, count, n_tracks = n_tracks, 0, n_tracks + 1
        open_tracks[label], track[row] = (own, frame, count + 1), own
    offset = stray_m * rng.standard_normal((n_tracks, 3))
    tracked = known._replace(log=replace(log, observations=replace(obs, track=track)))
    return tracked._replace(log=_displaced(tracked, offset))


def moved_tracks(
    known: Known, rng: np.random.Generator, tracks: np.ndarray, distance_m: float
) -> RobotLog:
    """The log with some tracks (n,) moved as a whole, each by this distance and its own way."""
    track = known.log.observations.track
    assert track is not None
    offset = np.zeros((track.max() + 1, 3))
    way = rng.standard_normal((len(tracks), 3))
    offset[tracks] = distance_m * way / np.linalg.norm(way, axis=1, keepdims=True)
    return _displaced(known, offset)


def _displaced(known: Known, offset: Float) -> RobotLog:
    """The log with the tracks' points moved by offsets (B, 3) in the frame of the truth."""
    log, obs = known.log, known.log.observations
    assert obs.track is not None
    by = np.where(obs.track[:, None] >= 0, offset[obs.track], 0.0)
    by[:, 2] *= not log.planar
    position, heading = obs.position_m.copy(), known.path[log.iteration, 2]
    position[:, :2] += np.einsum("nji,nj->ni", rotation(heading), by[:, :2])
    position[:, 2] += by[:, 2]
    return replace(log, observations=replace(obs, position_m=position))
