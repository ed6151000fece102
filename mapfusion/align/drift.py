"""s_drift: how far two maps disagree beyond their landmarks' own covariances.

A landmark's covariance in the best particle's map is conditional on that one path, so between two
maps the residuals of true pairs have the covariance S_a + R S_b R^T + s_drift^2 I.
"""

import math

import numpy as np
from numba import njit

from mapfusion.se2 import Float

# Below this nothing is measured: it only keeps the weights of noise-free data finite.
DRIFT_FLOOR_M = 1e-6
_TOLERANCE = 1e-9  # relative change of s_drift^2 that ends the search
_MAX_STEPS = 100
_MOTION_PARAMETERS = 3


@njit(cache=True)
def drift_step(
    residual_m: Float, covariance_m2: Float, weight: Float, variance_m2: float, gate_m: float
) -> float:
    """One step of Fisher scoring for s_drift^2, the variance per axis common to all residuals.

    The log-likelihood of a residual e with C = S + s_drift^2 I, given that it fell inside a gate of
    radius g, is -log|C|/2 - e' C^-1 e/2 - log(1 - exp(-g^2 / 2v)) with v = tr C / 2. The last term
    is exact for isotropic C and small otherwise, since a gate is wide. The three parameters that
    the fitted motion took from the 2N numbers are made good by their share.
    S = S_a + R S_b R^T is (N, 2, 2), `weight` (N,) 0 to 1 how surely each pair is true. The next
    s_drift^2 is at least DRIFT_FLOOR_M squared.
    """
    numbers = 2 * np.sum(weight)
    share = numbers / max(numbers - _MOTION_PARAMETERS, 1.0)
    score = information = 0.0
    for i in range(len(residual_m)):
        xx = covariance_m2[i, 0, 0] + variance_m2
        xy = covariance_m2[i, 0, 1]
        yy = covariance_m2[i, 1, 1] + variance_m2
        det = xx * yy - xy * xy
        ixx, ixy, iyy = yy / det, -xy / det, xx / det
        wx = ixx * residual_m[i, 0] + ixy * residual_m[i, 1]
        wy = ixy * residual_m[i, 0] + iyy * residual_m[i, 1]
        expected = ixx + iyy
        if gate_m < math.inf:
            v = (xx + yy) / 2
            outside = math.exp(-gate_m * gate_m / (2 * v))
            expected -= outside / (1 - outside) * gate_m * gate_m / (v * v)
        score += weight[i] * (share * (wx * wx + wy * wy) - expected)
        information += weight[i] * (ixx * ixx + 2 * ixy * ixy + iyy * iyy)
    return max(variance_m2 + score / information, DRIFT_FLOOR_M * DRIFT_FLOOR_M)


@njit(cache=True)
def _climb(residual_m: Float, covariance_m2: Float, variance_m2: float, gate_m: float) -> float:
    weight = np.ones(len(residual_m))
    for _ in range(_MAX_STEPS):
        before = variance_m2
        variance_m2 = drift_step(residual_m, covariance_m2, weight, variance_m2, gate_m)
        if abs(variance_m2 - before) <= _TOLERANCE * variance_m2:
            break
    return variance_m2


def estimate_drift_m(residual_m: Float, covariance_m2: Float, gate_m: float = math.inf) -> float:
    """Most likely s_drift in metres for the residuals of pairs about a fitted motion.

    Residuals are (N, 2), S_a + R S_b R^T (N, 2, 2), those beyond `gate_m` were dropped. It is
    DRIFT_FLOOR_M where the covariances explain the residuals, or there are none.
    """
    if len(residual_m) == 0:
        return DRIFT_FLOOR_M
    start = max(float(np.mean(residual_m**2)), DRIFT_FLOOR_M**2)
    return math.sqrt(_climb(residual_m, covariance_m2, start, gate_m))
