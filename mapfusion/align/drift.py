"""s_drift: how far two maps disagree beyond their landmarks' own covariances.

A landmark's covariance in the best particle's map is conditional on that one path, so between two
maps the residuals of true pairs have the covariance S_a + R S_b R^T + s_drift^2 I.
"""

import math

import numpy as np

from mapfusion.kernels import inner_kernel, kernel, kernel_part
from mapfusion.se2 import Float

# Below this nothing is measured: it only keeps the weights of noise-free data finite.
DRIFT_FLOOR_M = 1e-6
_TOLERANCE = 1e-9  # relative step of s_drift^2 that ends the search
_MAX_STEPS = 100  # a dozen are the rule
# g^2 / 2v from which on the gate's term is lost in rounding: x exp(-x) is below 2^-53
_BEYOND = 41.0
_MOTION_PARAMETERS = 3


@inner_kernel
def _scoring(
    residual_m: Float, covariance_m2: Float, weight: Float, variance_m2: float, gate_m: float
) -> float:
    """How far Fisher scoring moves s_drift^2, the variance per axis common to all residuals.

    The log-likelihood of a residual e with C = S + s_drift^2 I, given that it fell inside a gate of
    radius g, is -log|C|/2 - e' C^-1 e/2 - log(1 - exp(-g^2 / 2v)) with v = tr C / 2. The last term
    is exact for isotropic C and small otherwise, since a gate is wide. The three parameters that
    the fitted motion took from the 2N numbers are made good by their share.
    S = S_a + R S_b R^T is (N, 2, 2), `weight` (N,) 0 to 1 how surely each pair is true.
    """
    numbers = 0.0
    for i in range(len(weight)):
        numbers += 2 * weight[i]
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
        v = (xx + yy) / 2
        if gate_m * gate_m < 2 * _BEYOND * v:
            outside = math.exp(-gate_m * gate_m / (2 * v))
            expected -= outside / (1 - outside) * gate_m * gate_m / (v * v)
        score += weight[i] * (share * (wx * wx + wy * wy) - expected)
        information += weight[i] * (ixx * ixx + 2 * ixy * ixy + iyy * iyy)
    return score / information


@kernel_part
def drift_step(
    residual_m: Float, covariance_m2: Float, weight: Float, variance_m2: float, gate_m: float
) -> float:
    """s_drift^2 after one step of Fisher scoring, at least DRIFT_FLOOR_M squared."""
    step = _scoring(residual_m, covariance_m2, weight, variance_m2, gate_m)
    return max(variance_m2 + step, DRIFT_FLOOR_M * DRIFT_FLOOR_M)


@kernel
def _climb(residual_m: Float, covariance_m2: Float, variance_m2: float, gate_m: float) -> float:
    """s_drift^2 (at least the floor) where Fisher scoring takes no step.

    Of landmarks known to a micrometre and to a decimetre, the sure ones make the information and
    the others the score: plain steps creep, or go to and fro for ever. The secant through the last
    two of them meets zero soon, and between a place that is too low and one that is too high there
    is one.
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
        # of a constant, which all landmarks equally sure leave, the slope is -1
        slope = (step - step_before) / (variance_m2 - before) if before < math.inf else -1.0
        before, step_before = variance_m2, step
        variance_m2 = max(variance_m2 - step / (slope if slope < 0 else -1.0), floor)
        if not low < variance_m2 < high:
            variance_m2 = math.sqrt(max(low, floor) * high)
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
