"""The Kalman filter of one landmark in one particle, and its weight (eq. 4-10)."""

import numpy as np

from mapfusion.fastslam.sensor import Sightings, inverse_and_determinant, quadratic_form
from mapfusion.fastslam.slots import LANES, Estimates, Slots
from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float

NEW = -1  # the particle has no such landmark yet
DROPPED = -2  # the observation is used for nothing
# Rows of what particles have that are taken together: squared distance, |Z|, then from these on the
# mean, the innovation, and the upper entries of the landmark's covariance and of the observation's.
_MEAN, _OFF, _SIGMA, _NOISE, _ROWS = 2, 5, 8, 14, 20


@kernel(error_model="numpy")
def update_landmarks(
    slots: Slots, chosen: np.ndarray, seen: Sightings, log_new: Float, planar: bool
) -> Float:
    """Correct the landmarks that were chosen, in place, and tell what the observations say.

    `chosen` (K, M) is a slot, NEW or DROPPED, `log_new` (K,) the log density of an observation that
    matches nothing. Returns (M,) log likelihood: the product of eq. 10 over the observations.
    """
    n_observations, n_particles = chosen.shape
    log_two_pi = (2.0 if planar else 3.0) * np.log(2.0 * np.pi)
    log_likelihood, rows = np.zeros(n_particles), np.zeros(_ROWS * LANES)
    for k in range(n_observations):
        for first in range(0, n_particles, LANES):
            end = min(first + LANES, n_particles)
            _gather(slots, chosen, seen, k, first, end, rows)
            _correct(rows, planar)
            for m in range(first, end):
                s, lane = chosen[k, m], m - first
                if s < 0:
                    log_likelihood[m] += log_new[k]
                    continue
                distance, log_determinant = rows[lane], np.log(rows[LANES + lane])
                log_likelihood[m] -= 0.5 * (distance + log_two_pi + log_determinant)  # eq. 10
                _put_back(slots.own, int(slots.row[s]), m, lane, rows)
    return log_likelihood


@kernel_part(error_model="numpy")
def _gather(
    slots: Slots,
    chosen: np.ndarray,
    seen: Sightings,
    k: int,
    first: int,
    end: int,
    rows: Float,
) -> None:
    """What the particles from `first` to `end` have of the landmark and of the observation."""
    mean, sigma = slots.own.mean_m, slots.own.covariance_m2
    point, noise = seen.point_m, seen.covariance_m2
    for m in range(first, end):
        s, lane = chosen[k, m], m - first
        if s < 0:
            continue
        r = int(slots.row[s])
        for i in range(3):
            rows[(_MEAN + i) * LANES + lane] = mean[r, m, i]
            rows[(_OFF + i) * LANES + lane] = point[k, m, i] - mean[r, m, i]
        for i in range(6):
            rows[(_SIGMA + i) * LANES + lane] = sigma[r, m, i]
            rows[(_NOISE + i) * LANES + lane] = noise[k, m, i]


@kernel_part(error_model="numpy")
def _put_back(own: Estimates, r: int, m: int, lane: int, rows: Float) -> None:
    for i in range(3):
        own.mean_m[r, m, i] = rows[(_MEAN + i) * LANES + lane]
    for i in range(6):
        own.covariance_m2[r, m, i] = rows[(_SIGMA + i) * LANES + lane]
    own.count[r, m] += 1


@kernel_part(error_model="numpy")
def _correct(rows: Float, planar: bool) -> None:
    """Equations 7 to 9 with G = I, and the squared distance and |Z|, in all lanes.

    Eq. 9, (I - K) Sigma, equals K R. The product has no difference of near equal numbers in it, so
    the covariance stays positive however often a landmark is seen. Lanes of particles that do not
    have the landmark hold anything, and come to anything.
    """
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
        # eq. 9; the mean of mirrored entries keeps rounding from making it unsymmetric
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
