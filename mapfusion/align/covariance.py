"""Covariance of an alignment, from the errors of both maps.

To first order the error of T_a_b is the sum of gains G_i times the errors of the residuals
e_i = p_a,i - T p_b,i, whichever method found the motion. The errors of a map with a joint
covariance are shared displacements C_i by independent standard normal variables, and independent
errors with covariances S_i (`joint_covariance`). So the covariance of T_a_b is

    f sum G_i (S_a,i + R S_b,i R') G_i' + A A' + B B',
    A = sum G_i C_a,i,   B = sum G_i R C_b,i,

the sandwich form, which holds for any weights of the pairs (Huber 1967, White 1980). Independent
errors may exceed the stated ones, as those of false pairs do. The factor f >= 1 is the ratio of the
sandwich with the observed residuals r_i in place of the stated covariances, after the shared errors
were fitted to all residuals with Student-t weights.

The covariance of a landmark in the map of the best particle is conditional on the path of this
particle. Residuals of true pairs of two maps therefore have the covariance
S_a,i + R S_b,i R' + s_drift^2 I; `estimate_drift_m` estimates s_drift.

A map without a joint covariance states nothing of the errors that its landmarks share. They leave
no residuals if they move the whole map. The covariance is then a lower bound, by independent errors
of that covariance. Decisions add a common motion of all pairs by
s_drift (`with_common_motion`).
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.align.alignment import Alignment, Pairs
from mapfusion.align.mahalanobis_gate import DRIFT_FLOOR_M
from mapfusion.align.rigid_motion import motion_covariance, residual_covariances, residuals
from mapfusion.geometry.numerics import Float, chi_square_bound, kernel
from mapfusion.geometry.se2 import motion_jacobian, rotation

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
    previous_m2, previous_step = math.inf, 0.0
    for _ in range(_MAX_STEPS):
        step = _scoring(residual_m, covariance_m2, weight, variance_m2, gate_m)
        if abs(step) <= _TOLERANCE * variance_m2 or (variance_m2 <= floor and step < 0):
            break
        if step > 0:
            low = variance_m2
        else:
            high = variance_m2
        # the slope is -1 for equal covariances
        slope = (
            (step - previous_step) / (variance_m2 - previous_m2) if previous_m2 < math.inf else -1.0
        )
        previous_m2, previous_step = variance_m2, step
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


class MotionCovariance(NamedTuple):
    """Covariance of T_a_b.

    Attributes:
        covariance: shape (3, 3).
        lower_bound: True if a map does not state all errors that its landmarks share.
    """

    covariance: Float
    lower_bound: bool


def alignment_covariance(
    T_a_b: Float,
    pairs: Pairs,
    gain: Float,
    drift_sigma_m: float,
    independent: Float | None = None,
) -> MotionCovariance:
    """Return the covariance of a motion that was fitted to pairs.

    Args:
        T_a_b: motion, shape (3,).
        pairs: the n fitted pairs, not all on one point.
        gain: derivatives of the motion by each residual, shape (n, 3, 2).
        drift_sigma_m: s_drift of the residuals.
        independent: covariance (3, 3) by independent errors, for maps without joint covariances; by
            default that of the gains.
    """
    by_calibration = calibration_covariance(T_a_b, pairs, gain)
    a, b = pairs.map_a.joint, pairs.map_b.joint
    if a is None or b is None:
        if independent is None:
            C_residual = residual_covariances(T_a_b, pairs.covariance_a, pairs.covariance_b)
            independent = motion_covariance(gain, C_residual + drift_sigma_m**2 * np.eye(2))
        return MotionCovariance(independent + by_calibration, True)
    R = rotation(T_a_b[2])
    by_shared = np.zeros((3, 3))
    for joint, index, turn in ((a, pairs.index_a, np.eye(2)), (b, pairs.index_b, R)):
        moved = np.tensordot(gain @ turn, joint.common_m[index][:, :, :2], axes=((0, 2), (0, 2)))
        by_shared += moved @ moved.T
    C_residual = residual_covariances(T_a_b, a.own_m2[pairs.index_a], b.own_m2[pairs.index_b])
    by_own = motion_covariance(gain, C_residual + DRIFT_FLOOR_M**2 * np.eye(2))
    factor = _residual_factor(T_a_b, pairs, gain, by_own)
    lower_bound = not (a.complete and b.complete)
    return MotionCovariance(factor * by_own + by_shared + by_calibration, lower_bound)


# Degrees of freedom of the Student-t weights of residuals, the usual choice for data with outliers
# (Lange, Little and Taylor 1989), and the number of reweighted least squares.
_DOF, _ROUNDS = 4.0, 5


def _residual_factor(T_a_b: Float, pairs: Pairs, gain: Float, stated: Float) -> float:
    """Return the factor f, at least 1, on the covariance of the motion by independent errors.

    `stated` (3, 3) is this covariance for f = 1. Only the largest shared errors are fitted; the
    effect of the others counts as independent.
    """
    assert pairs.map_a.joint is not None
    assert pairs.map_b.joint is not None
    a = pairs.map_a.joint.leading[pairs.index_a]
    b = pairs.map_b.joint.leading[pairs.index_b]
    e = residuals(T_a_b, pairs.p_a, pairs.p_b)
    C_residual = residual_covariances(T_a_b, a.own_m2, b.own_m2) + DRIFT_FLOOR_M**2 * np.eye(2)
    by_a = np.swapaxes(a.common_m[:, :, :2], 1, 2)
    by_b = -rotation(T_a_b[2]) @ np.swapaxes(b.common_m[:, :, :2], 1, 2)
    # e = X u + error, where u are the shared variables of both maps and the error of the motion
    X = np.concatenate([by_a, by_b, motion_jacobian(T_a_b, pairs.p_b)], axis=2)
    n_shared = a.rank + b.rank
    prior = np.diag(np.concatenate([np.ones(n_shared), np.zeros(X.shape[2] - n_shared)]))
    whiten = np.linalg.inv(np.linalg.cholesky(C_residual))
    X_white, e_white = whiten @ X, np.einsum("nij,nj->ni", whiten, e)
    weight, left, r = np.ones(len(e)), prior, e_white
    for _ in range(_ROUNDS):
        weighted = (weight[:, None, None] * X_white).reshape(-1, X.shape[2])
        left = weighted.T @ X_white.reshape(weighted.shape) + prior
        r = e_white - X_white @ np.linalg.solve(left, weighted.T @ e_white.ravel())
        weight = (_DOF + 2) / (_DOF + np.sum(r**2, axis=1))
    fitted = X.shape[2] - np.trace(np.linalg.solve(left, prior))  # effective number of unknowns
    moved = np.einsum("nij,nj->ni", gain @ np.linalg.inv(whiten), r)
    n_numbers = 2 * len(e)
    observed = moved.T @ moved * n_numbers / max(n_numbers - fitted, 1.0)
    return max(1.0, float(np.trace(np.linalg.solve(stated, observed))) / 3)


def residual_scale(T_a_b: Float, pairs: Pairs) -> float:
    """Return the size of the residuals of pairs in sigmas of their stated covariances.

    This is the root of the median squared Mahalanobis length over the median of chi-square; 1 is
    expected of covariances that hold.
    """
    n_dimensions = 2 if pairs.map_a.planar or pairs.map_b.planar else 3
    turn = np.eye(3)
    turn[:2, :2] = rotation(T_a_b[2])
    a, b = pairs.map_a, pairs.map_b
    e = a.position_m[pairs.index_a] - b.position_m[pairs.index_b] @ turn.T
    e[:, :2] -= T_a_b[:2]
    S = a.covariance_m2[pairs.index_a] + turn @ b.covariance_m2[pairs.index_b] @ turn.T
    i = np.arange(3)
    S[:, i, i] = np.maximum(S[:, i, i], DRIFT_FLOOR_M**2)  # maps may state zero
    e, S = e[:, :n_dimensions], S[:, :n_dimensions, :n_dimensions]
    squares = np.vecdot(e, np.linalg.solve(S, e[..., None])[..., 0])
    return math.sqrt(float(np.median(squares)) / chi_square_bound(0.5, n_dimensions))


def with_common_motion(alignment: Alignment, p_a: Float) -> Float:
    """Return the covariance (3, 3) of an alignment, with a common motion if it is a lower bound.

    The supporting pairs, at p_a (n, 2) in frame a, shift together by s_drift, and turn about their
    centroid by the corresponding angle.
    """
    T_a_b, drift_sigma_m = alignment.T_a_b, alignment.drift_sigma_m
    if not alignment.lower_bound or drift_sigma_m == 0 or not len(p_a):
        return alignment.covariance
    middle = p_a.mean(axis=0)
    arm_m2 = np.sum((p_a - middle) ** 2, axis=1).mean()
    turn = np.array([middle[1] - T_a_b[1], T_a_b[0] - middle[0], 1.0])  # about the centroid
    unit_covariance = np.diag([1.0, 1.0, 0.0]) + np.outer(turn, turn) / max(
        arm_m2, drift_sigma_m**2
    )
    return alignment.covariance + drift_sigma_m**2 * unit_covariance


def calibration_covariance(T_a_b: Float, pairs: Pairs, gain: Float) -> Float:
    """Return the covariance (3, 3) of a motion from errors of the camera calibration.

    An error of the calibration moves all points of a map. The errors of two maps are independent
    unless both maps are from one camera. For the arguments see `alignment_covariance`.
    """
    of_maps = pairs.map_a.calibration, pairs.map_b.calibration
    if all(each.is_none for each in of_maps):
        return np.zeros((3, 3))
    by_a, by_b = (
        errors.moves_m(p)[:, :, :2]
        for errors, p in zip(of_maps, (pairs.p_a, pairs.p_b), strict=True)
    )
    by_b = -by_b @ rotation(T_a_b[2]).T
    alike = of_maps[0].is_of_one_camera(of_maps[1])
    moved = by_a + by_b if alike else np.concatenate([by_a, by_b], axis=1)
    by = np.einsum("nij,nkj->ik", gain, moved)
    return by @ by.T
