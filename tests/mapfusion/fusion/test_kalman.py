"""Fusion of two landmarks (eq. 12 to 14) against its information form."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapfusion.fusion.fusers import MergeParameters
from mapfusion.fusion.kalman import KalmanAsPrinted
from mapfusion.fusion.kalman import kalman_update as fuse
from mapfusion.fusion.kalman import kalman_update_as_printed as fuse_as_printed
from mapfusion.fusion.merge import merge
from tests.mapfusion.align.map_pairs import covariances
from tests.mapfusion.fusion.drawn_maps import DrawnTeam


def pairs_to_fuse(seed=0, n=50):
    rng = np.random.default_rng(seed)
    L_i, L_j = rng.uniform(-5, 5, (2, n, 3))
    return L_i, covariances(rng, n), L_j, covariances(rng, n)


def test_fusion_equals_the_information_form():
    L_i, S_i, L_j, S_j = pairs_to_fuse()
    W_i, W_j = np.linalg.inv(S_i), np.linalg.inv(S_j)
    expected = np.linalg.inv(W_i + W_j)
    weighted = (W_i @ L_i[:, :, None] + W_j @ L_j[:, :, None])[:, :, 0]
    position, covariance = fuse(L_i, S_i, L_j, S_j)
    np.testing.assert_allclose(covariance, expected, atol=1e-12)
    np.testing.assert_allclose(
        position, np.einsum("nij,nj->ni", expected, weighted), rtol=1e-9, atol=1e-9
    )


def test_fused_covariance_is_below_both_parents():
    _, S_i, _, S_j = pairs = pairs_to_fuse(1)
    _, covariance = fuse(*pairs)
    for parent in (S_i, S_j):
        assert np.linalg.eigvalsh(parent - covariance).min() > -1e-15


def test_fusion_does_not_care_who_is_first():
    L_i, S_i, L_j, S_j = pairs_to_fuse(2)
    for ours, other in zip(fuse(L_i, S_i, L_j, S_j), fuse(L_j, S_j, L_i, S_i), strict=True):
        np.testing.assert_allclose(ours, other, atol=1e-12)


def test_printed_form_is_eq_12_to_14_letter_by_letter():
    L_i, S_i, L_j, S_j = pairs = pairs_to_fuse(4)
    K = S_i @ np.linalg.inv(S_i + S_j)
    position, covariance = fuse_as_printed(*pairs)
    expected = L_i + np.einsum("nij,nj->ni", K, L_i - L_j)
    np.testing.assert_allclose(position, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(covariance, (np.eye(3) - K) @ S_i, atol=1e-12)


def test_printed_form_errs_more_than_either_parent_and_states_less():
    """Eq. 13 as printed has the error (I + K) e_i - K e_j, of covariance 5/2 S if S_i = S_j = S."""
    rng = np.random.default_rng(5)
    S = np.tile(np.diag([0.04, 0.01, 0.09]), (20_000, 1, 1))
    L_i, L_j = rng.standard_normal((2, len(S), 3)) * np.sqrt(np.diagonal(S[0]))
    position, covariance = fuse_as_printed(L_i, S, L_j, S)
    np.testing.assert_allclose(np.cov(position.T), 2.5 * S[0], atol=0.05 * 2.5 * 0.09)
    np.testing.assert_allclose(covariance, S / 2, atol=1e-12)


@pytest.mark.parametrize(("form", "holds"), [(fuse, True), (fuse_as_printed, False)])
def test_round_landmarks_meet_between_their_parents(form, holds):
    L_i, _, L_j, _ = pairs_to_fuse(3)
    rng = np.random.default_rng(3)
    s_i, s_j = rng.uniform(0.01, 1, (2, len(L_i), 1, 1))
    position, _ = form(L_i, s_i * np.eye(3), L_j, s_j * np.eye(3))
    along = np.einsum("ni,ni->n", position - L_i, L_j - L_i) / np.sum((L_j - L_i) ** 2, axis=1)
    between = np.all((along > 0) & (along < 1))
    on_line = np.allclose(L_i + along[:, None] * (L_j - L_i), position, atol=1e-9)
    assert (between and on_line) == holds


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_round_landmarks_share_by_their_certainty(s_i, s_j):
    position, covariance = fuse(
        np.zeros((1, 3)), s_i * np.eye(3)[None], np.ones((1, 3)), s_j * np.eye(3)[None]
    )
    assert position[0] == pytest.approx(s_i / (s_i + s_j))
    assert covariance[0] == pytest.approx(np.eye(3) * s_i * s_j / (s_i + s_j))


@pytest.mark.parametrize(("shrink", "told"), [(1.0, ""), (1e-20, "are not positive definite")])
def test_covariances_that_rounding_makes_singular_are_reported(shrink, told):
    """Beside a covariance 20 decades smaller, K rounds to I, and eq. 14 to zero."""
    team = DrawnTeam([slice(0, 20), slice(0, 20)], 0)
    first, second = (replace(own, joint=None) for own in team.maps)
    second = replace(second, covariance_m2=second.covariance_m2 * shrink)
    (fused,) = merge([first, second], team.pairs, MergeParameters(), KalmanAsPrinted()).fused
    assert told in fused.fallback
    assert bool(fused.fallback) == bool(told)
