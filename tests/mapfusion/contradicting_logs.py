"""A robot that circles among labelled landmarks, and what people do to its odometry."""

from collections.abc import Callable

import numpy as np

from mapfusion.datasets.relative_motion import poses_from_increments
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, inverse, rotation
from mapfusion.robot_log import Observations, RobotLog

STEP = np.array([0.1, 0.0, 0.05])
SIGMA_M = 0.05
LANDMARKS = np.random.default_rng(0).uniform(-6, 6, (25, 2))


def true_poses(n: int) -> Float:
    return poses_from_increments(np.concatenate([np.zeros((1, 3)), np.tile(STEP, (n - 1, 1))]))


def circling_log(
    n: int = 60, noise: float = 0.003, seed: int = 1, poses: Float | None = None
) -> RobotLog:
    """Increments with `noise` in m and rad, and all landmarks within 5 m, of a planar log."""
    rng = np.random.default_rng(seed)
    path = true_poses(n) if poses is None else poses
    odometry = np.zeros((n, 3))
    odometry[1:] = between(path[:-1], path[1:]) + rng.normal(0, noise, (n - 1, 3))
    iteration, position, label = [], [], []
    for k, pose in enumerate(path):
        seen = (LANDMARKS - pose[:2]) @ rotation(pose[2])
        near = np.flatnonzero(np.hypot(*seen.T) < 5)
        iteration += [k] * len(near)
        position.append(seen[near] + rng.normal(0, SIGMA_M, (len(near), 2)))
        label.append(near)
    points = np.concatenate(position)
    made = Observations(
        np.column_stack([points, np.zeros(len(points))]),
        np.tile(np.diag([SIGMA_M**2, SIGMA_M**2, 0.0]), (len(points), 1, 1)),
        label=np.concatenate(label).astype(np.int32),
    )
    return RobotLog(
        "R1", True, np.linspace(0, 0.1 * (n - 1), n), odometry, np.array(iteration), made
    )


def _set(frame: int, axis: int, value: float) -> Callable[[Float], Float]:
    def change(odometry: Float) -> Float:
        changed = odometry.copy()
        changed[frame, axis] = value
        return changed

    return change


def _arcs_in_degrees(odometry: Float) -> Float:
    """Return the motions along arcs whose turns are in degrees and were taken as radians."""
    true, degrees = odometry[:, 2], np.degrees(odometry[:, 2])
    chord = odometry[:, 0] + 1j * odometry[:, 1]
    with np.errstate(invalid="ignore"):
        arc = np.where(true == 0, chord, chord * true / (np.exp(1j * true) - 1) * 1j)
        moved = np.where(true == 0, arc, arc * (np.exp(1j * degrees) - 1) / (1j * degrees))
    return np.column_stack([moved.real, moved.imag, degrees])


# What was done to the odometry, and words that name it.
MISTAKES: dict[str, tuple[Callable[[Float], Float], tuple[str, ...]]] = {
    "absolute poses": (poses_from_increments, ("poses since the start, not increments",)),
    "degrees": (lambda u: u * [1, 1, 180 / np.pi], ("odometry_theta_rad", "degrees", "57.3")),
    "turn rates in degrees": (_arcs_in_degrees, ("turn rates look like degrees per second",)),
    "millimetres": (lambda u: u * [1000, 1000, 1], ("millimetres",)),
    "centimetres": (lambda u: u * [100, 100, 1], ("centimetres",)),
    "observations in mm": (lambda u: u * [1e-3, 1e-3, 1], ("observed ones millimetres",)),
    "inverted": (inverse, ("inverted (T_after_before)",)),
    "swapped": (lambda u: u[:, [1, 0, 2]], ("y points ahead", "exchanged")),
    "other sign": (lambda u: u * [1, 1, -1], ("heading has the other sign",)),
    "backwards": (lambda u: u * [-1, -1, 1], ("x points back",)),
    "nothing": (np.zeros_like, ("stands still",)),
    "half": (lambda u: u * [0.5, 0.5, 1], ("distances are 0.", "focal length")),
}
JUMPS: dict[str, tuple[Callable[[Float], Float], tuple[int, ...]]] = {
    "3 m": (_set(40, 0, 3.0), (40,)),
    "heading": (_set(40, 2, 1.0), (40,)),
    "two": (lambda u: _set(40, 0, 3.0)(_set(20, 1, -2.0)(u)), (20, 40)),
}
