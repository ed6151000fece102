"""The helper by which others' methods come to covariance, drift and status."""

import time

import numpy as np
from map_pairs import given_pairs, landmarks

from mapfusion.align.correspondences import Correspondences
from mapfusion.align.pairs import gather
from mapfusion.align.result import Status
from mapfusion.align.rigid import fit_rigid, motion_jacobian
from mapfusion.align.supported import supported_by


def answer(pair, inlier, T_a_b, refusal=""):
    pairs = gather(pair.map_a, pair.map_b, pair.correspondences)
    return supported_by(pairs, inlier, T_a_b, time.perf_counter(), refusal)


def test_covariance_is_that_of_the_normal_equations():
    """Equal, isotropic noise s^2: (J'J)^-1 s^2, s^2 the residuals' own unbiased estimate."""
    pair = given_pairs(np.random.default_rng(0), 4000, 0.5, 0.0, drift_m=0.1, planar=True)
    p_a, p_b = pair.map_a.position_m, pair.map_b.position_m
    T_a_b = np.array(fit_rigid(p_a, p_b, np.flatnonzero(pair.is_true)))
    found = answer(pair, pair.is_true, T_a_b)
    J = motion_jacobian(T_a_b, p_b[pair.is_true]).reshape(-1, 3)
    np.testing.assert_allclose(found.drift_sigma_m, 0.1, rtol=0.05)
    expected = np.linalg.inv(J.T @ J) * found.drift_sigma_m**2
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-3, atol=1e-9)
    assert (found.status, found.reason) == (Status.ACCEPTED, "")
    np.testing.assert_array_equal(found.inlier, pair.is_true)
    np.testing.assert_array_equal(found.T_a_b, T_a_b)


def test_few_supporters_are_a_refusal_that_says_how_many():
    pair = given_pairs(np.random.default_rng(1), 10)
    for n in range(4):
        found = answer(pair, np.arange(10) < n, pair.T_a_b)
        assert (found.status is Status.ACCEPTED) == (n == 3)
        assert n == 3 or found.reason.startswith(f"{n} correspondences")
    assert answer(pair, np.ones(10, bool), pair.T_a_b, "symmetric").reason == "symmetric"


def test_supporters_in_one_place_leave_the_angle_open():
    place = landmarks(np.tile([[3.0, 4.0, 1.0]], (9, 1)))
    pairs = gather(place, place, Correspondences(np.arange(9), np.arange(9), np.zeros(9)))
    found = supported_by(pairs, np.ones(9, bool), np.zeros(3), time.perf_counter())
    assert found.status is Status.DEGENERATE
    assert "one point" in found.reason
