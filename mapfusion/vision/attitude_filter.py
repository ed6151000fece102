"""Attitude filter: accelerometer, gyroscope, visual rotation; observations in the level frame.

A gyroscope counts turns where the pictures show nothing, but for a bias that hardly changes. The
filter of Mahony, Hamel, Pflimlin 2008 ("Nonlinear complementary filters on the special orthogonal
group", IEEE Transactions on Automatic Control 53) learns it from directions with a fixed gain; here
a Kalman filter does from the turns of the pictures, so that it knows how well it does.

An inclinometer errs by tenths of a degree from frame to frame but never drifts; the links between
two frames tell a turn ten times as well, and add up their errors. A Kalman filter over roll, pitch
and height takes the best of both. It only looks back: a log at an iteration holds nothing that was
seen later.
"""

from dataclasses import dataclass, field

import numpy as np

from mapfusion.attitude import Attitude, level_observations, transform_observations
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se3 import roll_pitch, tilt
from mapfusion.robot_log import Observations
from mapfusion.vision.visual_odometry import RigidMotion

# Of a gyroscope that nobody has set to zero: 0.1 rad/s is 6 degrees a second, twice what those of a
# drone's controller begin with. Its wander over a minute is hundredths of that.
_BIAS_RAD_S = 0.1
_WANDER_RAD_S_PER_SQRT_S = 2e-4
# White noise of the rate, an angle's random walk: a phone's, and more where it shakes.
_NOISE_RAD_PER_SQRT_S = 1e-3
LOST_M = 0.1  # by how much a body may shift in a step that nothing tells of


@dataclass
class Gyroscope:
    """What is known of the bias of one gyroscope.

    Attributes:
        bias: (3,) rad/s.
        covariance: (3, 3) of its error.
    """

    bias: Float = field(default_factory=lambda: np.zeros(3))
    covariance: Float = field(default_factory=lambda: _BIAS_RAD_S**2 * np.eye(3))

    def joined(self, counted: Float, seconds: float, motion: RigidMotion | None) -> RigidMotion:
        """The motion since the frame before by pictures and gyroscope, and the bias by both.

        Args:
            counted: (3,) rotation vector since the frame before, in its axes.
            seconds: since then.
            motion: by the pictures, in the same axes; None where they tell none.
        """
        from scipy.spatial.transform import Rotation

        noise = _NOISE_RAD_PER_SQRT_S**2 * seconds * np.eye(3)
        self.covariance = self.covariance + _WANDER_RAD_S_PER_SQRT_S**2 * seconds * np.eye(3)
        own = noise + seconds**2 * self.covariance
        turn = Rotation.from_rotvec(counted - seconds * self.bias)
        if motion is None:
            covariance = np.zeros((6, 6))
            covariance[:3, :3], covariance[3:, 3:] = LOST_M**2 * np.eye(3), own
            return RigidMotion(se3.pose(turn.as_matrix(), np.zeros(3)), covariance, 0)
        T, C = motion.T_before_after, motion.covariance
        seen = Rotation.from_matrix(T[:3, :3])
        more = (turn * seen.inv()).as_rotvec()  # than the pictures have, about the axes before
        S = C[3:, 3:] + own
        gain = np.linalg.solve(S, C[3:]).T  # (6, 3)
        step = gain @ more
        R = (Rotation.from_rotvec(step[3:]) * seen).as_matrix()
        covariance = C - gain @ C[3:]
        learnt = np.linalg.solve(S, seconds * self.covariance).T
        self.bias = self.bias + learnt @ more
        self.covariance = self.covariance - seconds * learnt @ self.covariance
        joined = se3.pose(R, T[:3, 3] + step[:3])
        return RigidMotion(joined, (covariance + covariance.T) / 2, motion.n_links)


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
        own = observed if T is None else transform_observations(observed, T[:3, :3], T[:3, 3])
        return level_observations(own, self._values[-1], np.sqrt(np.diag(self._filter.fresh)))
