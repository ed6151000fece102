"""Logs of ranges and bearings whose odometry points beside the true motion."""

from dataclasses import replace

import numpy as np

from mapfusion.datasets.point_logs import points_of_ranges
from mapfusion.datasets.relative_motion import poses_from_increments
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import rotation, wrap
from mapfusion.robot_log import Observations, RobotLog

NOISE = MotionNoise()
SPEED_M_S, TURN_RATE_RAD_S, STEP_S, DURATION_S = 0.8, 0.12, 0.5, 80.0
RANGE_SIGMA_M, BEARING_SIGMA_RAD, REACH_M, WIDEST_RAD = 0.08, 0.015, 8.0, 2.0
N_TREES = 25


def arcs(turns: Float) -> Float:
    """Return increments along arcs of equal length, whose chords point to half of the turn."""
    chord = SPEED_M_S * STEP_S * np.sinc(turns / 2 / np.pi)
    made = np.column_stack([chord * np.cos(turns / 2), chord * np.sin(turns / 2), turns])
    made[0] = 0.0
    return made


def turns_of(shape: str) -> Float:
    time_s = np.arange(0, DURATION_S, STEP_S)
    rate = {"circle": 1.0 + 0 * time_s, "bends": 3 * np.sin(2 * np.pi * time_s / 20)}[shape]
    return TURN_RATE_RAD_S * STEP_S * rate


def drive(
    seed: int, shape: str = "circle", labels: bool = True, sensor_rad: float = 0.0
) -> RobotLog:
    """Return a log of ranges and bearings of trees with the stated noise of the odometry."""
    rng = np.random.default_rng(seed)
    increments = arcs(turns_of(shape))
    poses = poses_from_increments(increments)
    around = np.array([0.0, SPEED_M_S / TURN_RATE_RAD_S])
    trees = around + rng.uniform(-12, 12, (N_TREES, 2))
    sigma = np.array([NOISE.standard_deviations(each) for each in increments])
    odometry = increments + sigma * rng.standard_normal(sigma.shape)
    odometry[0] = 0.0
    offset = trees - poses[:, None, :2]
    range_m = np.hypot(offset[..., 0], offset[..., 1])
    bearing_rad = wrap(np.arctan2(offset[..., 1], offset[..., 0]) - poses[:, 2:] - sensor_rad)
    frame, tree = np.nonzero((range_m < REACH_M) & (np.abs(bearing_rad) < WIDEST_RAD))
    noise = rng.standard_normal((2, len(frame)))
    measured_m = range_m[frame, tree] + RANGE_SIGMA_M * noise[0]
    measured_rad = bearing_rad[frame, tree] + BEARING_SIGMA_RAD * noise[1]
    points = points_of_ranges(
        measured_m, measured_rad, np.full(len(frame), RANGE_SIGMA_M), BEARING_SIGMA_RAD
    )
    seen = Observations(*points, label=tree.astype(np.int32) if labels else None)
    return RobotLog("R1", True, STEP_S * np.arange(len(odometry)), odometry, frame, seen)


def turned(log: RobotLog, share: float) -> RobotLog:
    """Return the log with increments turned by a share of their turn."""
    angle = share * log.odometry[:, 2]
    shifts = np.einsum("nij,nj->ni", rotation(angle), log.odometry[:, :2])
    return replace(log, odometry=np.column_stack([shifts, log.odometry[:, 2]]))
