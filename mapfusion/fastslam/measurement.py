"""Measurement model and Kalman update of a landmark in a particle (eq. 4-10).

The observation model g transforms a landmark into the robot frame; its Jacobian G is a rotation.
This module works in the map frame, where G is the identity: the innovation z - z_hat is the
observed point in the map minus the landmark, and Z is Sigma + R_map. Determinants and Mahalanobis
distances are the same in both frames.

Symmetric matrices are stored as six upper entries: xx, xy, xz, yy, yz, zz.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.landmark_arrays import LANES, Estimates
from mapfusion.geometry.numerics import Float, cofactors, kernel
from mapfusion.geometry.se2 import add_turned

Vector = tuple[float, float, float]
Upper = tuple[float, float, float, float, float, float]  # xx, xy, xz, yy, yz, zz


class MapObservations(NamedTuple):
    """K observations of one frame in the map frame of each of M particles."""

    point_m: Float  # (K, M, 3)
    covariance_m2: Float  # (K, M, 6)


def observations_in_map(
    T_map_robot: Float, position_m: Float, covariance_m2: Float, planar: bool
) -> MapObservations:
    """Transform observations (K, 3), (K, 3, 3) from the robot frame into the map, for M poses."""
    shape = (len(position_m), len(T_map_robot))
    seen = MapObservations(np.empty((*shape, 3)), np.empty((*shape, 6)))
    position, covariance = np.ascontiguousarray(position_m), np.ascontiguousarray(covariance_m2)
    turn = T_map_robot[:, 2]
    _transform_into_map(T_map_robot, np.cos(turn), np.sin(turn), position, covariance, planar, seen)
    return seen


@kernel(error_model="numpy")
def _transform_into_map(
    T_map_robot: Float,
    cos: Float,
    sin: Float,
    position: Float,
    covariance: Float,
    planar: bool,
    seen: MapObservations,
) -> None:
    """Write observations into `seen`; `cos` and `sin` (M,) are those of the headings."""
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


# The filter's kernels divide as NumPy does (`error_model`): a check for zero would keep LLVM from
# inlining. Z is never singular: the filter rejects a frame with a singular R_t.
@kernel(error_model="numpy")
def inverse_and_determinant(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[Upper, float]:
    """Return the inverse and determinant of a symmetric 3x3 matrix, by cofactors."""
    axx, axy, axz, ayy, ayz, azz, determinant = cofactors(xx, xy, xz, yy, yz, zz)
    f = 1.0 / determinant
    return (f * axx, f * axy, f * axz, f * ayy, f * ayz, f * azz), determinant


@kernel(error_model="numpy")
def innovation(
    seen: MapObservations, k: int, by_particle: Estimates, r: int, m: int, planar: bool
) -> tuple[Vector, Upper, float]:
    """Return the innovation, the inverse of Z (eq. 6) and |Z| in particle m.

    The pair is observation k and the landmark of row r. In planar data, the height has innovation 0
    and variance 1 in Z, so that it does not affect the Mahalanobis distance and the determinant.
    """
    point, noise, mean, covariance = (
        seen.point_m,
        seen.covariance_m2,
        by_particle.mean_m,
        by_particle.covariance_m2,
    )
    xx = covariance[r, m, 0] + noise[k, m, 0]
    xy = covariance[r, m, 1] + noise[k, m, 1]
    xz = covariance[r, m, 2] + noise[k, m, 2]
    yy = covariance[r, m, 3] + noise[k, m, 3]
    yz = covariance[r, m, 4] + noise[k, m, 4]
    zz = covariance[r, m, 5] + noise[k, m, 5]
    dz = point[k, m, 2] - mean[r, m, 2]
    if planar:  # after the loads: a branch between them is as slow as the arithmetic
        xz = yz = dz = 0.0
        zz = 1.0
    inverse, determinant = inverse_and_determinant(xx, xy, xz, yy, yz, zz)
    difference = (point[k, m, 0] - mean[r, m, 0], point[k, m, 1] - mean[r, m, 1], dz)
    return difference, inverse, determinant


@kernel(error_model="numpy")
def quadratic_form(difference: Vector, inverse: Upper) -> float:
    """Return the squared Mahalanobis distance d^T Z^-1 d."""
    dx, dy, dz = difference
    ixx, ixy, ixz, iyy, iyz, izz = inverse
    return (
        ixx * dx * dx
        + iyy * dy * dy
        + izz * dz * dz
        + 2.0 * (ixy * dx * dy + ixz * dx * dz + iyz * dy * dz)
    )


def log_density_at_gate(covariance_m2: Float, gate: float, planar: bool) -> Float:
    """Return the log of p_new (K,), the density of a match at the gate of a landmark seen once.

    Such a landmark has the covariance R of the observation, so Z = 2 R. The density has the unit of
    a match's density, 1/m^3 (1/m^2 in the plane), so a change of units cancels in the weights.

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


