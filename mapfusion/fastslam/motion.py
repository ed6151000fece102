"""Motion model: odometry noise and sampling of poses (eq. 3)."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose
from mapfusion.parameters import Range, require_in_range

# Largest parameters, far above those of any odometry.
_MOST_M, _MOST_RAD = 10_000, 10


@dataclass(frozen=True)
class MotionNoise:
    """Odometry noise as a random walk that also covers systematic errors.

    A constant relative error e causes an error of e h after a horizon h (metres or radians). A
    random walk of e sqrt(h) per root unit has the same standard deviation after the horizon, and a
    larger one before it. The particles therefore cover systematic errors without a state for them.
    Beyond the horizon, observations of the map correct the pose.

    A robot that stands still has no odometry error by default. The floor is for robots that are
    pushed, and for odometry that drops increments below its resolution.

    Attributes:
        translation_m_per_sqrt_m: random walk along the motion.
        rotation_rad_per_sqrt_m: random walk of the heading with the distance.
        rotation_rad_per_sqrt_rad: random walk of the heading with the angle turned.
        scale_error: relative systematic error of distances, along the motion.
        track_error: relative systematic error of angles. The effective track of a skid-steered
            robot varies by about 10 % within a turn.
        horizon_m: distance over which the scale error accumulates, about the distance for which
            most landmarks stay in view.
        horizon_rad: angle over which the track error accumulates, about two frames of turning.
        lateral_m_per_sqrt_m: random walk across the motion. Wheels hardly roll sideways, so the
            default is small.
        lateral_slip_m_per_rad: sideways slip in a turn, which the wheel encoders do not measure. It
            is larger for a robot that turns while it drives.
        floor_m: added to x and y in every step, whatever the motion.
        floor_rad: added to the heading in every step, whatever the motion.
    """

    translation_m_per_sqrt_m: Annotated[float, Range(0, _MOST_M, "m/sqrt(m)")] = 0.02
    rotation_rad_per_sqrt_m: Annotated[float, Range(0, _MOST_RAD, "rad/sqrt(m)")] = 0.01
    rotation_rad_per_sqrt_rad: Annotated[float, Range(0, _MOST_RAD, "rad/sqrt(rad)")] = 0.03
    scale_error: Annotated[float, Range(0, 1, "1")] = 0.01
    track_error: Annotated[float, Range(0, 1, "1")] = 0.1
    horizon_m: Annotated[float, Range(0, _MOST_M, "m")] = 3.0
    horizon_rad: Annotated[float, Range(0, 1000, "rad")] = 0.2
    lateral_m_per_sqrt_m: Annotated[float, Range(0, _MOST_M, "m/sqrt(m)")] = 0.005
    lateral_slip_m_per_rad: Annotated[float, Range(0, _MOST_M, "m/rad")] = 0.01
    floor_m: Annotated[float, Range(0, _MOST_M, "m")] = 0.0
    floor_rad: Annotated[float, Range(0, _MOST_RAD, "rad")] = 0.0

    def __post_init__(self) -> None:
        require_in_range(self)

    def standard_deviations(self, odometry: Float) -> Float:
        """Return the standard deviations (3,) of x, y, theta for an odometry increment (3,)."""
        distance_m = np.hypot(odometry[0], odometry[1])
        angle_rad = abs(odometry[2])
        along = (
            self.translation_m_per_sqrt_m**2 + self.scale_error**2 * self.horizon_m
        ) * distance_m
        slip = (self.lateral_slip_m_per_rad * angle_rad) ** 2
        across = self.lateral_m_per_sqrt_m**2 * distance_m + slip
        rotation = (
            self.rotation_rad_per_sqrt_m**2 * distance_m
            + (self.rotation_rad_per_sqrt_rad**2 + self.track_error**2 * self.horizon_rad)
            * angle_rad
        )
        variance = np.array([along, across, rotation])
        return np.sqrt(variance + self._floor**2)

    def scaled(self, factor: float) -> "MotionNoise":
        """Return the noise whose standard deviations are `factor` times as large.

        The random walks of the result include the systematic errors. No parameter exceeds its
        range.
        """
        if factor == 1:
            return self
        along = np.hypot(self.translation_m_per_sqrt_m, self.scale_error * np.sqrt(self.horizon_m))
        turned = np.hypot(
            self.rotation_rad_per_sqrt_rad, self.track_error * np.sqrt(self.horizon_rad)
        )
        in_m = {
            "translation_m_per_sqrt_m": float(along),
            "lateral_m_per_sqrt_m": self.lateral_m_per_sqrt_m,
            "lateral_slip_m_per_rad": self.lateral_slip_m_per_rad,
            "floor_m": self.floor_m,
        }
        in_rad = {
            "rotation_rad_per_sqrt_m": self.rotation_rad_per_sqrt_m,
            "rotation_rad_per_sqrt_rad": float(turned),
            "floor_rad": self.floor_rad,
        }
        changed = {name: min(factor * value, _MOST_M) for name, value in in_m.items()}
        changed |= {name: min(factor * value, _MOST_RAD) for name, value in in_rad.items()}
        return replace(self, scale_error=0.0, track_error=0.0, **changed)

    def with_floor(self, covariance: Float) -> Float:
        """Return the standard deviations (3,) of a known covariance (3, 3) plus the floor."""
        return np.sqrt(np.diag(covariance) + self._floor**2)

    @property
    def _floor(self) -> Float:
        return np.array([self.floor_m, self.floor_m, self.floor_rad])


def sample_motion(
    T_map_robot: Float, odometry: Float, sigma: Float, rng: np.random.Generator
) -> Float:
    """Sample the poses (M, 3) after an odometry increment from the poses before it (eq. 3).

    Args:
        T_map_robot: (M, 3) poses before the motion.
        odometry: (3,) increment in the robot frame.
        sigma: (3,) standard deviations of the increment.
        rng: random generator.
    """
    disturbance = rng.standard_normal(T_map_robot.shape) * sigma
    return compose(T_map_robot, odometry + disturbance)
