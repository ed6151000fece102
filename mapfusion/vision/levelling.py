"""Observations of a body that tilts, in the level frame: what tilts is no error."""

import numpy as np

from mapfusion.attitude import Attitude, levelled, moved
from mapfusion.robot_log import Observations
from mapfusion.se2 import Float
from mapfusion.se3 import tilt
from mapfusion.vision.attitude_filter import AttitudeFilter, Measured
from mapfusion.vision.gyroscope import Gyroscope
from mapfusion.vision.rigid_links import RigidMotion

# Standard deviation of roll and pitch of a body on wheels, a car's on a road or a robot's on its
# springs, of which nothing is known: about a degree and a half.
_BODY_RAD = 0.025


class Levelling:
    """The attitude of a robot along its log, by what is measured of it and by its links.

    Args:
        T_robot_seen: (4, 4) from the frame that the camera's points and motions are given in to the
            robot's; None where they are the same.
        shared_rad: standard deviation of what all that is measured of roll and pitch errs by alike,
            which no filter sees.
    """

    def __init__(self, T_robot_seen: Float | None = None, shared_rad: float = 0.0) -> None:
        self._T_robot_seen = T_robot_seen
        self._shared_rad2 = shared_rad**2
        self._filter, self._gyroscope = AttitudeFilter(), Gyroscope()
        self._values: list[Float] = []
        self._sigmas: list[Float] = []
        self._carried: list[Float] = []

    @property
    def attitude(self) -> Attitude:
        """Of the frames so far."""
        sigma, carried = np.array(self._sigmas), np.array(self._carried)
        if self._shared_rad2:
            own = np.mean(sigma[:-1, :2] ** 2, axis=1)
            carried[1:, 0] = (carried[1:, 0] * own + self._shared_rad2) / (own + self._shared_rad2)
            sigma[:, :2] = np.sqrt(sigma[:, :2] ** 2 + self._shared_rad2)
        return Attitude(np.array(self._values), sigma, carried)

    def expected_turn(self, measured: Measured) -> Float | None:
        """R_after_before (3, 3) in the camera's frame, by what is measured of the next frame.

        None where nothing is, and for the first frame.
        """
        if not self._values or np.isnan(measured.value[:2]).any():
            return None
        before, after = (tilt(*value[:2]) for value in (self._values[-1], measured.value))
        turn = after.T @ before
        if self._T_robot_seen is None:
            return turn
        seen = self._T_robot_seen[:3, :3]
        return seen.T @ turn @ seen

    def add(
        self,
        motion: RigidMotion | None,
        measured: Measured,
        counted: tuple[Float, float] | None = None,
    ) -> None:
        """The next frame: how the links say that the camera moved, and what was measured.

        `counted` is the robot's turn since the frame before by gyroscopes, a rotation vector (3,)
        in the robot's axes then, and the seconds since. Where nothing tells roll and pitch, the
        body is level in the mean.
        """
        if self._values:
            if motion is not None and self._T_robot_seen is not None:
                motion = motion.of(self._T_robot_seen)
            if counted is not None:
                motion = self._gyroscope.joined(*counted, motion)
            self._filter.move(motion)
        if motion is None and np.isnan(measured.value[:2]).any():
            told = np.array([0.0, 0.0, measured.value[2]])
            measured = Measured(told, np.array([_BODY_RAD, _BODY_RAD, measured.sigma[2]]))
        self._filter.measure(measured)
        self._values.append(self._filter.value)
        self._sigmas.append(self._filter.sigma)
        roll, pitch, height = self._filter.carried
        self._carried.append(np.array([(roll + pitch) / 2, height]))

    def applied(self, observed: Observations) -> Observations:
        """Observations of the last frame, as the camera's frame has them, in the level frame."""
        T = self._T_robot_seen
        own = observed if T is None else moved(observed, T[:3, :3], T[:3, 3])
        return levelled(own, self._values[-1], np.sqrt(np.diag(self._filter.fresh)))
