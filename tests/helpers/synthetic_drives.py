"""Synthetic drives whose truth is known: path shapes, and odometry better or worse than stated."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, rotation
from mapfusion.robot_log import Observations, RobotLog

STATED = MotionNoise()
STEP_M = 0.1
TURN_STEPS = 10  # frames of a quarter turn, made in place
LANDMARKS_PER_M = 2.0
SIDE_M = (0.5, 3.0)  # distance of landmarks from the path
VIEW_M, HALF_VIEW_RAD = (0.5, 6.0), 0.7
MOST_SEEN = 6  # observations in a frame
SIGMA = 0.01  # standard deviation of an observation, as a share of its range
TRACK_FRAMES = 12  # frames after which a landmark's track is lost and another begins

_AHEAD, _QUARTER = np.array([STEP_M, 0, 0]), np.array([0, 0, np.pi / 2 / TURN_STEPS])


class Drive(NamedTuple):
    """A log and the truth: path (T, 3) and landmarks (L, 3), which the labels number."""

    log: RobotLog
    path: Float
    point_m: Float


def _laps(n_frames: int, n_laps: int) -> Float:
    side = max(round(n_frames / n_laps / 4) - TURN_STEPS, 1)
    quarter = np.concatenate([np.tile(_AHEAD, (side, 1)), np.tile(_QUARTER, (TURN_STEPS, 1))])
    return np.tile(quarter, (4 * n_laps + 4, 1))[:n_frames]


def _out_and_back(n_frames: int) -> Float:
    way = max((n_frames - 2 * TURN_STEPS) // 2, 1)
    turn = np.tile(_QUARTER, (2 * TURN_STEPS, 1))
    legs = [np.tile(_AHEAD, (way, 1)), turn, np.tile(_AHEAD, (n_frames, 1))]
    return np.concatenate(legs)[:n_frames]


def _with_stops(n_frames: int) -> Float:
    motion = _laps(n_frames, 2).copy()
    motion[np.arange(n_frames) // 15 % 3 == 0] = 0.0
    return motion


# Each gives the motions (T, 3) of a drive of so many frames.
SHAPES: dict[str, Callable[[int], Float]] = {
    "lap": lambda n: _laps(n, 1),
    "laps": lambda n: _laps(n, 5),
    "back": _out_and_back,
    "straight": lambda n: np.tile(_AHEAD, (n, 1)),
    "stops": _with_stops,
    "still": lambda n: np.zeros((n, 3)),
}


def drive(
    shape: str,
    n_frames: int,
    noise: float,
    seed: int,
    tracks: bool = False,
    stray_m: float = 0.0,
    stated: MotionNoise = STATED,
) -> Drive:
    """Return a drive whose odometry errs by `noise` times the stated standard deviations.

    Args:
        shape: one of `SHAPES`.
        n_frames: T.
        noise: 0 for exact odometry.
        seed: of landmarks and errors.
        tracks: whether observations come in tracks.
        stray_m: standard deviation of a track's point beside its landmark, along each axis.
        stated: noise that the smoother is told.
    """
    rng = np.random.default_rng(seed)
    motion = SHAPES[shape](n_frames)
    motion[0] = 0.0
    path = np.zeros((n_frames, 3))
    for k in range(1, n_frames):
        path[k] = compose(path[k - 1], motion[k])
    sigma = np.array([stated.standard_deviations(each) for each in motion])
    odometry = motion + noise * sigma * rng.standard_normal(motion.shape)
    point_m = _landmarks(rng, path)
    frame, label = _seen(path, point_m)
    offset = point_m[label]
    offset[:, :2] -= path[frame, :2]
    at = offset.copy()
    at[:, :2] = np.einsum("nji,nj->ni", rotation(path[frame, 2]), offset[:, :2])
    track = None
    if tracks:
        track = _tracks(frame, label)
        stray = stray_m * rng.standard_normal((track.max(initial=-1) + 1, 3))[track]
        at[:, :2] += np.einsum("nji,nj->ni", rotation(path[frame, 2]), stray[:, :2])
        at[:, 2] += stray[:, 2]
    sigma_m = SIGMA * np.hypot(at[:, 0], at[:, 1])
    position = at + sigma_m[:, None] * rng.standard_normal(at.shape)
    covariance = sigma_m[:, None, None] ** 2 * np.eye(3)
    seen = Observations(position, covariance, None, label.astype(np.int32), track=track)
    time_s = 0.2 * np.arange(n_frames)
    return Drive(RobotLog("R1", False, time_s, odometry, frame, seen), path, point_m)


def _landmarks(rng: np.random.Generator, path: Float) -> Float:
    """Place landmarks (L, 3) beside the places of a path that it comes to for the first time."""
    place = np.round(path[:, :2] / STEP_M).astype(np.int64)
    _, first = np.unique(place, axis=0, return_index=True)
    n = max(round(LANDMARKS_PER_M * STEP_M * len(first)), 30)
    at = path[rng.choice(first, n), :2]
    way, away = rng.uniform(0, 2 * np.pi, n), rng.uniform(*SIDE_M, n)
    beside = np.stack([np.cos(way), np.sin(way)], 1) * away[:, None]
    return np.column_stack([at + beside, rng.uniform(-1, 1, n)])


def _seen(path: Float, point_m: Float) -> tuple[np.ndarray, np.ndarray]:
    """Frame and landmark of each observation: in each frame the nearest that are in view."""
    frames, labels = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for k, pose in enumerate(path):
        local = (point_m[:, :2] - pose[:2]) @ rotation(pose[2])
        range_m, bearing = np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])
        inside = (range_m > VIEW_M[0]) & (range_m < VIEW_M[1]) & (np.abs(bearing) < HALF_VIEW_RAD)
        own = np.flatnonzero(inside)
        own = np.sort(own[np.argsort(range_m[own], kind="stable")[:MOST_SEEN]])
        frames.append(np.full(len(own), k))
        labels.append(own)
    return np.concatenate(frames), np.concatenate(labels)


def _tracks(frame: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(N,) number of the track of each observation."""
    track, current, n_tracks = np.empty(len(frame), np.int32), dict[int, tuple[int, int, int]](), 0
    for row, (k, own) in enumerate(zip(frame.tolist(), label.tolist(), strict=True)):
        number, last, length = current.get(own, (-1, -2, 0))
        if last != k - 1 or length == TRACK_FRAMES:
            number, length, n_tracks = n_tracks, 0, n_tracks + 1
        current[own], track[row] = (number, k, length + 1), number
    return track
