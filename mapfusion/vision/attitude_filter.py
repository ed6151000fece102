"""Attitude filter: accelerometer, gyroscope and visual rotation; observations in the level frame.

A gyroscope measures rotations where the images show nothing, but has a slowly varying bias. The
filter of Mahony, Hamel, Pflimlin 2008 ("Nonlinear complementary filters on the special orthogonal
group", IEEE Transactions on Automatic Control 53) estimates the bias from directions with a fixed
gain. Here a Kalman filter estimates the bias from visual rotations, with its covariance.

An inclinometer has large errors from frame to frame but no drift. Visual odometry has small errors
from frame to frame, but they accumulate. A Kalman filter over roll, pitch and height combines both.
The filter is causal: the attitude of a frame does not depend on later frames.
"""

from dataclasses import dataclass, field

import numpy as np

from mapfusion.attitude import Attitude, level_observations, transform_observations
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se3 import roll_pitch, tilt
from mapfusion.robot_log import Observations
from mapfusion.vision.visual_odometry import RigidMotion

# Initial bias of an uncalibrated gyroscope: 6 degrees per second, twice that of a drone's
# controller. The random walk of the bias over a minute is about a hundredth of the initial bias.
_BIAS_RAD_S = 0.1
_BIAS_WALK_RAD_S_PER_SQRT_S = 2e-4
# Angle random walk by white noise of the rate: a phone's, increased for vibration.
_NOISE_RAD_PER_SQRT_S = 1e-3
LOST_M = 0.1  # standard deviation of the translation in a step without links


@dataclass
class Gyroscope:
    """Bias of a gyroscope.

    Attributes:
        bias: estimate in rad/s, shape (3,).
        covariance: covariance of the estimate, shape (3, 3).
    """

    bias: Float = field(default_factory=lambda: np.zeros(3))
    covariance: Float = field(default_factory=lambda: _BIAS_RAD_S**2 * np.eye(3))

    def fuse(self, rotation: Float, seconds: float, motion: RigidMotion | None) -> RigidMotion:
        """Fuse a gyroscope's rotation with visual odometry, and update the bias.

        Args:
            rotation: rotation vector since the frame before, in its axes, shape (3,).
            seconds: time since the frame before.
            motion: motion by visual odometry, in the same axes; None without links.

        Returns:
            Fused motion since the frame before.
        """
        from scipy.spatial.transform import Rotation

        noise = _NOISE_RAD_PER_SQRT_S**2 * seconds * np.eye(3)
        bias_walk = _BIAS_WALK_RAD_S_PER_SQRT_S**2 * seconds * np.eye(3)
        self.covariance = self.covariance + bias_walk
        rotation_covariance = noise + seconds**2 * self.covariance
        by_gyroscope = Rotation.from_rotvec(rotation - seconds * self.bias)
        if motion is None:
            covariance = np.zeros((6, 6))
            covariance[:3, :3], covariance[3:, 3:] = LOST_M**2 * np.eye(3), rotation_covariance
            return RigidMotion(se3.pose(by_gyroscope.as_matrix(), np.zeros(3)), covariance, 0)
        T, C = motion.T_before_after, motion.covariance
        visual = Rotation.from_matrix(T[:3, :3])
        innovation = (by_gyroscope * visual.inv()).as_rotvec()  # about the axes before
        S = C[3:, 3:] + rotation_covariance
        gain = np.linalg.solve(S, C[3:]).T  # (6, 3)
        step = gain @ innovation
        R = (Rotation.from_rotvec(step[3:]) * visual).as_matrix()
        covariance = C - gain @ C[3:]
        bias_gain = np.linalg.solve(S, seconds * self.covariance).T
        self.bias = self.bias + bias_gain @ innovation
        self.covariance = self.covariance - seconds * bias_gain @ self.covariance
        T_fused = se3.pose(R, T[:3, 3] + step[:3])
        return RigidMotion(T_fused, (covariance + covariance.T) / 2, motion.n_links)


