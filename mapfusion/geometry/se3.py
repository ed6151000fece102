"""Poses and rigid motions in space, as matrices (..., 4, 4), and conversions to planar poses."""

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.geometry.numerics import Float


def pose(R: ArrayLike, t: ArrayLike) -> Float:
    """Return poses (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def inverse(T_a_b: Float) -> Float:
    """Return T_b_a (..., 4, 4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return pose(R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])[..., 0])


def between(T_w_a: Float, T_w_b: Float) -> Float:
    """Return T_a_b (..., 4, 4) of two poses in one frame w."""
    return inverse(T_w_a) @ T_w_b


def planar(T: Float) -> Float:
    """Return planar poses (..., 3): positions in the plane and headings of the x axis."""
    heading = np.arctan2(T[..., 1, 0], T[..., 0, 0])
    return np.stack([T[..., 0, 3], T[..., 1, 3], heading], -1)


def from_planar(T: ArrayLike) -> Float:
    """Return poses (..., 4, 4) of planar poses (..., 3), upright and at height 0."""
    x, y, theta = np.moveaxis(np.asarray(T, dtype=np.float64), -1, 0)
    R = np.zeros((*theta.shape, 3, 3))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(theta)
    R[..., 1, 0] = np.sin(theta)
    R[..., 0, 1] = -R[..., 1, 0]
    R[..., 2, 2] = 1.0
    return pose(R, np.stack([x, y, np.zeros_like(x)], -1))


def tilt(roll_rad: ArrayLike, pitch_rad: ArrayLike) -> Float:
    """Return R_level_body (..., 3, 3): roll about x first, then pitch about y."""
    roll, pitch = (np.asarray(a, dtype=np.float64) for a in (roll_rad, pitch_rad))
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    rows = [[cp, sp * sr, sp * cr], [np.zeros_like(cr), cr, -sr], [-sp, cp * sr, cp * cr]]
    return np.stack([np.stack(np.broadcast_arrays(*row), -1) for row in rows], -2)


def roll_pitch(R_level_body: Float) -> Float:
    """Return roll and pitch (..., 2) of orientations (..., 3, 3) of any heading."""
    R = R_level_body
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    return np.stack([roll, np.arcsin(np.clip(-R[..., 2, 0], -1.0, 1.0))], -1)


def in_space(T_world_robot: ArrayLike, roll_pitch_rad: ArrayLike) -> Float:
    """Return poses (..., 4, 4) of planar poses (..., 3) with roll and pitch (..., 2)."""
    T, angles = from_planar(T_world_robot), np.asarray(roll_pitch_rad, dtype=np.float64)
    R = T[..., :3, :3] @ tilt(angles[..., 0], angles[..., 1])
    return pose(R, T[..., :3, 3])


def from_quaternions(t: ArrayLike, xyzw: ArrayLike) -> Float:
    """Return poses (N, 4, 4) of positions (N, 3) and quaternions (N, 4), the real part last."""
    from scipy.spatial.transform import Rotation  # a slow import

    return pose(Rotation.from_quat(np.asarray(xyzw, dtype=np.float64)).as_matrix(), t)


def quaternions(T: Float) -> Float:
    """Return the orientations of poses (N, 4, 4) as quaternions (N, 4), the real part last."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(T[..., :3, :3]).as_quat()
