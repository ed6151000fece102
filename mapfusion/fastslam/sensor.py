"""What a particle expects to observe, and how well an observation agrees with it (eq. 4-6, 10).

The observation model g maps a landmark into the robot frame: a rigid motion, whose Jacobian G is a
rotation. Everything here is turned by the transpose of G into the map frame, where G is the
identity: innovation z - z_hat becomes (observed point in the map) - (landmark), Z becomes
Sigma + R_map, and determinants and Mahalanobis distances stay what they are.

Symmetric matrices are their six upper entries: xx, xy, xz, yy, yz, zz.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.slots import Estimates
from mapfusion.kernels import inner_kernel, kernel
from mapfusion.planar import add_turned
from mapfusion.se2 import Float
from mapfusion.symmetric import cofactors

Vector = tuple[float, float, float]
Upper = tuple[float, float, float, float, float, float]  # xx, xy, xz, yy, yz, zz


class Sightings(NamedTuple):
    """K observations of one frame, as each of M particles sees them in its map."""

    point_m: Float  # (K, M, 3)
    covariance_m2: Float  # (K, M, 6)


def sightings(
    T_map_robot: Float, position_m: Float, covariance_m2: Float, planar: bool
) -> Sightings:
    """Observations (K, 3), (K, 3, 3) of the robot frame in the maps of poses (M, 3)."""
    shape = (len(position_m), len(T_map_robot))
    seen = Sightings(np.empty((*shape, 3)), np.empty((*shape, 6)))
    position, covariance = np.ascontiguousarray(position_m), np.ascontiguousarray(covariance_m2)
    turn = T_map_robot[:, 2]
    _turn_into_map(T_map_robot, np.cos(turn), np.sin(turn), position, covariance, planar, seen)
    return seen


@kernel(error_model="numpy")
def _turn_into_map(
    T_map_robot: Float,
    cos: Float,
    sin: Float,
    position: Float,
    covariance: Float,
    planar: bool,
    seen: Sightings,
) -> None:
    for k in range(len(position)):
        x, y, z = position[k, 0], position[k, 1], position[k, 2]
        xx, xy, xz = covariance[k, 0, 0], covariance[k, 0, 1], covariance[k, 0, 2]
        yy, yz, zz = covariance[k, 1, 1], covariance[k, 1, 2], covariance[k, 2, 2]
        if planar:
            z = xz = yz = zz = 0.0
        point, turned = seen.point_m[k], seen.covariance_m2[k]
        for m in range(len(T_map_robot)):
            c, s = cos[m], sin[m]
            point[m, 0] = T_map_robot[m, 0] + c * x - s * y
            point[m, 1] = T_map_robot[m, 1] + s * x + c * y
            point[m, 2] = z
            turned[m, 0], turned[m, 1], turned[m, 3] = add_turned(0.0, 0.0, 0.0, c, s, xx, xy, yy)
            turned[m, 2] = c * xz - s * yz
            turned[m, 4] = s * xz + c * yz
            turned[m, 5] = zz


# Division is NumPy's in the filter's kernels (`error_model`): a check for zero at each one keeps
# LLVM from inlining what divides. No Z is singular: a frame with a singular R_t is refused.
@inner_kernel(error_model="numpy")
def inverse_and_determinant(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[Upper, float]:
    """Inverse and determinant of a symmetric 3x3 matrix, by cofactors."""
    axx, axy, axz, ayy, ayz, azz, determinant = cofactors(xx, xy, xz, yy, yz, zz)
    f = 1.0 / determinant
    return (f * axx, f * axy, f * axz, f * ayy, f * ayz, f * azz), determinant


@inner_kernel(error_model="numpy")
def innovation(
    seen: Sightings, k: int, own: Estimates, r: int, m: int, planar: bool
) -> tuple[Vector, Upper, float]:
    """Innovation, inverse of Z (eq. 6) and |Z| of observation k and the landmark of row r.

    Both as particle m has them. In planar data the height says nothing: its innovation is 0 and its
    variance in Z 1, so that it leaves the Mahalanobis distance and the determinant alone.
    """
    point, noise, mean, covariance = seen.point_m, seen.covariance_m2, own.mean_m, own.covariance_m2
    xx = covariance[r, m, 0] + noise[k, m, 0]
    xy = covariance[r, m, 1] + noise[k, m, 1]
    xz = covariance[r, m, 2] + noise[k, m, 2]
    yy = covariance[r, m, 3] + noise[k, m, 3]
    yz = covariance[r, m, 4] + noise[k, m, 4]
    zz = covariance[r, m, 5] + noise[k, m, 5]
    dz = point[k, m, 2] - mean[r, m, 2]
    if planar:  # after the reads: a branch between them costs as much as all the arithmetic
        xz = yz = dz = 0.0
        zz = 1.0
    inverse, determinant = inverse_and_determinant(xx, xy, xz, yy, yz, zz)
    difference = (point[k, m, 0] - mean[r, m, 0], point[k, m, 1] - mean[r, m, 1], dz)
    return difference, inverse, determinant


@inner_kernel(error_model="numpy")
def quadratic_form(difference: Vector, inverse: Upper) -> float:
    """Squared Mahalanobis distance: d^T Z^-1 d."""
    dx, dy, dz = difference
    ixx, ixy, ixz, iyy, iyz, izz = inverse
    return (
        ixx * dx * dx
        + iyy * dy * dy
        + izz * dz * dz
        + 2.0 * (ixy * dx * dy + ixz * dx * dz + iyz * dy * dz)
    )


def log_density_at_gate(covariance_m2: Float, gate: float, planar: bool) -> Float:
    """Log of p_new (K,): the density of a match exactly at the gate of a landmark seen once.

    Such a landmark has the observation's own covariance R, so Z = 2 R. The density carries the
    unit 1/m^3 (1/m^2 in the plane) of a match's, so a change of units cancels in the weights.

    Raises:
        ValueError: a covariance (K, 3, 3) is not positive definite.
    """
    dimensions = 2 if planar else 3
    try:
        root = np.linalg.cholesky(2.0 * covariance_m2[:, :dimensions, :dimensions])
    except np.linalg.LinAlgError as error:
        raise ValueError("covariance_m2: an observation's is not positive definite") from error
    half_log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return -0.5 * (gate + dimensions * np.log(2 * np.pi)) - half_log_det
