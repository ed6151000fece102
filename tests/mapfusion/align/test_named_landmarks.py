"""Chance for known identities: against counting, and what is evidence by itself."""

import math

import numpy as np
import pytest
from scipy.stats import binom

from mapfusion.align.aligners import make_aligner
from mapfusion.align.alignment import Status
from mapfusion.align.correspondences import match
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from mapfusion.registration import Registration
from mapfusion.verification.false_alarms import Acceptance, named_false_alarms

GATES_M = np.array(sorted(Acceptance().gates_m))
T_A_B = np.array([1.0, -2.0, 0.7])


def named_map(p: np.ndarray, name: str) -> LandmarkMap:
    n = len(p)
    position = np.column_stack([p, np.zeros(n)])
    covariance = np.tile(np.diag([1e-4, 1e-4, 0.0]), (n, 1, 1))
    counts, labels = np.full(n, 5, np.int32), np.arange(n, dtype=np.int32)
    return LandmarkMap(position, covariance, counts, np.arange(n), None, labels, True, name)


def test_it_is_what_the_formula_says() -> None:
    rng = np.random.default_rng(0)
    p_a = rng.uniform(0, [12, 8], (10, 2))
    noise = np.zeros((10, 2))
    noise[7:] = 3.0
    p_b = se2.transform_points(se2.inverse(T_A_B), p_a + noise)
    log10, gate_m, n, k = named_false_alarms(p_a, p_b, T_A_B, GATES_M)
    assert (gate_m, n, k) == (0.05, 10, 7)
    width, depth = np.ptp(p_a, axis=0) + 0.1
    tail = binom.sf(4, 8, math.pi * 0.05**2 / (width * depth))
    assert log10 == pytest.approx(math.log10(5 * 90 / 42 * tail))


def test_namesakes_may_be_twice_as_far_off_as_the_widest_gate() -> None:
    """The pairs are 0.6 m off: outside the widest gate of 0.4 m, inside twice that gate."""
    rng = np.random.default_rng(4)
    p_a, way = rng.uniform(0, [40, 30], (10, 2)), rng.uniform(-np.pi, np.pi, 10)
    off = np.array([0.01, 0.01] + [0.6] * 6 + [0.81, 5.0])
    moved = p_a + off[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    p_b = se2.transform_points(se2.inverse(T_A_B), moved)
    log10, gate_m, n, k = named_false_alarms(p_a, p_b, T_A_B, GATES_M)
    assert (gate_m, n, k) == (2 * GATES_M[-1], 10, 8)
    width, depth = np.ptp(p_a, axis=0) + 2 * gate_m
    tail = binom.sf(5, 8, math.pi * gate_m**2 / (width * depth))
    assert log10 == pytest.approx(math.log10(5 * 90 / 56 * tail))


@pytest.mark.parametrize(("sigma_m", "accepted"), [(0.01, True), (1.5, False)])
def test_three_namesakes_that_agree_are_evidence(sigma_m: float, accepted: bool) -> None:
    rng = np.random.default_rng(1)
    p_a = np.array([[0.0, 0.0], [12.0, 1.0], [5.0, 9.0]])
    p_b = se2.transform_points(se2.inverse(T_A_B), p_a + rng.normal(0, sigma_m, (3, 2)))
    a, b = named_map(p_a, "a"), named_map(p_b, "b")
    done = Registration(make_aligner("clique")).register(a, b, match(a, b), rng)
    assert (done.verdict.status is Status.ACCEPTED) == accepted


def test_maps_that_are_wrong_have_no_more_false_alarms_than_stated() -> None:
    """Namesakes anywhere on the same ground: every motion of two of them, judged."""
    rng, bound, n_maps, accepted = np.random.default_rng(2), 0.1, 200, 0
    for _ in range(n_maps):
        p_a, p_b = rng.uniform(0, 10, (2, 8, 2))
        best = math.inf
        for i in range(8):
            for j in range(i):
                turn = math.atan2(*(p_a[i] - p_a[j])[::-1]) - math.atan2(*(p_b[i] - p_b[j])[::-1])
                middle = se2.rotation(turn) @ (p_b[i] + p_b[j]) / 2
                T = np.array([*((p_a[i] + p_a[j]) / 2 - middle), turn])
                best = min(best, named_false_alarms(p_a, p_b, T, GATES_M)[0])
        accepted += best <= math.log10(bound)
    assert accepted / n_maps <= bound + 3 * math.sqrt(bound / n_maps)


def test_maps_that_are_bent_are_fitted_by_all_that_has_a_name() -> None:
    """One half of each map is turned aside: a gate would lay the larger half on its like alone."""
    rng = np.random.default_rng(3)
    p_a = rng.uniform(0, [12, 8], (11, 2))
    bent = p_a.copy()
    bent[:4] += [1.2, 0.0]
    p_b = se2.transform_points(se2.inverse(T_A_B), bent)
    a, b = named_map(p_a, "a"), named_map(p_b, "b")
    done = Registration(make_aligner("ransac")).register(a, b, match(a, b), rng)
    every = np.arange(11)
    T_all = np.array(fit_rigid(p_a, np.ascontiguousarray(p_b), every))
    assert done.refined.inlier.all()
    np.testing.assert_allclose(done.refined.T_a_b, T_all, atol=0.02)


def test_one_name_that_was_misread_is_left_out() -> None:
    rng = np.random.default_rng(4)
    p_a = rng.uniform(0, [12, 8], (15, 2))
    moved = p_a + rng.normal(0, 0.05, (15, 2))
    moved[5] += [6.0, 3.0]
    p_b = se2.transform_points(se2.inverse(T_A_B), moved)
    a, b = named_map(p_a, "a"), named_map(p_b, "b")
    done = Registration(make_aligner("ransac")).register(a, b, match(a, b), rng)
    assert np.flatnonzero(~done.refined.inlier).tolist() == [5]
    np.testing.assert_allclose(done.refined.T_a_b, T_A_B, atol=0.15)
