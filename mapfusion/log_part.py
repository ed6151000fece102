"""The beginning of a log."""

from dataclasses import replace

import numpy as np

from mapfusion.robot_log import RobotLog


def first_frames(log: RobotLog, n_frames: int) -> RobotLog:
    """The log as it was after so many frames."""
    n = int(np.searchsorted(log.iteration, n_frames))
    return replace(
        log,
        time_s=log.time_s[:n_frames],
        odometry=log.odometry[:n_frames],
        iteration=log.iteration[:n],
        observations=log.observations[:n],
    )
