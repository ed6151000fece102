"""Motions of the plane from paired points: closed form, residuals, first-order covariance."""

import math

import numpy as np
from numba import njit

from mapfusion.se2 import Float, rotation, transform_points


@njit(cache=True)
def fit_rigid(p_a: Float, p_b: Float, rows: np.ndarray) -> tuple[float, float, float]:
    """tx, ty, theta that minimise the summed squared distance in the plane of p_a to T p_b.

    The closed form for the plane (Arun et al. 1987): theta from the summed dot and cross products
    about the centroids.

    Args:
        p_a: (N, 2 or more).
        p_b: (N, 2 or more).
        rows: (n,) the pairs to use.
    """
    n = len(rows)
    mean_ax = mean_ay = mean_bx = mean_by = 0.0
    for row in rows:
        mean_ax += p_a[row, 0]
        mean_ay += p_a[row, 1]
        mean_bx += p_b[row, 0]
        mean_by += p_b[row, 1]
    mean_ax /= n
    mean_ay /= n
    mean_bx /= n
    mean_by /= n
    dot = cross = 0.0
    for row in rows:
        ax = p_a[row, 0] - mean_ax
        ay = p_a[row, 1] - mean_ay
        bx = p_b[row, 0] - mean_bx
        by = p_b[row, 1] - mean_by
        dot += ax * bx + ay * by
        cross += ay * bx - ax * by
    theta = math.atan2(cross, dot)
    cos, sin = math.cos(theta), math.sin(theta)
    return mean_ax - cos * mean_bx + sin * mean_by, mean_ay - sin * mean_bx - cos * mean_by, theta


def residuals(T_a_b: Float, p_a: Float, p_b: Float) -> Float:
    """p_a - T_a_b p_b in the plane (N, 2)."""
    return (p_a - transform_points(T_a_b, p_b))[:, :2]


def residual_covariances(T_a_b: Float, covariance_a: Float, covariance_b: Float) -> Float:
    """S_a + R S_b R^T in the plane (N, 2, 2): what the landmarks' own noise makes of a residual."""
    R_a_b = rotation(T_a_b[2])
    return covariance_a[:, :2, :2] + R_a_b @ covariance_b[:, :2, :2] @ R_a_b.T


def motion_covariance(T_a_b: Float, p_b: Float, covariance_m2: Float) -> Float:
    """Covariance (3, 3) of T_a_b from the normal equations weighted with 1 / covariance_m2.

    Args:
        T_a_b: (3,).
        p_b: (N, 3).
        covariance_m2: (N, 2, 2) of the residuals, drift included.
    """
    jacobian = motion_jacobian(T_a_b, p_b)
    information = np.einsum("nki,nkl,nlj->ij", jacobian, np.linalg.inv(covariance_m2), jacobian)
    return np.linalg.inv(information)


def motion_jacobian(T_a_b: Float, p_b: Float) -> Float:
    """d(T_a_b p_b) / d(tx, ty, theta) in the plane (N, 2, 3)."""
    turned = p_b[:, :2] @ rotation(T_a_b[2]).T
    jacobian = np.zeros((len(p_b), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2] = -turned[:, 1]
    jacobian[:, 1, 2] = turned[:, 0]
    return jacobian
