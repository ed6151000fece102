"""Logs of known odometry noise: a robot that circles among points."""

import numpy as np

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, rotation
from mapfusion.robot_log import Observations, RobotLog

NOISE = MotionNoise(scale_error=0.0, track_error=0.0)
STEP = np.array([0.1, 0.0, 0.04])
N_FRAMES = 320


def path_of(
    odometry: Float, factor: float, rng: np.random.Generator, noise: MotionNoise = NOISE
) -> Float:
    """Return true poses whose increments differ from the odometry by `factor` times its noise."""
    path = np.zeros_like(odometry)
    for k in range(1, len(path)):
        sigma = factor * noise.standard_deviations(odometry[k])
        path[k] = compose(path[k - 1], odometry[k] + sigma * rng.standard_normal(3))
    return path


def circling(step: Float = STEP) -> Float:
    odometry = np.tile(step, (N_FRAMES, 1))
    odometry[0] = 0.0
    return odometry


def seen_log(factor: float, seed: int, tracks: bool = False) -> RobotLog:
    """Return a log of a robot that circles among points, with labels or with tracks."""
    rng = np.random.default_rng(seed)
    odometry = circling()
    path, sigma_m = path_of(odometry, factor, rng), 0.002
    points = rng.uniform(-8, 8, (60, 2))
    frames, positions, names = [], [], []
    for k, pose in enumerate(path):
        local = (points - pose[:2]) @ rotation(pose[2])
        near = np.flatnonzero(np.hypot(*local.T) < 6)
        frames += [k] * len(near)
        positions.append(local[near] + rng.normal(0, sigma_m, (len(near), 2)))
        names.append(near)
    position = np.concatenate(positions)
    name = np.concatenate(names).astype(np.int32)
    seen = Observations(
        np.column_stack([position, np.zeros(len(position))]),
        np.tile(np.diag([sigma_m**2, sigma_m**2, 0.0]), (len(position), 1, 1)),
        label=None if tracks else name,
        track=name if tracks else None,
    )
    time_s = np.linspace(0, 0.2 * (len(odometry) - 1), len(odometry))
    return RobotLog("R1", True, time_s, odometry, np.array(frames), seen)
