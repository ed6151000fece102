"""Poses and rigid motions of the plane, as arrays (..., 3) of x_m, y_m, theta_rad."""

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.geometry.numerics import Float, kernel

IDENTITY: Float = np.zeros(3)
IDENTITY.setflags(write=False)


def wrap(angle_rad: ArrayLike) -> Float:
    """Wrap angles (...) to [-pi, pi)."""
    return np.mod(np.asarray(angle_rad, dtype=np.float64) + np.pi, 2 * np.pi) - np.pi


def rotation(theta_rad: ArrayLike) -> Float:
    """Return counter-clockwise rotation matrices (..., 2, 2) of angles theta (...)."""
    theta = np.asarray(theta_rad, dtype=np.float64)
    matrix = np.empty((*theta.shape, 2, 2))
    matrix[..., 0, 0] = matrix[..., 1, 1] = np.cos(theta)
    matrix[..., 1, 0] = np.sin(theta)
    matrix[..., 0, 1] = -matrix[..., 1, 0]
    return matrix


def rotation_about_z(theta_rad: ArrayLike) -> Float:
    """Return counter-clockwise rotation matrices (..., 3, 3) about the z axis.

    The paper's eq. 11 and 16 disagree in sign; this is eq. 16: its theta is minus eq. 11's.
    """
    theta = np.asarray(theta_rad, dtype=np.float64)
    matrix = np.zeros((*theta.shape, 3, 3))
    matrix[..., :2, :2] = rotation(theta)
    matrix[..., 2, 2] = 1.0
    return matrix


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Float:
    """Return T_a_c (..., 3), the composition of T_a_b (..., 3) and T_b_c (..., 3)."""
    a_b = np.asarray(T_a_b, dtype=np.float64)
    b_c = np.asarray(T_b_c, dtype=np.float64)
    cos, sin = np.cos(a_b[..., 2]), np.sin(a_b[..., 2])
    return np.stack(
        [
            a_b[..., 0] + cos * b_c[..., 0] - sin * b_c[..., 1],
            a_b[..., 1] + sin * b_c[..., 0] + cos * b_c[..., 1],
            wrap(a_b[..., 2] + b_c[..., 2]),
        ],
        -1,
    )


def inverse(T_a_b: ArrayLike) -> Float:
    """Return T_b_a (..., 3)."""
    a_b = np.asarray(T_a_b, dtype=np.float64)
    cos, sin = np.cos(a_b[..., 2]), np.sin(a_b[..., 2])
    return np.stack(
        [
            -cos * a_b[..., 0] - sin * a_b[..., 1],
            sin * a_b[..., 0] - cos * a_b[..., 1],
            wrap(-a_b[..., 2]),
        ],
        -1,
    )


def between(T_w_a: ArrayLike, T_w_b: ArrayLike) -> Float:
    """Return T_a_b (..., 3) of two poses in one frame w."""
    return compose(inverse(T_w_a), T_w_b)


def transform_points(T_a_b: ArrayLike, p_b: ArrayLike) -> Float:
    """Transform points (N, 2) or (N, 3) of frame b to frame a; heights stay the same."""
    a_b = np.asarray(T_a_b, dtype=np.float64)
    points = np.array(p_b, dtype=np.float64)
    points[..., :2] = points[..., :2] @ rotation(a_b[2]).T + a_b[:2]
    return points


def transform_covariances(T_a_b: ArrayLike, covariance_m2: ArrayLike) -> Float:
    """Transform covariances (N, 3, 3) of frame b to frame a by R S R^T.

    This is eq. 15 with the sign of theta of `rotation_about_z`.
    """
    rotation_a_b = rotation_about_z(np.asarray(T_a_b, dtype=np.float64)[2])
    return rotation_a_b @ np.asarray(covariance_m2, dtype=np.float64) @ rotation_a_b.T


def motion_sigma(covariance: Float) -> tuple[Float, Float]:
    """Return the standard deviations of position (m) and heading (rad) of motions.

    The standard deviation of the position is the RMS distance sqrt(xx + yy).

    Args:
        covariance: covariances of motions, shape (..., 3, 3).
    """
    m2 = covariance[..., 0, 0] + covariance[..., 1, 1]
    return np.sqrt(m2), np.sqrt(covariance[..., 2, 2])


def motion_jacobian(T_a_b: Float, p_b: Float) -> Float:
    """Return d(T_a_b p_b) / d(tx, ty, theta) in the plane, shape (N, 2, 3)."""
    turned = p_b[:, :2] @ rotation(T_a_b[2]).T
    jacobian = np.zeros((len(p_b), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2] = -turned[:, 1]
    jacobian[:, 1, 2] = turned[:, 0]
    return jacobian


@kernel
def moved_point(T_a_b: Float, cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """Return T p of the point (x, y); `cos` and `sin` are those of theta."""
    return T_a_b[0] + cos * x - sin * y, T_a_b[1] + sin * x + cos * y


@kernel
def residual(
    T_a_b: Float, cos: float, sin: float, p_a: Float, p_b: Float, i: int
) -> tuple[float, float]:
    """Return p_a - T p_b of pair i of points (N, 2 or more)."""
    ex = p_a[i, 0] - T_a_b[0] - cos * p_b[i, 0] + sin * p_b[i, 1]
    ey = p_a[i, 1] - T_a_b[1] - sin * p_b[i, 0] - cos * p_b[i, 1]
    return ex, ey


@kernel
def lever(cos: float, sin: float, p_b: Float, i: int) -> tuple[float, float]:
    """Return d(T p_b) / d theta of point i of points (N, 2 or more)."""
    return -sin * p_b[i, 0] - cos * p_b[i, 1], cos * p_b[i, 0] - sin * p_b[i, 1]


@kernel
def add_turned(
    xx: float, xy: float, yy: float, cos: float, sin: float, bxx: float, bxy: float, byy: float
) -> tuple[float, float, float]:
    """Return the sum of the covariance (xx, xy, yy) and of R S R^T of another one (eq. 15)."""
    return (
        xx + cos * cos * bxx - 2 * cos * sin * bxy + sin * sin * byy,
        xy + cos * sin * (bxx - byy) + (cos * cos - sin * sin) * bxy,
        yy + sin * sin * bxx + 2 * cos * sin * bxy + cos * cos * byy,
    )


def rms_distance_m(T_a_b: Float, other: Float, p_b: Float) -> float:
    """Return the RMS distance between points (n, 2) under two motions (3,)."""
    apart = transform_points(T_a_b, p_b) - transform_points(other, p_b)
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))
