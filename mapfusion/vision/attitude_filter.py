"""Attitude of a body from what is measured of it frame by frame and how pictures say it turned.

An inclinometer errs by tenths of a degree from frame to frame but never drifts; the links between
two frames tell a turn ten times as well, and add up their errors. A Kalman filter over roll, pitch
and height takes the best of both. It only looks back: a log at an iteration holds nothing that was
seen later.
"""

from dataclasses import dataclass, field

import numpy as np

from mapfusion.se2 import Float
from mapfusion.se3 import roll_pitch, tilt
from mapfusion.vision.gyroscope import LOST_M
from mapfusion.vision.rigid_links import RigidMotion

# Standard deviation of an attitude that nothing has told yet, rad and m: anything.
_UNKNOWN = np.array([1.0, 1.0, 100.0])
# Of the error's part that no landmark in view has in common, what the next frame keeps: tracks last
# for some twenty frames, and what came before them tilts all that is in view alike.
_IN_VIEW = 1 - 1 / 20


@dataclass(frozen=True)
class Measured:
    """What was measured of an attitude.

    Attributes:
        value: (3,) roll, pitch and height; NaN for what was not.
        sigma: (3,) standard deviations.
    """

    value: Float
    sigma: Float


@dataclass
class AttitudeFilter:
    """Follows roll, pitch and height of one body.

    Attributes:
        value: (3,) as known now.
        covariance: (3, 3) of its error.
        fresh: (3, 3) of what came to its error while a landmark stays in view; nothing in the first
            frame, whose plane is the map's.
        carried: (3,) share of the error of the frame before that is left in it.
    """

    value: Float = field(default_factory=lambda: np.zeros(3))
    covariance: Float = field(default_factory=lambda: np.diag(_UNKNOWN**2))
    fresh: Float = field(default_factory=lambda: np.zeros((3, 3)))
    carried: Float = field(default_factory=lambda: np.zeros(3))
    _moved: bool = False

    @property
    def sigma(self) -> Float:
        """Standard deviations (3,) of roll, pitch and height."""
        return np.sqrt(np.diag(self.covariance))

    def move(self, motion: RigidMotion | None) -> None:
        """On to the next frame; None: it may have moved in any way."""
        if motion is None:
            height = self.covariance[2, 2] + LOST_M**2
            self.covariance = np.diag([*(_UNKNOWN[:2] ** 2), height])
            self.fresh = np.diag([*(_UNKNOWN[:2] ** 2), LOST_M**2])
            self.carried, self._moved = np.array([0.0, 0.0, 1.0]), True
            return
        before = tilt(self.value[0], self.value[1])
        T = motion.T_before_after
        after, step = before @ T[:3, :3], before @ T[:3, 3]
        # errors are small turns about the level axes; they follow the heading
        heading = np.arctan2(after[1, 0], after[0, 0])
        cos, sin = np.cos(heading), np.sin(heading)
        ahead = np.array([[cos, sin], [-sin, cos]])
        jacobian = np.zeros((3, 3))
        jacobian[:2, :2] = ahead
        # a step that points elsewhere than was thought climbs: z of (turn x step)
        jacobian[2] = [step[1], -step[0], 1.0]
        own = np.zeros((3, 6))  # by the errors of the turn, given in the body's axes before
        own[:2, 3:] = ahead @ before[:2]
        own[2, :3] = before[2]
        self.value = np.array([*roll_pitch(after), self.value[2] + step[2]])
        told = own @ motion.covariance @ own.T
        self.covariance = jacobian @ self.covariance @ jacobian.T + told
        self.fresh = _IN_VIEW * (jacobian @ self.fresh @ jacobian.T) + told
        self.carried, self._moved = np.ones(3), True

    def measure(self, measured: Measured) -> None:
        """Take in what was measured in this frame."""
        rows = np.flatnonzero(np.isfinite(measured.value))
        pick = np.eye(3)[rows]
        S = pick @ self.covariance @ pick.T + np.diag(measured.sigma[rows] ** 2)
        gain = np.linalg.solve(S, pick @ self.covariance).T
        self.value = self.value + gain @ (measured.value - self.value)[rows]
        rest = np.eye(3) - gain @ pick
        # Joseph's form: stays symmetric and positive
        noise = gain @ np.diag(measured.sigma[rows] ** 2) @ gain.T
        self.covariance = rest @ self.covariance @ rest.T + noise
        if self._moved:
            self.fresh = rest @ self.fresh @ rest.T + noise
        self.carried = np.clip(self.carried * np.diag(rest), 0.0, 1.0)