# Standard deviation of an unknown attitude, rad and m.
_UNKNOWN = np.array([1.0, 1.0, 100.0])
# Share of the `fresh` covariance that the next frame keeps: a track lasts for about twenty frames,
# and an older error is common to all landmarks in view.
_IN_VIEW = 1 - 1 / 20


@dataclass(frozen=True)
class AttitudeMeasurement:
    """Measured attitude of one frame.

    Attributes:
        value: roll, pitch and height, shape (3,); NaN if not measured.
        sigma: standard deviations, shape (3,).
    """

    value: Float
    sigma: Float


@dataclass
class AttitudeFilter:
    """Kalman filter of roll, pitch and height of one body.

    Attributes:
        value: estimate, shape (3,).
        covariance: covariance of the estimate, shape (3, 3).
        fresh: part of the covariance that arose while a landmark stays in view, shape (3, 3); zero
            in the first frame, whose plane is the map's.
        carried: share of the error of the frame before that remains, shape (3,).
    """

    value: Float = field(default_factory=lambda: np.zeros(3))
    covariance: Float = field(default_factory=lambda: np.diag(_UNKNOWN**2))
    fresh: Float = field(default_factory=lambda: np.zeros((3, 3)))
    carried: Float = field(default_factory=lambda: np.zeros(3))
    _moved: bool = False

    @property
    def sigma(self) -> Float:
        """Standard deviations of roll, pitch and height, shape (3,)."""
        return np.sqrt(np.diag(self.covariance))

    def move(self, motion: RigidMotion | None) -> None:
        """Predict the next frame by a motion; None for an unknown motion."""
        if motion is None:
            height = self.covariance[2, 2] + LOST_M**2
            self.covariance = np.diag([*(_UNKNOWN[:2] ** 2), height])
            self.fresh = np.diag([*(_UNKNOWN[:2] ** 2), LOST_M**2])
            self.carried, self._moved = np.array([0.0, 0.0, 1.0]), True
            return
        before = tilt(self.value[0], self.value[1])
        T = motion.T_before_after
        after, step = before @ T[:3, :3], before @ T[:3, 3]
        # errors are small rotations about the level axes, which follow the heading
        heading = np.arctan2(after[1, 0], after[0, 0])
        cos, sin = np.cos(heading), np.sin(heading)
        ahead = np.array([[cos, sin], [-sin, cos]])
        jacobian = np.zeros((3, 3))
        jacobian[:2, :2] = ahead
        # an attitude error changes the height: z of (rotation x step)
        jacobian[2] = [step[1], -step[0], 1.0]
        by_motion = np.zeros((3, 6))  # derivative by the motion's error, in the axes before
        by_motion[:2, 3:] = ahead @ before[:2]
        by_motion[2, :3] = before[2]
        self.value = np.array([*roll_pitch(after), self.value[2] + step[2]])
        process_noise = by_motion @ motion.covariance @ by_motion.T
        self.covariance = jacobian @ self.covariance @ jacobian.T + process_noise
        self.fresh = _IN_VIEW * (jacobian @ self.fresh @ jacobian.T) + process_noise
        self.carried, self._moved = np.ones(3), True

    def measure(self, measured: AttitudeMeasurement) -> None:
        """Update the estimate by a measurement of this frame."""
        rows = np.flatnonzero(np.isfinite(measured.value))
        pick = np.eye(3)[rows]
        S = pick @ self.covariance @ pick.T + np.diag(measured.sigma[rows] ** 2)
        gain = np.linalg.solve(S, pick @ self.covariance).T
        self.value = self.value + gain @ (measured.value - self.value)[rows]
        rest = np.eye(3) - gain @ pick
        # Joseph form: keeps the covariance symmetric and positive
        noise = gain @ np.diag(measured.sigma[rows] ** 2) @ gain.T
        self.covariance = rest @ self.covariance @ rest.T + noise
        if self._moved:
            self.fresh = rest @ self.fresh @ rest.T + noise
        self.carried = np.clip(self.carried * np.diag(rest), 0.0, 1.0)


