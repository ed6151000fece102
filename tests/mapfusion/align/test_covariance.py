"""Tests of `mapfusion.align.covariance`."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import chi2

from mapfusion.align.aligners import make_aligner
from mapfusion.align.alignment import Alignment, Pairs, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.covariance import (
    alignment_covariance,
    calibration_covariance,
    estimate_drift_m,
    residual_scale,
    with_common_motion,
)
from mapfusion.align.mahalanobis_gate import DRIFT_FLOOR_M
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import fit_rigid, least_squares_gain
from mapfusion.camera import EXACT, CalibrationError
from mapfusion.fusion.fusers import AlignedPair, make_fuser
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import rotation
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.registration import Registration
from tests.mapfusion.align.map_pairs import MapPair, given_pairs, stretched

T_A_B = np.array([3.0, -2.0, 0.7])
N = 60


def noisy_pairs(rng: np.random.Generator, stated: float = 1.0, false: int = 0) -> Pairs:
    """Return two maps of the same points with shared errors, and independent ones of 1 cm.

    The covariances of independent errors are `stated` times the true ones. The first `false`
    landmarks of map b are displaced by 0.2 m in random directions.
    """
    truth_b = np.zeros((N, 3))
    truth_b[:, :2] = rng.uniform(-5, 5, (N, 2))
    truth_a = truth_b.copy()
    truth_a[:, :2] = se2.transform_points(T_A_B, truth_b[:, :2])
    maps = []
    for truth in (truth_a, truth_b):
        shared = np.zeros((N, 3, 3))  # a shift in y, a turn about the origin, and a bend
        shared[:, 0, 1] = 0.03
        shared[:, 1, 0], shared[:, 1, 1] = -0.01 * truth[:, 1], 0.01 * truth[:, 0]
        shared[:, 2, 0] = 0.02 * np.sin(truth[:, 0])
        own_m2 = 0.01**2 * np.diag([1.0, 1.0, 1.0])
        position = truth + np.einsum("nrd,r->nd", shared, rng.normal(size=3))
        position += 0.01 * rng.normal(size=(N, 3))
        joint = JointCovariance(np.tile(stated * own_m2, (N, 1, 1)), shared)
        about = np.ones(N, np.int32), np.arange(N, dtype=np.int64)
        maps.append(LandmarkMap(position, joint.marginal_m2, *about, joint=joint))
    angle = rng.uniform(-np.pi, np.pi, false)
    maps[1].position_m[:false, 0] += 0.2 * np.cos(angle)
    maps[1].position_m[:false, 1] += 0.2 * np.sin(angle)
    rows = np.arange(N)
    return Pairs(*maps, Correspondences(rows, rows, np.zeros(N)))


def nees(T: Float, covariance: Float) -> float:
    error = T - T_A_B
    error[2] = se2.wrap(error[2])
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize(("stated", "false"), [(1.0, 0), (1e-2, 0), (1.0, 12)])
@pytest.mark.parametrize("refine", [True, False])
def test_errors_obey_the_covariance(stated: float, false: int, refine: bool) -> None:
    """The NEES is chi-square with 3 degrees of freedom, also for understated noise and outliers."""
    found = []
    for seed in range(200):
        pairs = noisy_pairs(np.random.default_rng(seed), stated, false)
        if refine:
            refined = Refinement().refine(pairs, T_A_B)
            assert not refined.lower_bound
            found.append(nees(refined.T_a_b, refined.covariance))
        else:
            T = np.array(fit_rigid(pairs.p_a, pairs.p_b, np.arange(N)))
            gain = least_squares_gain(T, pairs.p_b)
            found.append(nees(T, alignment_covariance(T, pairs, gain, 0.0).covariance))
    assert np.mean(found) == pytest.approx(3, abs=4 * np.sqrt(6 / 200))
    assert np.mean(np.array(found) < chi2.ppf(0.9, 3)) == pytest.approx(0.9, abs=0.07)


def test_without_shared_errors_it_is_a_lower_bound() -> None:
    pairs = noisy_pairs(np.random.default_rng(0))
    alone = Pairs(replace(pairs.map_a, joint=None), pairs.map_b, pairs.correspondences)
    found = Refinement().refine(alone, T_A_B)
    assert found.lower_bound
    assert np.linalg.eigvalsh(found.covariance)[0] > 0


def test_does_not_depend_on_the_order_of_the_maps() -> None:
    pairs = noisy_pairs(np.random.default_rng(5))
    T = np.array(fit_rigid(pairs.p_a, pairs.p_b, np.arange(N)))
    there = alignment_covariance(T, pairs, least_squares_gain(T, pairs.p_b), 0.0).covariance
    turned = Pairs(pairs.map_b, pairs.map_a, pairs.correspondences)
    back_T = se2.inverse(T)
    gain = least_squares_gain(back_T, turned.p_b)
    back = alignment_covariance(back_T, turned, gain, 0.0).covariance
    cos, sin = np.cos(back_T[2]), np.sin(back_T[2])
    J = np.array([[-cos, sin, back_T[1]], [-sin, -cos, -back_T[0]], [0, 0, -1]])
    np.testing.assert_allclose(back, J @ there @ J.T, rtol=0.01, atol=1e-6)


def test_a_bent_map_shifts_and_turns_as_a_whole() -> None:
    """Compare with the spread of maps shifted by s and turned about their middle by s / r."""
    rng, drift_m, n = np.random.default_rng(1), 0.01, 100_000
    p_a = rng.uniform([5.0, -4.0], [9.0, -1.0], (40, 2))
    middle = p_a.mean(axis=0)
    arm_m = np.sqrt(np.sum((p_a - middle) ** 2, axis=1).mean())
    shift, turn = drift_m * rng.normal(size=(n, 2)), drift_m / arm_m * rng.normal(size=n)
    about = np.column_stack([np.tile(middle, (n, 1)), turn])
    moved = se2.compose(se2.compose(about, np.array([*-middle, 0.0])), T_A_B)
    C = np.diag([1e-4, 2e-4, 1e-6])
    expected = C + np.cov((moved + np.column_stack([shift, 0 * turn]) - T_A_B).T)
    inlier = np.ones(40, dtype=bool)
    given = Alignment(T_A_B, C, inlier, 0.0, Status.ACCEPTED, drift_sigma_m=drift_m)
    found = with_common_motion(given, p_a)
    np.testing.assert_allclose(found, expected, rtol=0.03, atol=0.03 * drift_m**2)
    for other in (replace(given, drift_sigma_m=0.0), replace(given, lower_bound=False)):
        np.testing.assert_array_equal(with_common_motion(other, p_a), C)


OF_A, OF_B = CalibrationError(0.002, 0.003), CalibrationError(0.001, 0.004)


@pytest.fixture(scope="module")
def pair() -> MapPair:
    rng = np.random.default_rng(3)
    found = given_pairs(rng, 60, sigma_m=0.02)
    map_a = replace(found.map_a, covariance_m2=found.map_b.covariance_m2)
    return replace(found, map_a=stretched(rng, map_a), map_b=stretched(rng, found.map_b))


def with_errors(pair: MapPair, of_a: CalibrationError, of_b: CalibrationError) -> MapPair:
    made = replace(pair.map_a, calibration=of_a), replace(pair.map_b, calibration=of_b)
    return replace(pair, map_a=made[0], map_b=made[1])


def refined(pair: MapPair):
    pairs = Pairs(pair.map_a, pair.map_b, pair.correspondences)
    return Refinement(least_drift_m=0.0).refine(pairs, pair.T_a_b)


def by_calibration(T_a_b: Float, pairs: Pairs) -> Float:
    return calibration_covariance(T_a_b, pairs, least_squares_gain(T_a_b, pairs.p_b))


def spoiled(landmarks: LandmarkMap, row: int, by: CalibrationError, share: float) -> LandmarkMap:
    moved = landmarks.position_m + share * by.moves_m(landmarks.position_m)[:, row]
    return replace(landmarks, position_m=moved)


@pytest.mark.parametrize("camera", ["", "one"])
def test_equals_solving_again_with_spoiled_maps(pair: MapPair, camera: str) -> None:
    """Each calibration error is a hundredth of its sigma; the refinement ignores them."""
    share, columns = 0.01, []
    of_both = {"map_a": replace(OF_A, camera=camera), "map_b": replace(OF_B, camera=camera)}
    together = [["map_a", "map_b"]] if camera else [["map_a"], ["map_b"]]
    for row in (0, 1):
        for names in together:
            ends = []
            for s in (share, -share):
                parts = {n: spoiled(getattr(pair, n), row, of_both[n], s) for n in names}
                ends.append(refined(replace(pair, **parts)).T_a_b)
            columns.append((ends[0] - ends[1]) / (2 * share))
    by = np.array(columns).T
    before, after = refined(pair), refined(with_errors(pair, *of_both.values()))
    added = after.covariance - before.covariance
    sigma = np.sqrt(np.diag(by @ by.T))
    # which pairs are true, and s_drift, are judged anew by whoever solves again
    np.testing.assert_allclose((added - by @ by.T) / np.outer(sigma, sigma), 0, atol=0.03)
    np.testing.assert_array_equal(before.T_a_b, after.T_a_b)


def test_headings_alone_turn_one_map_about_either_beginning(pair: MapPair) -> None:
    a, b = CalibrationError(0.002), CalibrationError(0.001)
    own = with_errors(pair, a, b)
    found = by_calibration(pair.T_a_b, Pairs(own.map_a, own.map_b, own.correspondences))
    x, y, _ = pair.T_a_b
    by = np.array([[-y, x, 1.0], [0.0, 0.0, -1.0]]).T * [0.002, 0.001]
    # the maps' noise leaves residuals, which turn with neither
    np.testing.assert_allclose(found, by @ by.T, atol=2e-3 * 0.002**2 * (1 + x * x + y * y))


def test_fused_motions_are_no_surer_than_the_cameras(pair: MapPair) -> None:
    """The joint fuser agrees: headings are ambiguous, common extent determines the scale."""
    a, b = CalibrationError(0.01), CalibrationError(0.02)

    def motion_covariance(pair: MapPair) -> np.ndarray:
        maps, c = (pair.map_a, pair.map_b), pair.correspondences
        aligned = Registration(make_aligner("ransac"), verifier=None).on(*maps, c)
        found = aligned.register(np.random.default_rng(0)).refined
        fused = merge(maps, [AlignedPair(0, 1, found, c)], fuser=make_fuser()).fused[0]
        return fused.motion_covariance[1]

    added = motion_covariance(with_errors(pair, a, b)) - motion_covariance(pair)
    assert added[2, 2] == pytest.approx(0.01**2 + 0.02**2, rel=0.02)
    only_scale = motion_covariance(with_errors(pair, CalibrationError(0, 0.1), EXACT))
    least, most = np.linalg.eigvalsh(only_scale)[[0, -1]]
    assert 0 < least < most < 0.05**2  # a tenth of 10 m would be a metre


def test_inverse_alignments_are_equally_sure(pair: MapPair) -> None:
    own = with_errors(pair, OF_A, OF_B)
    there = by_calibration(pair.T_a_b, Pairs(own.map_a, own.map_b, own.correspondences))
    c = own.correspondences
    turned = type(c)(c.index_b, c.index_a, c.distance)
    T = se2.inverse(pair.T_a_b)
    back = by_calibration(T, Pairs(own.map_b, own.map_a, turned))
    cos, sin = np.cos(T[2]), np.sin(T[2])
    J = np.array([[-cos, sin, T[1]], [-sin, -cos, -T[0]], [0, 0, -1]])  # d inverse / dT
    sigma = np.sqrt(np.diag(back))
    np.testing.assert_allclose((back - J @ there @ J.T) / np.outer(sigma, sigma), 0, atol=0.01)


def residuals_with(rng, n, drift_m):
    """Return residuals about a known motion, and the covariances that explain a part of them."""
    turn = rotation(rng.uniform(-np.pi, np.pi, n))
    S = turn @ np.diag([0.08**2, 0.02**2]) @ np.swapaxes(turn, 1, 2)
    C = S + drift_m**2 * np.eye(2)
    return np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.standard_normal((n, 2))), S


def test_is_the_most_likely_value():
    e, S = residuals_with(np.random.default_rng(0), 2000, 0.1)

    def minus_log_likelihood(drift):
        C = S + drift**2 * np.eye(2)
        square = np.einsum("ni,ni->n", e, np.linalg.solve(C, e[:, :, None])[:, :, 0])
        return np.sum(square + np.log(np.linalg.det(C))) / 2

    best = minimize_scalar(minus_log_likelihood, bounds=(0.0, 1.0), options={"xatol": 1e-9}).x
    # three of 4000 numbers went into the motion
    assert estimate_drift_m(e, S) == pytest.approx(best, rel=1e-3)


def slow_score(e, S, variance_m2, gate_m):
    """Return the derivative of the documented log-likelihood by s_drift^2."""
    share = 2 * len(e) / (2 * len(e) - 3)
    C = S + variance_m2 * np.eye(2)
    inverse, v = np.linalg.inv(C), np.trace(C, axis1=1, axis2=2) / 2
    explained = np.einsum("ni,nij,njk,nk->", e, inverse, inverse, e)
    inside = -np.expm1(-(gate_m**2) / (2 * v))
    truncated = np.exp(-(gate_m**2) / (2 * v)) * gate_m**2 / v**2 if gate_m < np.inf else 0 * v
    return (
        share * explained - np.trace(inverse, axis1=1, axis2=2).sum() + np.sum(truncated / inside)
    )


@pytest.mark.parametrize("gate_m", [0.3, np.inf])
def test_landmarks_of_all_certainties_leave_it_where_no_step_is_taken(gate_m):
    """With heavy tails plain Fisher scoring oscillates on one in fifteen."""
    rng = np.random.default_rng(5)
    above = 0
    for _ in range(60):
        variance = 10 ** rng.uniform(-8, -3, 200)
        sigma = np.sqrt(variance + 10 ** rng.uniform(-12, -6))
        e = sigma[:, None] * rng.standard_t(1.5, (200, 2))
        kept = np.hypot(*e.T) < gate_m
        e, S = e[kept], variance[kept, None, None] * np.eye(2)
        found = estimate_drift_m(e, S, gate_m) ** 2
        if found > 1.001 * DRIFT_FLOOR_M**2:
            near = found * np.array([1 - 1e-3, 1 + 1e-3])
            true = brentq(lambda x, e=e, S=S: slow_score(e, S, x, gate_m), *near, xtol=1e-18)
            assert found == pytest.approx(true, rel=1e-8)
            above += 1
        else:
            assert slow_score(e, S, DRIFT_FLOOR_M**2, gate_m) < 0
    assert above > 20


def test_three_fitted_parameters_leave_the_variance_unbiased():
    rng = np.random.default_rng(1)
    drift, p = 0.1, rng.uniform(-5, 5, (6, 2))
    jacobian = np.zeros((12, 3))
    jacobian[::2, 0] = jacobian[1::2, 1] = 1
    jacobian[::2, 2], jacobian[1::2, 2] = -p[:, 1], p[:, 0]
    rest = np.eye(12) - jacobian @ np.linalg.pinv(jacobian)
    variances = [
        estimate_drift_m((rest @ rng.normal(0, drift, 12)).reshape(6, 2), np.zeros((6, 2, 2))) ** 2
        for _ in range(2000)
    ]
    assert np.mean(variances) == pytest.approx(drift**2, rel=0.05)


@pytest.mark.parametrize("gate_sigmas", [2.0, 3.0])
def test_gate_does_not_bias_it(gate_sigmas):
    rng = np.random.default_rng(2)
    drift = 0.1
    e, S = rng.normal(0, drift, (40_000, 2)), np.zeros((40_000, 2, 2))
    gate = gate_sigmas * drift
    kept = np.hypot(*e.T) < gate
    assert estimate_drift_m(e[kept], S[kept], gate) == pytest.approx(drift, rel=0.02)
    assert estimate_drift_m(e[kept], S[kept]) < 0.98 * drift  # unaware of the gate


def test_true_pairs_fall_into_the_gate_as_often_as_it_says():
    rng = np.random.default_rng(3)
    e, S = residuals_with(rng, 5000, 0.15)

    def coverage(drift):
        C = S + drift**2 * np.eye(2)
        square = np.einsum("ni,ni->n", e, np.linalg.solve(C, e[:, :, None])[:, :, 0])
        return np.mean(square <= chi2.ppf(0.99, 2))

    assert coverage(estimate_drift_m(e, S)) == pytest.approx(0.99, abs=0.005)
    assert coverage(0.0) < 0.5


def test_nothing_to_explain():
    rng = np.random.default_rng(4)
    S = np.tile(np.eye(2) * 0.1**2, (500, 1, 1))
    assert estimate_drift_m(rng.normal(0, 0.05, (500, 2)), S) == DRIFT_FLOOR_M
    assert estimate_drift_m(np.zeros((5, 2)), np.zeros((5, 2, 2))) == DRIFT_FLOOR_M
    assert estimate_drift_m(np.zeros((0, 2)), np.zeros((0, 2, 2))) == DRIFT_FLOOR_M


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("factor", [1.0, 20.0])
def test_residuals_tell_how_much_too_small_covariances_are(factor: float, planar: bool) -> None:
    """Positions with errors of `factor` times the stated covariance, which differs by direction."""
    rng, T_a_b, n = np.random.default_rng(1), np.array([3.0, -2.0, 2.1]), 4000
    shape = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.3], [0.0, 0.3, 0.5]]) * 1e-6
    point = rng.uniform(-5, 5, (n, 3))
    in_b = point.copy()
    in_b[:, :2] = se2.transform_points(se2.inverse(T_a_b), point[:, :2])
    maps = [
        LandmarkMap(
            own + factor * rng.multivariate_normal(np.zeros(3), shape, n),
            np.tile(shape, (n, 1, 1)),
            np.ones(n, np.int32),
            np.arange(n),
            planar=planar,
        )
        for own in (point, in_b)
    ]
    pairs = Pairs(*maps, Correspondences(np.arange(n), np.arange(n), np.zeros(n)))
    assert residual_scale(T_a_b, pairs) == pytest.approx(factor, rel=0.05)