NEW = -1  # no match: the observation starts a landmark in this particle
DROPPED = -2  # the observation is not used
# Rows of the vectorised state: squared distance, |Z|, and then the first rows of the mean, the
# innovation, and the upper entries of the landmark's and the observation's covariance.
_MEAN, _OFF, _SIGMA, _NOISE, _ROWS = 2, 5, 8, 14, 20


@kernel(error_model="numpy")
def update_landmarks(
    by_particle: Estimates,
    row_of: np.ndarray,
    chosen: np.ndarray,
    seen: MapObservations,
    log_new: Float,
    planar: bool,
) -> Float:
    """Update the matched landmarks in place (eq. 7-9) and return the log likelihood (M,).

    The likelihood is the product of eq. 10 over the observations.

    Args:
        by_particle: estimates of the slots, `Slots.by_particle`; all of `Slots` would take long to
            compile.
        row_of: (S,) row of each slot, `Slots.row`.
        chosen: (K, M) slot, NEW or DROPPED.
        seen: the observations.
        log_new: (K,) log density of an observation without a match.
        planar: two degrees of freedom.
    """
    n_observations, n_particles = chosen.shape
    log_two_pi = (2.0 if planar else 3.0) * np.log(2.0 * np.pi)
    log_likelihood, rows = np.zeros(n_particles), np.zeros(_ROWS * LANES)
    for k in range(n_observations):
        for first in range(0, n_particles, LANES):
            end = min(first + LANES, n_particles)
            # Gather the landmark and the observation of particles `first` to `end`.
            mean, sigma = by_particle.mean_m, by_particle.covariance_m2
            point, noise = seen.point_m, seen.covariance_m2
            for m in range(first, end):
                s, lane = chosen[k, m], m - first
                if s < 0:
                    continue
                r = int(row_of[s])
                for i in range(3):
                    rows[(_MEAN + i) * LANES + lane] = mean[r, m, i]
                    rows[(_OFF + i) * LANES + lane] = point[k, m, i] - mean[r, m, i]
                for i in range(6):
                    rows[(_SIGMA + i) * LANES + lane] = sigma[r, m, i]
                    rows[(_NOISE + i) * LANES + lane] = noise[k, m, i]
            # Equations 7 to 9 with G = I, the squared distance and |Z|, in all lanes. Eq. 9,
            # (I - K) Sigma, equals K R. This product avoids cancellation, so the covariance stays
            # positive definite after any number of updates. Lanes of particles without the
            # landmark hold undefined values, which are not used.
            for m in range(LANES):
                sxx, sxy = rows[_SIGMA * LANES + m], rows[(_SIGMA + 1) * LANES + m]
                sxz, syy = rows[(_SIGMA + 2) * LANES + m], rows[(_SIGMA + 3) * LANES + m]
                syz, szz = rows[(_SIGMA + 4) * LANES + m], rows[(_SIGMA + 5) * LANES + m]
                rxx, rxy = rows[_NOISE * LANES + m], rows[(_NOISE + 1) * LANES + m]
                rxz, ryy = rows[(_NOISE + 2) * LANES + m], rows[(_NOISE + 3) * LANES + m]
                ryz, rzz = rows[(_NOISE + 4) * LANES + m], rows[(_NOISE + 5) * LANES + m]
                dx, dy = rows[_OFF * LANES + m], rows[(_OFF + 1) * LANES + m]
                dz, zxz, zyz, zzz = rows[(_OFF + 2) * LANES + m], sxz + rxz, syz + ryz, szz + rzz
                if planar:  # see `innovation`
                    dz = zxz = zyz = 0.0
                    zzz = 1.0
                inverse, determinant = inverse_and_determinant(
                    sxx + rxx, sxy + rxy, zxz, syy + ryy, zyz, zzz
                )
                rows[m], rows[LANES + m] = quadratic_form((dx, dy, dz), inverse), determinant
                ixx, ixy, ixz, iyy, iyz, izz = inverse
                # K = Sigma Z^-1 (eq. 7)
                k00 = sxx * ixx + sxy * ixy + sxz * ixz
                k01 = sxx * ixy + sxy * iyy + sxz * iyz
                k02 = sxx * ixz + sxy * iyz + sxz * izz
                k10 = sxy * ixx + syy * ixy + syz * ixz
                k11 = sxy * ixy + syy * iyy + syz * iyz
                k12 = sxy * ixz + syy * iyz + syz * izz
                k20 = sxz * ixx + syz * ixy + szz * ixz
                k21 = sxz * ixy + syz * iyy + szz * iyz
                k22 = sxz * ixz + syz * iyz + szz * izz
                # eq. 8
                rows[_MEAN * LANES + m] += k00 * dx + k01 * dy + k02 * dz
                rows[(_MEAN + 1) * LANES + m] += k10 * dx + k11 * dy + k12 * dz
                rows[(_MEAN + 2) * LANES + m] += k20 * dx + k21 * dy + k22 * dz
                # eq. 9; the mean of mirrored entries keeps it symmetric despite rounding
                rows[_SIGMA * LANES + m] = k00 * rxx + k01 * rxy + k02 * rxz
                rows[(_SIGMA + 3) * LANES + m] = k10 * rxy + k11 * ryy + k12 * ryz
                rows[(_SIGMA + 5) * LANES + m] = k20 * rxz + k21 * ryz + k22 * rzz
                rows[(_SIGMA + 1) * LANES + m] = 0.5 * (
                    (k00 * rxy + k01 * ryy + k02 * ryz) + (k10 * rxx + k11 * rxy + k12 * rxz)
                )
                rows[(_SIGMA + 2) * LANES + m] = 0.5 * (
                    (k00 * rxz + k01 * ryz + k02 * rzz) + (k20 * rxx + k21 * rxy + k22 * rxz)
                )
                rows[(_SIGMA + 4) * LANES + m] = 0.5 * (
                    (k10 * rxz + k11 * ryz + k12 * rzz) + (k20 * rxy + k21 * ryy + k22 * ryz)
                )
            # Write the results back and add the log likelihood.
            for m in range(first, end):
                s, lane = chosen[k, m], m - first
                if s < 0:
                    log_likelihood[m] += log_new[k]
                    continue
                distance, log_determinant = rows[lane], np.log(rows[LANES + lane])
                log_likelihood[m] -= 0.5 * (distance + log_two_pi + log_determinant)  # eq. 10
                r = int(row_of[s])
                for i in range(3):
                    by_particle.mean_m[r, m, i] = rows[(_MEAN + i) * LANES + lane]
                for i in range(6):
                    by_particle.covariance_m2[r, m, i] = rows[(_SIGMA + i) * LANES + lane]
                by_particle.count[r, m] += 1
    return log_likelihood
