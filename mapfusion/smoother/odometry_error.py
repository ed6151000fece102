"""Errors of an odometry that stay the same: what its increments have to be corrected by.

An increment (x, y, theta) of the log stands for the motion

    ((1 + distance) x, (1 + distance) y,
     (1 + turn + in_place s) theta + late_turn theta_before + bias |(x, y)|)

with the heading increment before it, theta_before: a late_turn beside a turn of its negative is a
delay of the odometry. In place a robot turns by another share of what is counted than while it
drives: wheels that run against each other slip otherwise, and motors that are near their limit
cannot add a turn to a motion. s is the share of a turn that is made in place,

    s = max(0, 1 - |(x, y)| / (r |theta|)),

1 of a turn on the spot, 0 of one with a radius of r and more, with which no wheel runs backwards.
All is linear in the constants, so their estimate is a least squares.
"""

from dataclasses import astuple, dataclass, fields, replace

import numpy as np

from mapfusion.arguments import require_finite, require_shape
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, wrap

# r: half the track of a small robot (0.13 m of an iRobot Create, 0.2 m of a P3-AT).
HALF_TRACK_M = 0.15


@dataclass(frozen=True)
class OdometryError:
    """The constants of one robot.

    Attributes:
        distance: relative error of distances.
        turn: relative error of the turns.
        late_turn: share of the turn before that is only made now.
        bias_rad_per_m: turn with the way that wheels of unequal size do not count.
        in_place: relative error of turns in place, beside `turn`.
    """

    distance: float = 0.0
    turn: float = 0.0
    late_turn: float = 0.0
    bias_rad_per_m: float = 0.0
    in_place: float = 0.0

    @classmethod
    def of(cls, constants: Float) -> "OdometryError":
        """From an array (5,) in the order of the attributes."""
        require_shape("constants", constants, (N_CONSTANTS,))
        require_finite("constants", constants)
        return cls(*map(float, constants))

    @property
    def constants(self) -> Float:
        """(5,) in the order of the attributes."""
        return np.array(astuple(self))

    def corrected(self, odometry: Float) -> Float:
        """The increments (T, 3) without these errors."""
        moved = odometry + np.einsum("kdc,c->kd", sensitivity(odometry), self.constants)
        moved[:, 2] = wrap(moved[:, 2])
        return moved

    def corrected_log(self, log: RobotLog) -> RobotLog:
        """The log with its increments corrected."""
        return replace(log, odometry=self.corrected(log.odometry))


N_CONSTANTS = len(fields(OdometryError))


def sensitivity(odometry: Float) -> Float:
    """(T, 3, 5) by how much each constant changes the increments (T, 3)."""
    by = np.zeros((len(odometry), 3, N_CONSTANTS))
    way, turn = np.hypot(odometry[:, 0], odometry[:, 1]), odometry[:, 2]
    by[:, :2, 0] = odometry[:, :2]
    by[:, 2, 1] = turn
    by[1:, 2, 2] = turn[:-1]
    by[:, 2, 3] = way
    # s |theta| = max(0, |theta| - way / r)
    by[:, 2, 4] = np.sign(turn) * np.maximum(0.0, np.abs(turn) - way / HALF_TRACK_M)
    return by
