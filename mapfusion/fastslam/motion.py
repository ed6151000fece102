"""Where a particle may have gone, given what the wheels counted (eq. 3)."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose
from mapfusion.parameters import Range, require_in_range


@dataclass(frozen=True)
class MotionNoise:
    """Standard deviations of the odometry, as a random walk that covers the systematic errors too.

    A relative error e that stays the same over a horizon h (metres or radians) ends in an error of
    e h. A random walk of e sqrt(h) per root unit ends in the same standard deviation, and has a
    larger one before: so the particles cover the systematic errors without knowing them. Beyond
    the horizon the map is expected to have corrected the robot.

    Standing still adds nothing by default: wheels that do not turn make no odometry error. The
    floor is for robots that are pushed, or odometry that drops increments below its resolution.

    Attributes:
        translation_m_per_sqrt_m: random walk along the motion.
        rotation_rad_per_sqrt_m: random walk of the heading with the distance.
        rotation_rad_per_sqrt_rad: random walk of the heading with the angle turned.
        scale_error: relative systematic error of distances, which is along the motion.
        track_error: relative systematic error of angles. The track that a skid-steered robot
            behaves as having changes within a turn (P3-AT in simulation: 0.42 to 0.62 m, so about
            10 %).
        horizon_m: distance over which the scale error adds up: the way for which most of what the
            robot sees stays in view.
        horizon_rad: angle over which the track error adds up: two frames of turning.
        lateral_m_per_sqrt_m: random walk across the motion. Wheels do not roll sideways: a P3-AT's
            is 0.002 where it drives straight on a dry floor; the default leaves room for others.
        lateral_slip_m_per_rad: sideways motion in a turn that the wheels do not count. A P3-AT that
            stops to turn slides by 0.008 on average and 0.025 at most, one that turns while it
            still rolls by 0.15.
        floor_m: added to x and y in every step, whatever the motion.
        floor_rad: added to the heading in every step, whatever the motion.
    """

    translation_m_per_sqrt_m: Annotated[float, Range(0, 10_000, "m/sqrt(m)")] = 0.02
    rotation_rad_per_sqrt_m: Annotated[float, Range(0, 10, "rad/sqrt(m)")] = 0.01
    rotation_rad_per_sqrt_rad: Annotated[float, Range(0, 10, "rad/sqrt(rad)")] = 0.03
    scale_error: Annotated[float, Range(0, 1, "1")] = 0.01
    track_error: Annotated[float, Range(0, 1, "1")] = 0.1
    horizon_m: Annotated[float, Range(0, 10_000, "m")] = 3.0
    horizon_rad: Annotated[float, Range(0, 1000, "rad")] = 0.2
    lateral_m_per_sqrt_m: Annotated[float, Range(0, 10_000, "m/sqrt(m)")] = 0.005
    lateral_slip_m_per_rad: Annotated[float, Range(0, 10_000, "m/rad")] = 0.01
    floor_m: Annotated[float, Range(0, 10_000, "m")] = 0.0
    floor_rad: Annotated[float, Range(0, 10, "rad")] = 0.0

    def __post_init__(self) -> None:
        require_in_range(self)

    def standard_deviations(self, odometry: Float) -> Float:
        """(3,) of x_m, y_m, theta_rad for one odometry increment (3,)."""
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

    def with_floor(self, covariance: Float) -> Float:
        """(3,) of a step whose covariance (3, 3) is known, at least the floor."""
        return np.sqrt(np.diag(covariance) + self._floor**2)

    @property
    def _floor(self) -> Float:
        return np.array([self.floor_m, self.floor_m, self.floor_rad])


def sample_motion(
    T_map_robot: Float, odometry: Float, sigma: Float, rng: np.random.Generator
) -> Float:
    """Draw the poses (M, 3) after a motion (3,) from those before it (M, 3) (eq. 3).

    `sigma` (3,) are the standard deviations of the motion.
    """
    disturbance = rng.standard_normal(T_map_robot.shape) * sigma
    return compose(T_map_robot, odometry + disturbance)
