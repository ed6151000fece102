"""Rigid motions of the plane from paired points: closed form, residuals, covariance."""

import math

import numpy as np

from mapfusion.geometry.numerics import Float, kernel, source_of
from mapfusion.geometry.se2 import add_turned, lever, residual

_ALL = slice(None)  # index of all pairs, for kernels that run as NumPy functions


@kernel
def _fit_rows(
    p_a: Float, p_b: Float, rows: np.ndarray, weight: Float
) -> tuple[float, float, float]:
    """Return tx, ty, theta that minimise the sum of weight times |p_a - T p_b|^2 in the plane.

    Closed form for the plane (Arun et al. 1987): theta follows from the sums of dot and cross
    products about the centroids. `rows` (n,) are the pairs, `weight` (n,) their weights.
    """
    total = ax = ay = bx = by = 0.0
    for k in range(len(rows)):
        i, w = rows[k], weight[k]
        total += w
        ax += w * p_a[i, 0]
        ay += w * p_a[i, 1]
        bx += w * p_b[i, 0]
        by += w * p_b[i, 1]
    ax, ay, bx, by = ax / total, ay / total, bx / total, by / total
    dot = cross = 0.0
    for k in range(len(rows)):
        i, w = rows[k], weight[k]
        dx, dy, ex, ey = p_a[i, 0] - ax, p_a[i, 1] - ay, p_b[i, 0] - bx, p_b[i, 1] - by
        dot += w * (dx * ex + dy * ey)
        cross += w * (dy * ex - dx * ey)
    theta = math.atan2(cross, dot)
    cos, sin = math.cos(theta), math.sin(theta)
    return ax - cos * bx + sin * by, ay - sin * bx - cos * by, theta


@kernel
def fit_rigid(p_a: Float, p_b: Float, rows: np.ndarray) -> tuple[float, float, float]:
    """Return tx, ty, theta that minimise the sum of |p_a - T p_b|^2 in the plane.

    Points have the shape (N, 2 or more); `rows` (n,) are the pairs to use.
    """
    return _fit_rows(p_a, p_b, rows, np.ones(len(rows)))


@kernel
def fit_weighted(p_a: Float, p_b: Float, weight: Float, T_a_b: Float) -> None:
    """Write T_a_b (3,) that minimises the sum of weight (N,) times |p_a - T p_b|^2."""
    T_a_b[0], T_a_b[1], T_a_b[2] = _fit_rows(p_a, p_b, np.arange(len(weight)), weight)


@kernel
def fit_two(p_a: Float, p_b: Float, i: int, j: int, T_a_b: Float) -> float:
    """Write T_a_b (3,) of pairs i and j; return the shorter distance of their points."""
    ax, ay = p_a[j, 0] - p_a[i, 0], p_a[j, 1] - p_a[i, 1]
    bx, by = p_b[j, 0] - p_b[i, 0], p_b[j, 1] - p_b[i, 1]
    theta = math.atan2(ay * bx - ax * by, ax * bx + ay * by)
    cos, sin = math.cos(theta), math.sin(theta)
    mid_bx, mid_by = (p_b[i, 0] + p_b[j, 0]) / 2, (p_b[i, 1] + p_b[j, 1]) / 2
    T_a_b[0] = (p_a[i, 0] + p_a[j, 0]) / 2 - cos * mid_bx + sin * mid_by
    T_a_b[1] = (p_a[i, 1] + p_a[j, 1]) / 2 - sin * mid_bx - cos * mid_by
    T_a_b[2] = theta
    return math.sqrt(min(ax * ax + ay * ay, bx * bx + by * by))


def residuals(T_a_b: Float, p_a: Float, p_b: Float) -> Float:
    """Return p_a - T_a_b p_b in the plane, shape (N, 2)."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    return np.stack(source_of(residual)(T_a_b, cos, sin, p_a, p_b, _ALL), axis=1)


def residual_covariances(T_a_b: Float, covariance_a: Float, covariance_b: Float) -> Float:
    """Return the covariances of residuals from the landmarks, S_a + R S_b R^T, shape (N, 2, 2)."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    a, b = (S.T[[0, 0, 1], [0, 1, 1]] for S in (covariance_a, covariance_b))
    xx, xy, yy = source_of(add_turned)(*a, cos, sin, *b)
    covariances = np.empty((len(xx), 2, 2))
    covariances[:, 0, 0], covariances[:, 1, 1] = xx, yy
    covariances[:, 0, 1] = covariances[:, 1, 0] = xy
    return covariances


def least_squares_gain(T_a_b: Float, p_b: Float, weight: Float | None = None) -> Float:
    """Return the derivatives of the least-squares motion by each residual, shape (N, 3, 2).

    To first order the error of T_a_b is the sum of the gains times the residuals. Points p_b
    (N, 2 or more) must not coincide; `weight` (N,) is equal by default.
    """
    weights = np.ones(len(p_b)) if weight is None else weight
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    of_turn = np.stack(source_of(lever)(cos, sin, p_b, _ALL), axis=1)
    # normal matrix: sum of weight J'J with J = `motion_jacobian`, summed in the order of kernels
    x, y = of_turn.T
    terms = np.stack([weights, weights * x, weights * y, weights * (x * x + y * y)])
    total, x, y, square = np.cumsum(terms, axis=1)[:, -1]
    inverse = np.linalg.inv(np.array([[total, 0.0, x], [0.0, total, y], [x, y, square]]))
    gain = inverse[:, :2] + inverse[:, 2, None] * of_turn[:, None]
    return weights[:, None, None] * gain


def motion_covariance(gain: Float, covariance_m2: Float) -> Float:
    """Return the covariance (3, 3) of a motion from gains (N, 3, 2) and covariances (N, 2, 2).

    Residuals are independent. The sandwich form is valid for weights that are not inverse
    covariances.
    """
    if not len(gain):
        return np.zeros((3, 3))
    x, y = gain[:, :, 0], gain[:, :, 1]
    xx, xy, yy = (covariance_m2[:, r, q, None] for r, q in ((0, 0), (0, 1), (1, 1)))
    along_x, along_y = x * xx + y * xy, x * xy + y * yy
    terms = along_x[:, :, None] * x[:, None, :] + along_y[:, :, None] * y[:, None, :]
    total = np.cumsum(terms, axis=0)[-1]
    return np.tril(total) + np.tril(total, -1).T
