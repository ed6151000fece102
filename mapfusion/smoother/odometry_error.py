"""Errors of an odometry that stay the same: what its increments have to be corrected by.

An increment (x, y, theta) of the log stands for the motion

    ((1 + distance) x, (1 + distance) y, (1 + turn) theta + late_turn theta_before + bias |(x, y)|)

with the heading increment before it, theta_before: a late_turn beside a turn of its negative is a
delay of the odometry. It is linear in the constants, so their estimate is a least squares.
"""

from dataclasses import dataclass, replace

import numpy as np

from mapfusion.arguments import require_finite, require_shape
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, wrap


@dataclass(frozen=True)
class OdometryError:
    """The constants of one robot.

    Attributes:
        distance: relative error of distances.
        turn: relative error of the turns.
        late_turn: share of the turn before that is only made now.
        bias_rad_per_m: turn with the way that wheels of unequal size do not count.
    """

    distance: float = 0.0
    turn: float = 0.0
    late_turn: float = 0.0
    bias_rad_per_m: float = 0.0

    @classmethod
    def of(cls, constants: Float) -> "OdometryError":
        """From an array (4,) in the order of the attributes."""
        require_shape("constants", constants, (4,))
        require_finite("constants", constants)
        return cls(*map(float, constants))

    @property
    def constants(self) -> Float:
        """(4,) in the order of the attributes."""
        return np.array([self.distance, self.turn, self.late_turn, self.bias_rad_per_m])

    def corrected(self, odometry: Float) -> Float:
        """The increments (T, 3) without these errors."""
        moved = odometry + np.einsum("kdc,c->kd", sensitivity(odometry), self.constants)
        moved[:, 2] = wrap(moved[:, 2])
        return moved

    def corrected_log(self, log: RobotLog) -> RobotLog:
        """The log with its increments corrected."""
        return replace(log, odometry=self.corrected(log.odometry))


def sensitivity(odometry: Float) -> Float:
    """(T, 3, 4) by how much each constant changes the increments (T, 3)."""
    by = np.zeros((len(odometry), 3, 4))
    by[:, :2, 0] = odometry[:, :2]
    by[:, 2, 1] = odometry[:, 2]
    by[1:, 2, 2] = odometry[:-1, 2]
    by[:, 2, 3] = np.hypot(odometry[:, 0], odometry[:, 1])
    return by