# Standard deviation of roll and pitch of a body on wheels without measurements, such as a car on a
# road or a robot on springs: about a degree and a half.
_BODY_RAD = 0.025


class AttitudeEstimator:
    """Attitude of a robot along its log, by measurements and visual odometry.

    Args:
        T_robot_observed: transform from the frame of the observations and motions to the robot's,
            shape (4, 4); None if both are the same.
        shared_rad: standard deviation of the error that all measurements of roll and pitch share,
            which the filter does not observe.
    """

    def __init__(self, T_robot_observed: Float | None = None, shared_rad: float = 0.0) -> None:
        self._T_robot_observed = T_robot_observed
        self._shared_rad2 = shared_rad**2
        self._filter, self._gyroscope = AttitudeFilter(), Gyroscope()
        self._values: list[Float] = []
        self._sigmas: list[Float] = []
        self._carried: list[Float] = []

    @property
    def attitude(self) -> Attitude:
        """Attitude of the frames so far."""
        sigma, carried = np.array(self._sigmas), np.array(self._carried)
        if self._shared_rad2:
            own = np.mean(sigma[:-1, :2] ** 2, axis=1)
            carried[1:, 0] = (carried[1:, 0] * own + self._shared_rad2) / (own + self._shared_rad2)
            sigma[:, :2] = np.sqrt(sigma[:, :2] ** 2 + self._shared_rad2)
        return Attitude(np.array(self._values), sigma, carried)

    def expected_turn(self, measured: AttitudeMeasurement) -> Float | None:
        """Predict R_after_before (3, 3), in the frame of the observations, by a measurement.

        None without a measurement of the next frame, and for the first frame.
        """
        if not self._values or np.isnan(measured.value[:2]).any():
            return None
        before, after = (tilt(*value[:2]) for value in (self._values[-1], measured.value))
        turn = after.T @ before
        if self._T_robot_observed is None:
            return turn
        R_robot_observed = self._T_robot_observed[:3, :3]
        return R_robot_observed.T @ turn @ R_robot_observed

    def add(
        self,
        motion: RigidMotion | None,
        measured: AttitudeMeasurement,
        gyroscope: tuple[Float, float] | None = None,
    ) -> None:
        """Add the next frame.

        A body without visual odometry and measurement is level in the mean.

        Args:
            motion: motion since the frame before by visual odometry; None without links.
            measured: measurement of the frame.
            gyroscope: the robot's rotation since the frame before, a rotation vector (3,) in the
                robot's axes before, and the seconds since then.
        """
        if self._values:
            if motion is not None and self._T_robot_observed is not None:
                motion = motion.of_body(self._T_robot_observed)
            if gyroscope is not None:
                motion = self._gyroscope.fuse(*gyroscope, motion)
            self._filter.move(motion)
        if motion is None and np.isnan(measured.value[:2]).any():
            level = np.array([0.0, 0.0, measured.value[2]])
            sigma = np.array([_BODY_RAD, _BODY_RAD, measured.sigma[2]])
            measured = AttitudeMeasurement(level, sigma)
        self._filter.measure(measured)
        self._values.append(self._filter.value)
        self._sigmas.append(self._filter.sigma)
        roll, pitch, height = self._filter.carried
        self._carried.append(np.array([(roll + pitch) / 2, height]))

    def to_level_frame(self, observed: Observations) -> Observations:
        """Transform observations of the last frame to the level frame."""
        T = self._T_robot_observed
        observations = (
            observed if T is None else transform_observations(observed, T[:3, :3], T[:3, 3])
        )
        return level_observations(
            observations, self._values[-1], np.sqrt(np.diag(self._filter.fresh))
        )
