"""Drift of two maps beyond their landmarks' covariances.

The covariance of a landmark in the map of the best particle is conditional on the path of this
particle. Residuals of true pairs of two maps therefore have the covariance
S_a + R S_b R^T + s_drift^2 I.
"""

import math

import numpy as np

from mapfusion.align.mahalanobis_gate import DRIFT_FLOOR_M
from mapfusion.geometry.numerics import Float, kernel

_TOLERANCE = 1e-9  # relative step of s_drift^2 that ends the search
_MAX_STEPS = 100  # a dozen are the rule
# g^2 / 2v above which the gate's term is below rounding: x exp(-x) < 2^-53
_BEYOND = 41.0
_MOTION_PARAMETERS = 3


@kernel
def _scoring(
    residual_m: Float, covariance_m2: Float, weight: Float, variance_m2: float, gate_m: float
) -> float:
    """Return the Fisher scoring step of s_drift^2, the variance per axis of all residuals.

    The log-likelihood of a residual e with C = S + s_drift^2 I inside a gate of radius g is
    -log|C|/2 - e' C^-1 e/2 - log(1 - exp(-g^2 / 2v)) with v = tr C / 2. The last term is exact for
    isotropic C, and small otherwise. The score is scaled for the three degrees of freedom of the
    fitted motion among the 2N coordinates. S = S_a + R S_b R^T has the shape (N, 2, 2); `weight`
    (N,) is the probability of each pair to be true. Pairs of weight 0 are skipped.
    """
    numbers = 0.0
    for i in range(len(weight)):
        numbers += 2 * weight[i]
    share = numbers / max(numbers - _MOTION_PARAMETERS, 1.0)
    score = information = 0.0
    for i in range(len(residual_m)):
        if weight[i] == 0:
            continue
        xx = covariance_m2[i, 0, 0] + variance_m2
        xy = covariance_m2[i, 0, 1]
        yy = covariance_m2[i, 1, 1] + variance_m2
        det = xx * yy - xy * xy
        ixx, ixy, iyy = yy / det, -xy / det, xx / det
        wx = ixx * residual_m[i, 0] + ixy * residual_m[i, 1]
        wy = ixy * residual_m[i, 0] + iyy * residual_m[i, 1]
        expected = ixx + iyy
        v = (xx + yy) / 2
        if gate_m * gate_m < 2 * _BEYOND * v:
            outside = math.exp(-gate_m * gate_m / (2 * v))
            expected -= outside / (1 - outside) * gate_m * gate_m / (v * v)
        score += weight[i] * (share * (wx * wx + wy * wy) - expected)
        information += weight[i] * (ixx * ixx + 2 * ixy * ixy + iyy * iyy)
    return score / information


@kernel
def drift_step(
    residual_m: Float, covariance_m2: Float, weight: Float, variance_m2: float, gate_m: float
) -> float:
    """Return s_drift^2 after one step of Fisher scoring, at least DRIFT_FLOOR_M squared."""
    step = _scoring(residual_m, covariance_m2, weight, variance_m2, gate_m)
    return max(variance_m2 + step, DRIFT_FLOOR_M * DRIFT_FLOOR_M)


@kernel
def _drift_fixed_point(
    residual_m: Float, covariance_m2: Float, variance_m2: float, gate_m: float
) -> float:
    """Return s_drift^2 (at least the floor) at which the Fisher scoring step is zero.

    If some landmarks are far more precise than others, plain steps converge slowly or oscillate.
    The zero is therefore found by the secant method with a bracket.
    """
    floor, weight = DRIFT_FLOOR_M * DRIFT_FLOOR_M, np.ones(len(residual_m))
    low, high = 0.0, math.inf
    before, step_before = math.inf, 0.0
    for _ in range(_MAX_STEPS):
        step = _scoring(residual_m, covariance_m2, weight, variance_m2, gate_m)
        if abs(step) <= _TOLERANCE * variance_m2 or (variance_m2 <= floor and step < 0):
            break
        if step > 0:
            low = variance_m2
        else:
            high = variance_m2
        # the slope is -1 for equal covariances
        slope = (step - step_before) / (variance_m2 - before) if before < math.inf else -1.0
        before, step_before = variance_m2, step
        variance_m2 = max(variance_m2 - step / (slope if slope < 0 else -1.0), floor)
        if not low < variance_m2 < high:
            variance_m2 = math.sqrt(max(low, floor) * high)
    return variance_m2


def estimate_drift_m(residual_m: Float, covariance_m2: Float, gate_m: float = math.inf) -> float:
    """Return the most likely s_drift in metres for residuals of pairs about a fitted motion.

    Residuals have the shape (N, 2), their covariances S_a + R S_b R^T the shape (N, 2, 2); none
    exceeds `gate_m`. The result is DRIFT_FLOOR_M if the covariances explain the residuals, or
    without residuals.
    """
    if len(residual_m) == 0:
        return DRIFT_FLOOR_M
    start = max(float(np.mean(residual_m**2)), DRIFT_FLOOR_M**2)
    return math.sqrt(_drift_fixed_point(residual_m, covariance_m2, start, gate_m))
