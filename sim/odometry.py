"""Wheel odometry of a P3-AT: encoder increments, a calibrated effective track, and noise."""

from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.geometry.numerics import Float, require_finite, require_shape
from mapfusion.geometry.se2 import wrap
from mapfusion.parameters import Range, require_in_range
from sim.p3at import WHEEL_RADIUS_M, P3at
from sim.world import World

SPIN_WHEEL_RAD_S = 4.0  # turns at 1.7 rad/s; the effective track does not depend on it
SPIN_UP_RAD = 1.0  # turned before the measurement begins
SPIN_TURNS = 2  # whole turns average out friction that depends on the heading
STEPS_PER_READING = 8


@dataclass(frozen=True)
class OdometryNoise:
    """Noise of a robot's odometry; 0 switches a term off.

    Attributes:
        translation_m_per_sqrt_m: random walk along the path, per root metre driven.
        yaw_rad_per_sqrt_m: random walk of the heading, per root metre driven.
        yaw_rad_per_sqrt_rad: random walk of the heading, per root radian turned.
        scale_sigma: relative error of the wheel radius, drawn once per robot.
        track_sigma: relative error of the effective track, drawn once per robot.
    """

    translation_m_per_sqrt_m: Annotated[float, Range(0, 10, "m/sqrt(m)")] = 0.02
    yaw_rad_per_sqrt_m: Annotated[float, Range(0, 10, "rad/sqrt(m)")] = 0.01
    yaw_rad_per_sqrt_rad: Annotated[float, Range(0, 10, "rad/sqrt(rad)")] = 0.03
    scale_sigma: Annotated[float, Range(0, 1, "1")] = 0.01
    track_sigma: Annotated[float, Range(0, 1, "1")] = 0.02

    def __post_init__(self) -> None:
        require_in_range(self)


@cache
def calibrated_track_m() -> float:
    """Return the effective track of the turning robot, from a spin test on an empty floor.

    A turning skid-steered robot yaws less than its wheels would turn it without slip. As on a real
    robot, two whole turns in place are compared with the encoder readings.
    """
    with World() as world:
        world.start_physics()
        robot = P3at(world, np.zeros(3))
        robot.drive(-SPIN_WHEEL_RAD_S, SPIN_WHEEL_RAD_S)
        _, start = _spin(world, robot, SPIN_UP_RAD)
        yaw_rad, end = _spin(world, robot, SPIN_TURNS * 2 * np.pi)
    left, right = end - start
    return float((right - left) * WHEEL_RADIUS_M / yaw_rad)


def _spin(world: World, robot: P3at, until_rad: float) -> tuple[float, Float]:
    """Step until the body has turned by an angle; return the turn and the wheel angles."""
    yaw_rad, last = 0.0, robot.pose()[2]
    while yaw_rad < until_rad:
        world.step(STEPS_PER_READING)
        theta = robot.pose()[2]
        yaw_rad += float(wrap(theta - last))
        last = theta
    return yaw_rad, robot.wheel_angles()


def encoder_increments(wheel_rad: ArrayLike, effective_track_m: float) -> Float:
    """Return the motion from frame to frame, in the robot frame of the previous frame.

    Args:
        wheel_rad: left and right encoder angles, shape (T, 2).
        effective_track_m: see `calibrated_track_m`.

    Returns:
        Chords of the circular arcs of constant wheel speeds, shape (T, 3); the first row is zero.
    """
    wheel = np.asarray(wheel_rad, dtype=np.float64)
    require_shape("wheel_rad", wheel, (None, 2))
    require_finite("wheel_rad", wheel)
    left, right = np.diff(wheel, axis=0, prepend=wheel[:1]).T * WHEEL_RADIUS_M
    yaw = (right - left) / effective_track_m
    chord = (left + right) / 2 * np.sinc(yaw / (2 * np.pi))  # numpy's sinc(x) is sin(pi x) / (pi x)
    return np.stack([chord * np.cos(yaw / 2), chord * np.sin(yaw / 2), yaw], -1)


def add_noise(increments: ArrayLike, noise: OdometryNoise, rng: np.random.Generator) -> Float:
    """Return increments (T, 3) with noise.

    An error of the wheel radius scales distances and turns, an error of the track scales turns
    only. The variances of the random walks grow with distance and turn, so the noise does not
    depend on the frame rate.
    """
    true = np.asarray(increments, dtype=np.float64)
    require_shape("increments", true, (None, 3))
    require_finite("increments", true)
    scale = 1 + noise.scale_sigma * rng.standard_normal()
    track = 1 + noise.track_sigma * rng.standard_normal()
    walk = rng.standard_normal((len(true), 2))
    distance, turned = np.hypot(true[:, 0], true[:, 1]), np.abs(true[:, 2])
    direction = np.arctan2(true[:, 1], true[:, 0])

    yaw_variance = noise.yaw_rad_per_sqrt_m**2 * distance + noise.yaw_rad_per_sqrt_rad**2 * turned
    yaw = true[:, 2] * scale / track + np.sqrt(yaw_variance) * walk[:, 0]
    noisy_distance = (
        distance * scale + noise.translation_m_per_sqrt_m * np.sqrt(distance) * walk[:, 1]
    )
    direction += (yaw - true[:, 2]) / 2  # angle between a chord and the start of its arc
    return np.stack(
        [noisy_distance * np.cos(direction), noisy_distance * np.sin(direction), yaw], -1
    )
