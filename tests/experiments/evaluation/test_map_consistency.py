"""Fit, gross landmarks and consistency against dense twins and drawn errors of known covariance."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from experiments.evaluation.map_consistency import (
    GROSS_M,
    consistencies,
    fit_to_truth,
    relative_consistency,
)
from mapfusion.geometry import se2
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.landmark_map import LandmarkMap

SHARED_SIGMA_M, OWN_SIGMA_M = 0.008, 0.005  # so small that no error is gross


def drawn_map(
    rng: np.random.Generator, n: int = 40, rank: int = 6, planar: bool = False
) -> tuple[LandmarkMap, Float]:
    """A map whose errors are of the covariance that it states, and the true points."""
    d = 2 if planar else 3
    truth = np.zeros((n, 3))
    truth[:, :d] = rng.uniform(-4, 4, (n, d))
    own, common = np.zeros((n, 3, 3)), np.zeros((n, rank, 3))
    skewed = np.eye(d) + 0.3 * rng.standard_normal((n, d, d))
    own[:, :d, :d] = OWN_SIGMA_M**2 * skewed @ np.swapaxes(skewed, 1, 2)
    common[..., :d] = SHARED_SIGMA_M * rng.standard_normal((n, rank, d))
    error = np.zeros((n, 3))
    root = np.linalg.cholesky(own[:, :d, :d])
    error[:, :d] = np.einsum("nij,nj->ni", root, rng.standard_normal((n, d)))
    error += np.einsum("nrj,r->nj", common, rng.standard_normal(rank))
    joint, counts = JointCovariance(own, common), np.full(n, 3, np.int32)
    landmarks = LandmarkMap(
        truth + error, joint.marginal_m2, counts, np.arange(n), planar=planar, joint=joint
    )
    return landmarks, truth


def moved(landmarks: LandmarkMap, T: Float) -> LandmarkMap:
    """The same map in another frame."""
    joint, R = landmarks.joint, np.eye(3)
    R[:2, :2] = se2.rotation(T[2])
    assert joint is not None
    joint = JointCovariance(R @ joint.own_m2 @ R.T, joint.common_m @ R.T)
    position = se2.transform_points(T, landmarks.position_m)
    return replace(landmarks, position_m=position, covariance_m2=joint.marginal_m2, joint=joint)


def dense_without_gauge(landmarks: LandmarkMap, error: Float, at: Float) -> tuple[Float, Float]:
    """Error (d n,) and covariance, projected by I - J (J'J)^-1 J', written down as it stands."""
    n, d = len(error), 2 if landmarks.planar else 3
    assert landmarks.joint is not None
    used = (3 * np.arange(n)[:, None] + np.arange(d)).ravel()
    J = np.zeros((3 * n, 3))
    J[0::3, 0] = J[1::3, 1] = 1.0
    J[0::3, 2], J[1::3, 2] = -at[:, 1], at[:, 0]
    J = J[used]
    P = np.eye(n * d) - J @ np.linalg.solve(J.T @ J, J.T)
    return P @ error[:, :d].ravel(), P @ landmarks.joint.dense_m2()[np.ix_(used, used)] @ P


@pytest.mark.parametrize("planar", [False, True])
def test_equals_the_dense_twin(planar: bool) -> None:
    landmarks, truth = drawn_map(np.random.default_rng(0), planar=planar)
    fit, d = fit_to_truth(landmarks, truth), 2 if planar else 3
    found = relative_consistency(landmarks, fit)
    error, S = dense_without_gauge(landmarks, fit.error_m, fit.truth_m)
    dof = len(error) - 3
    nees = error @ np.linalg.pinv(S, rcond=1e-9, hermitian=True) @ error
    assert found.nees_per_dof == pytest.approx(nees / dof, rel=1e-6)
    blocks = [slice(k, k + d) for k in range(0, len(error), d)]
    own = np.array([error[b] @ np.linalg.solve(S[b, b], error[b]) for b in blocks])
    assert found.marginal_nees_per_dof == pytest.approx(own.mean() / d, rel=1e-9)
    assert found.coverage_95 == np.mean(own <= chi_square_bound(0.95, d))


def test_in_its_own_frame_nothing_is_projected() -> None:
    landmarks, truth = drawn_map(np.random.default_rng(1))
    error = landmarks.position_m - truth
    _, found = consistencies(landmarks, fit_to_truth(landmarks, truth))
    assert landmarks.joint is not None
    nees = error.ravel() @ scipy.linalg.solve(landmarks.joint.dense_m2(), error.ravel())
    assert found.nees_per_dof == pytest.approx(nees / error.size, rel=1e-9)


@pytest.mark.parametrize("planar", [False, True])
def test_drawn_errors_of_the_stated_covariance_are_consistent(planar: bool) -> None:
    rng = np.random.default_rng(2)
    drawn = [drawn_map(rng, planar=planar) for _ in range(200)]
    found = [relative_consistency(own, fit_to_truth(own, truth)) for own, truth in drawn]
    assert np.mean([each.nees_per_dof for each in found]) == pytest.approx(1, abs=0.035)
    assert np.mean([each.marginal_nees_per_dof for each in found]) == pytest.approx(1, abs=0.2)
    assert np.mean([each.coverage_95 for each in found]) == pytest.approx(0.95, abs=0.03)


def test_a_map_that_leaves_out_what_is_shared_is_found_too_sure() -> None:
    """Too sure of all at once where correlations are left out, of each where the sigma is small."""
    landmarks, truth = drawn_map(np.random.default_rng(3), n=100)
    assert landmarks.joint is not None
    right = relative_consistency(landmarks, fit_to_truth(landmarks, truth))
    half = JointCovariance(landmarks.joint.own_m2 / 4, landmarks.joint.common_m / 2)
    sure = replace(landmarks, covariance_m2=half.marginal_m2, joint=half)
    found = relative_consistency(sure, fit_to_truth(sure, truth))
    assert found.nees_per_dof == pytest.approx(4 * right.nees_per_dof)
    assert found.coverage_95 < right.coverage_95 - 0.1
    alone = replace(landmarks, covariance_m2=landmarks.joint.own_m2, joint=None)
    assert relative_consistency(alone, fit_to_truth(alone, truth)).nees_per_dof > 5


def test_the_frame_that_a_map_is_in_changes_nothing() -> None:
    landmarks, truth = drawn_map(np.random.default_rng(4))
    other = moved(landmarks, np.array([3.0, -2.0, 2.5]))
    fits = [fit_to_truth(each, truth) for each in (landmarks, other)]
    assert fits[1].rmse_m == pytest.approx(fits[0].rmse_m)
    found = [relative_consistency(*each) for each in zip((landmarks, other), fits, strict=True)]
    for name, value in vars(found[0]).items():
        assert getattr(found[1], name) == pytest.approx(value, rel=1e-6)


def test_gross_landmarks_are_left_out_of_all_figures() -> None:
    landmarks, truth = drawn_map(np.random.default_rng(5))
    position = landmarks.position_m.copy()
    position[[3, 8]] += [[2.0, 1.0, 0.0], [0.0, 0.0, GROSS_M * 2]]
    truth[11] = np.nan
    fit = fit_to_truth(replace(landmarks, position_m=position), truth)
    np.testing.assert_array_equal(fit.rows[fit.gross], [3, 8])
    assert 11 not in fit.rows
    assert fit.gross_share == 2 / 39
    others = truth.copy()
    others[[3, 8]] = np.nan
    alone = fit_to_truth(landmarks, others)
    assert fit.rmse_m == pytest.approx(alone.rmse_m, rel=1e-9)
    spoilt = relative_consistency(replace(landmarks, position_m=position), fit)
    assert spoilt == relative_consistency(landmarks, alone)


def test_a_few_that_are_metres_off_do_not_make_all_others_gross() -> None:
    landmarks, truth = drawn_map(np.random.default_rng(6))
    wrong = [1, 5, 9, 13, 17]
    position = landmarks.position_m.copy()
    position[wrong] += [
        [30.0, 0.0, 0.0],
        [3.0, 0.0, 0.0],
        [3.0, 1.0, 0.0],
        [4.0, 0.0, 0.0],
        [2.0, 0, 0],
    ]
    fit = fit_to_truth(replace(landmarks, position_m=position), truth)
    np.testing.assert_array_equal(fit.rows[fit.gross], wrong)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_of_fewer_landmarks_than_a_fit_needs_nothing_is_known(n: int) -> None:
    landmarks, truth = drawn_map(np.random.default_rng(6), n=n)
    fit = fit_to_truth(landmarks, truth)
    assert len(fit.rows) == n
    assert np.isnan(relative_consistency(landmarks, fit).nees_per_dof)
    assert np.isnan(fit.rmse_m) == (n == 0)


@pytest.mark.parametrize(("n_wrong", "known"), [(4, True), (5, False)])
def test_nothing_is_said_of_a_map_with_too_many_gross_landmarks(n_wrong: int, known: bool) -> None:
    """A tenth of 40 landmarks may be left out."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(-4, 4, (40, 3))
    position = truth + rng.normal(0, 0.01, truth.shape)
    position[:n_wrong, 0] += 2.0
    about = np.tile(1e-4 * np.eye(3), (40, 1, 1)), np.ones(40, np.int32), np.arange(40)
    landmarks = LandmarkMap(position, *about)
    fit = fit_to_truth(landmarks, truth)
    assert fit.gross.sum() == n_wrong
    for figure in (fit.rmse_m, fit.frame_rmse_m, fit.median_m):
        assert (figure < 0.03) if known else figure == np.inf
    assert np.isfinite(relative_consistency(landmarks, fit).coverage_95) == known
