"""The Kalman filter of one landmark in one particle, and its weight (eq. 4-10)."""

import numpy as np
from numba import njit

from mapfusion.fastslam.sensor import Sightings, Upper, Vector, innovation, quadratic_form
from mapfusion.fastslam.slots import Slots
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
    n_observations, n_particles = chosen.shape
    log_two_pi = (2.0 if planar else 3.0) * np.log(2.0 * np.pi)
    log_likelihood = np.zeros(n_particles)
    for k in range(n_observations):
        point, noise = seen.point_m[k], seen.covariance_m2[k]
        for m in range(n_particles):
            s = chosen[k, m]
            if s < 0:
                log_likelihood[m] += log_new[k]
                continue
            mean, sigma = slots.mean_m[s], slots.covariance_m2[s]
            difference, inverse, determinant = innovation(point, noise, mean, sigma, m, planar)
            distance = quadratic_form(difference, inverse)
            log_likelihood[m] -= 0.5 * (distance + log_two_pi + np.log(determinant))  # eq. 10
            _correct(mean, sigma, noise, m, difference, inverse)
            slots.count[s, m] += 1
    return log_likelihood


@njit(cache=True, error_model="numpy")
def _correct(
    mean: Float, sigma: Float, noise: Float, m: int, difference: Vector, inverse: Upper
) -> None:
    """Equations 7 to 9 with G = I.

    Eq. 9, (I - K) Sigma, equals K R. The product has no difference of near equal numbers in it, so
    the covariance stays positive however often a landmark is seen.
    """
    dx, dy, dz = difference
    ixx, ixy, ixz, iyy, iyz, izz = inverse
    sxx, sxy, sxz = sigma[m, 0], sigma[m, 1], sigma[m, 2]
    syy, syz, szz = sigma[m, 3], sigma[m, 4], sigma[m, 5]
    rxx, rxy, rxz = noise[m, 0], noise[m, 1], noise[m, 2]
    ryy, ryz, rzz = noise[m, 3], noise[m, 4], noise[m, 5]
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
    mean[m, 0] += k00 * dx + k01 * dy + k02 * dz
    mean[m, 1] += k10 * dx + k11 * dy + k12 * dz
    mean[m, 2] += k20 * dx + k21 * dy + k22 * dz
    # eq. 9; the mean of mirrored entries keeps rounding from making it unsymmetric
    sigma[m, 0] = k00 * rxx + k01 * rxy + k02 * rxz
    sigma[m, 3] = k10 * rxy + k11 * ryy + k12 * ryz
    sigma[m, 5] = k20 * rxz + k21 * ryz + k22 * rzz
    sigma[m, 1] = 0.5 * ((k00 * rxy + k01 * ryy + k02 * ryz) + (k10 * rxx + k11 * rxy + k12 * rxz))
    sigma[m, 2] = 0.5 * ((k00 * rxz + k01 * ryz + k02 * rzz) + (k20 * rxx + k21 * rxy + k22 * rxz))
    sigma[m, 4] = 0.5 * ((k10 * rxz + k11 * ryz + k12 * rzz) + (k20 * rxy + k21 * ryy + k22 * ryz))
