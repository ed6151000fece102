"""The Kalman filter of one landmark in one particle, and its weight (eq. 4-10)."""

import numpy as np
from numba import njit

from mapfusion.fastslam.sensor import Sightings, Upper, Vector, innovation, quadratic_form
from mapfusion.fastslam.slots import Estimates, Slots
from mapfusion.se2 import Float

NEW = -1  # the particle has no such landmark yet
DROPPED = -2  # the observation is used for nothing


@njit(cache=True, error_model="numpy")
def update_landmarks(
    slots: Slots, chosen: np.ndarray, seen: Sightings, log_new: Float, planar: bool
) -> Float:
    """Correct the landmarks that were chosen, in place, and tell what the observations say.

    `chosen` (K, M) is a slot, NEW or DROPPED, `log_new` (K,) the log density of an observation that
    matches nothing. Returns (M,) log likelihood: the product of eq. 10 over the observations.
    """
    own = slots.own
    n_observations, n_particles = chosen.shape
    log_two_pi = (2.0 if planar else 3.0) * np.log(2.0 * np.pi)
    log_likelihood = np.zeros(n_particles)
    for k in range(n_observations):
        for m in range(n_particles):
            s = chosen[k, m]
            if s < 0:
                log_likelihood[m] += log_new[k]
                continue
            r = int(slots.row[s])
            difference, inverse, determinant = innovation(seen, k, own, r, m, planar)
            distance = quadratic_form(difference, inverse)
            log_likelihood[m] -= 0.5 * (distance + log_two_pi + np.log(determinant))  # eq. 10
            _correct(seen, k, own, r, m, difference, inverse)
    return log_likelihood


@njit(cache=True, error_model="numpy")
def _correct(
    seen: Sightings, k: int, own: Estimates, r: int, m: int, difference: Vector, inverse: Upper
) -> None:
    """Equations 7 to 9 with G = I.

    Eq. 9, (I - K) Sigma, equals K R. The product has no difference of near equal numbers in it, so
    the covariance stays positive however often a landmark is seen.
    """
    mean, sigma, noise = own.mean_m, own.covariance_m2, seen.covariance_m2
    dx, dy, dz = difference
    ixx, ixy, ixz, iyy, iyz, izz = inverse
    sxx, sxy, sxz = sigma[r, m, 0], sigma[r, m, 1], sigma[r, m, 2]
    syy, syz, szz = sigma[r, m, 3], sigma[r, m, 4], sigma[r, m, 5]
    rxx, rxy, rxz = noise[k, m, 0], noise[k, m, 1], noise[k, m, 2]
    ryy, ryz, rzz = noise[k, m, 3], noise[k, m, 4], noise[k, m, 5]
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
    mean[r, m, 0] += k00 * dx + k01 * dy + k02 * dz
    mean[r, m, 1] += k10 * dx + k11 * dy + k12 * dz
    mean[r, m, 2] += k20 * dx + k21 * dy + k22 * dz
    # eq. 9; the mean of mirrored entries keeps rounding from making it unsymmetric
    sigma[r, m, 0] = k00 * rxx + k01 * rxy + k02 * rxz
    sigma[r, m, 3] = k10 * rxy + k11 * ryy + k12 * ryz
    sigma[r, m, 5] = k20 * rxz + k21 * ryz + k22 * rzz
    sigma[r, m, 1] = 0.5 * (
        (k00 * rxy + k01 * ryy + k02 * ryz) + (k10 * rxx + k11 * rxy + k12 * rxz)
    )
    sigma[r, m, 2] = 0.5 * (
        (k00 * rxz + k01 * ryz + k02 * rzz) + (k20 * rxx + k21 * rxy + k22 * rxz)
    )
    sigma[r, m, 4] = 0.5 * (
        (k10 * rxz + k11 * ryz + k12 * rzz) + (k20 * rxy + k21 * ryy + k22 * ryz)
    )
    own.count[r, m] += 1
