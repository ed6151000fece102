from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from mapfusion.align.alignment import Pairs, Status
from mapfusion.align.covariance import drift_step
from mapfusion.align.mahalanobis_gate import PlanarPairs
from mapfusion.align.refinement import Refinement, maximise_likelihood
from mapfusion.align.rigid_motion import residual_covariances, residuals
from mapfusion.geometry import se2
from mapfusion.geometry.se2 import motion_jacobian
from tests.mapfusion.align.map_pairs import error, given_pairs, stretched


def slow_iterate(pairs, T, gate_m, least_drift_m, rounds, variance=None, share=0.5):
    """Run expectation maximisation with matrix products and full steps."""
    variance = (gate_m / 3) ** 2 if variance is None else variance
    for _ in range(rounds):
        e = residuals(T, pairs.p_a, pairs.p_b)
        S = residual_covariances(T, pairs.covariance_a, pairs.covariance_b)
        C = S + variance * np.eye(2)
        judged = S + max(variance, least_drift_m**2) * np.eye(2)
        square = np.einsum("ni,nij,nj->n", e, np.linalg.inv(judged), e)
        true = share * np.exp(-square / 2) / (2 * np.pi * np.sqrt(np.linalg.det(judged)))
        inside = np.hypot(*e.T) <= gate_m
        truth = np.where(inside, true / (true + (1 - share) / (np.pi * gate_m**2)), 0)
        W = truth[:, None, None] * np.linalg.inv(C)
        J = motion_jacobian(T, pairs.p_b)
        normal = np.einsum("nki,nkl,nlj->ij", J, W, J)
        step = np.linalg.solve(normal, np.einsum("nki,nkl,nl->i", J, W, e))
        Wj = np.linalg.inv(judged)
        pull, turn = (
            np.einsum("nki,nkl,nl->ni", J, weight, e) for weight in (np.linalg.inv(C), Wj)
        )
        missing = np.einsum("n,ni,nj->ij", truth * (1 - truth), pull, turn)
        information = normal - (missing + missing.T) / 2
        share = truth.sum() / (inside.sum() + 1)
        variance = min(drift_step(e, S, truth, variance, gate_m), (gate_m / 3) ** 2)
        T = T + step
    return T, np.linalg.inv(information), variance, truth


def offered(rng, n, true_share, drift_m, sigma_m=0.04):
    pair = given_pairs(rng, n, true_share, sigma_m, drift_m)
    return pair, (pair.map_a, pair.map_b, pair.correspondences)


@pytest.mark.parametrize("rounds", [1, 2, 30])
def test_kernel_equals_its_twin(rounds):
    rng = np.random.default_rng(0)
    pair, (map_a, map_b, c) = offered(rng, 80, 0.5, 0.1)
    map_a = replace(map_a, covariance_m2=map_b.covariance_m2)
    pairs = Pairs(stretched(rng, map_a), stretched(rng, map_b), c)
    start = pair.T_a_b + np.array([0.1, -0.05, 0.005])
    solved, _, T, covariance, variance, truth, _ = maximise_likelihood(
        pairs.in_plan(), start, 0.5, 0.06, rounds
    )
    twin = slow_iterate(pairs, start, 0.5, 0.06, rounds)
    assert solved
    for ours, theirs in zip((T, covariance, variance, truth), twin, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-10)


def test_pairs_that_come_within_the_gate_on_the_way_count():
    """The initial rotation moves most pairs out of the gate."""
    rng = np.random.default_rng(13)
    pair, maps = offered(rng, 200, 0.7, 0.05)
    pairs = Pairs(*maps)
    middle = pairs.p_b[:, :2].mean(axis=0)[None]
    start = pair.T_a_b + np.array([0.0, 0.0, 0.15])
    away = se2.transform_points(pair.T_a_b, middle) - se2.transform_points(start, middle)
    start[:2] += away[0]
    off = np.hypot(*residuals(start, pairs.p_a, pairs.p_b).T)
    assert np.mean(off < 0.7) < 0.5
    solved, _, T, covariance, variance, truth, _ = maximise_likelihood(
        pairs.in_plan(), start, 0.5, 0.1, 60
    )
    assert solved
    assert error(T, pair.T_a_b)[0] < 0.05
    for ours, theirs in zip(
        (T, covariance, variance, truth), slow_iterate(pairs, start, 0.5, 0.1, 60), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("seed", [12, 192, 0])
def test_few_pairs_far_surer_than_the_rest_do_not_swing_it(seed):
    """With full steps of s_drift seeds 12 and 192 oscillate between two results."""
    rng = np.random.default_rng(seed)
    n, T_a_b = 60, np.array([1.0, 2.0, 0.5])
    p_b = rng.uniform(-5, 5, (n, 2))
    sigma, n_sure = np.full(n, 0.03), rng.integers(2, 8)
    sigma[:n_sure] = 1e-4 * 10 ** rng.uniform(0, 1.5, n_sure)
    p_a = p_b @ se2.rotation(0.5).T + T_a_b[:2] + rng.normal(size=(n, 2)) * sigma[:, None]
    p_a[:n_sure] += rng.normal(size=(n_sure, 2)) * 0.008
    S = np.eye(2) * (sigma**2 / 2)[:, None, None]
    start = T_a_b + np.array([0.05, 0.05, 0.01])
    solved, moved_m, T, _, variance, truth, _ = maximise_likelihood(
        PlanarPairs(p_a, p_b, S, S), start, 0.5, 0.1, 100
    )
    assert solved
    assert moved_m < 1e-8
    pairs = SimpleNamespace(p_a=p_a, p_b=p_b, covariance_a=S, covariance_b=S)
    share = truth.sum() / (n + 1)
    again, _, variance_again, _ = slow_iterate(pairs, T, 0.5, 0.1, 1, variance, share)
    np.testing.assert_allclose(again, T, atol=1e-7)
    assert variance_again == pytest.approx(variance, rel=1e-3, abs=1e-10)


def test_answer_is_where_the_likelihood_is_flat():
    """Isotropic weights do not depend on theta, so that the fixed point is a maximum."""
    pair, maps = offered(np.random.default_rng(1), 150, 0.4, 0.1)
    refinement = Refinement(gate_m=0.5, least_drift_m=0.0)
    found = refinement.refine(Pairs(*maps), pair.T_a_b)
    pairs = Pairs(*maps)
    e = residuals(found.T_a_b, pairs.p_a, pairs.p_b)
    variance = 0.04**2 + found.drift_sigma_m**2
    candidates = pairs.of_one_height(refinement.height)
    e = e[candidates]
    inside = np.hypot(*e.T) < 0.5
    # the share at the fixed point, by bisection: the mean probability, one false pair added
    density = np.exp(-np.sum(e[inside] ** 2, axis=1) / (2 * variance)) / (2 * np.pi * variance)
    uniform = 1 / (np.pi * 0.25)
    low, high = 0.0, 1.0
    for _ in range(60):
        share = (low + high) / 2
        truth = share * density / (share * density + (1 - share) * uniform)
        mean = truth.sum() / (len(truth) + 1)
        low, high = (share, high) if mean > share else (low, share)

    def log_likelihood(T):
        r = residuals(T, pairs.p_a, pairs.p_b)[candidates][inside]
        true = np.exp(-np.sum(r**2, axis=1) / (2 * variance)) / (2 * np.pi * variance)
        return np.sum(np.log(share * true + (1 - share) * uniform))

    sigma = np.sqrt(np.diag(found.covariance))
    top = log_likelihood(found.T_a_b)
    for step in np.eye(3) * sigma * 0.1:
        plus, minus = log_likelihood(found.T_a_b + step), log_likelihood(found.T_a_b - step)
        assert max(plus, minus) < top
        # the maximum of the parabola through the three lies where we are
        assert abs((plus - minus) / (2 * (2 * top - plus - minus))) < 1e-3


def test_error_falls_with_the_root_of_the_number_of_pairs():
    rmse = []
    sizes = (25, 100, 400)
    for n in sizes:
        squares = []
        for seed in range(80):
            pair, maps = offered(np.random.default_rng(seed), n, 1.0, 0.1)
            found = Refinement().refine(Pairs(*maps), pair.T_a_b)
            centre = pair.map_b.position_m.mean(axis=0)[None]
            squares.append(
                np.sum(
                    (
                        se2.transform_points(found.T_a_b, centre)
                        - se2.transform_points(pair.T_a_b, centre)
                    )
                    ** 2
                )
            )
        rmse.append(np.sqrt(np.mean(squares)))
    slope = np.polyfit(np.log(sizes), np.log(rmse), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.08)


@pytest.mark.parametrize("drift_m", [0.0, 0.1])
def test_covariance_covers_the_error(drift_m):
    """The mean NEES is 3 with anisotropic covariances and 40 % false pairs."""
    nees, drifts = [], []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        pair = given_pairs(rng, 150, 0.6, 0.0)
        map_b = stretched(
            rng, replace(pair.map_b, covariance_m2=np.tile(np.eye(3) * 4e-4, (150, 1, 1)))
        )
        noise = np.linalg.cholesky(map_b.covariance_m2) @ rng.standard_normal((150, 3, 1))
        noise[:, :2] += rng.normal(0, drift_m, (150, 2, 1))
        map_b = replace(map_b, position_m=map_b.position_m + noise[:, :, 0])
        found = Refinement().refine(Pairs(pair.map_a, map_b, pair.correspondences), pair.T_a_b)
        assert found.status is Status.ACCEPTED
        difference = found.T_a_b - pair.T_a_b
        difference[2] = se2.wrap(difference[2])
        nees.append(difference @ np.linalg.solve(found.covariance, difference))
        drifts.append(found.drift_sigma_m)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 3 * 400) / 400
    assert low < np.mean(nees) < high * 1.05  # covariances are estimated, which widens the tail
    assert np.median(drifts) == pytest.approx(drift_m, abs=0.01)


@pytest.mark.parametrize(
    ("n", "n_true", "drift_m"),
    [(150, 150, 0.1), (150, 90, 0.15), (1000, 50, 0.1), (20, 20, 0.1), (5000, 50, 0.1)],
)
def test_covariance_covers_the_error_among_planar_outliers(n, n_true, drift_m):
    """The normalised squared error of 3 parameters, also where it is open which pairs are true.

    With s_drift from nu = 2 n_true - 3 numbers it has Fisher's distribution, not chi-square's.
    """
    nees = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        pair = given_pairs(rng, n, n_true / n, 0.05, drift_m, planar=True)
        found = Refinement().refine(Pairs(pair.map_a, pair.map_b, pair.correspondences), pair.T_a_b)
        assert found.status is Status.ACCEPTED
        difference = found.T_a_b - pair.T_a_b
        difference[2] = se2.wrap(difference[2])
        nees.append(difference @ np.linalg.solve(found.covariance, difference) / 3)
    mean, variance = f_distribution.stats(3, 2 * n_true - 3)
    band = 4 * np.sqrt(variance / 300)
    assert mean - band < np.mean(nees) < mean + band
    within = np.mean(np.array(nees) < f_distribution.ppf(0.95, 3, 2 * n_true - 3))
    assert within > 0.95 - 4 * np.sqrt(0.95 * 0.05 / 300)


def test_a_part_that_moved_as_one_is_not_taken_for_false():
    """A fifth of the true pairs is displaced by 0.3 m; all initial estimates give one result."""
    pair, (map_a, map_b, c) = offered(np.random.default_rng(9), 300, 1.0, 0.02, 0.01)
    aside = map_b.position_m[:, 0] > np.quantile(map_b.position_m[:, 0], 0.8)
    map_b = replace(map_b, position_m=map_b.position_m + 0.3 * aside[:, None] * np.array([0, 1, 0]))
    starts = pair.T_a_b + np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0, -0.2, 0]])
    first, *others = (Refinement().refine(Pairs(map_a, map_b, c), T_a_b) for T_a_b in starts)
    assert np.all(first.inlier)
    for other in others:
        assert error(other.T_a_b, first.T_a_b) == pytest.approx((0, 0), abs=1e-6)
    sure_of_little_drift = Refinement(least_drift_m=0.0)
    answers = [sure_of_little_drift.refine(Pairs(map_a, map_b, c), T_a_b) for T_a_b in starts]
    assert not all(np.all(answer.inlier) for answer in answers)


def test_a_false_pair_inside_the_gate_does_not_move_precise_maps():
    """The two sides of a thin wall look alike; a few landmarks are far more precise than others."""
    pair, (map_a, map_b, c) = offered(np.random.default_rng(11), 50, 1.0, 0.0, 0.02)
    p_b, covariance_m2 = map_b.position_m.copy(), map_b.covariance_m2.copy()
    p_b[:5] = se2.transform_points(se2.inverse(pair.T_a_b), map_a.position_m[:5])
    covariance_m2[:5] /= 100
    p_b[0, :2] += [0.2, 0.0]
    map_b = replace(map_b, position_m=p_b, covariance_m2=covariance_m2)
    pairs = Pairs(map_a, map_b, c)
    found = Refinement().refine(pairs, pair.T_a_b)
    without = Refinement().refine(pairs[np.arange(1, 50)], pair.T_a_b)
    assert not found.inlier[0]
    assert np.count_nonzero(found.inlier) > 45
    assert error(found.T_a_b, without.T_a_b) == pytest.approx((0, 0), abs=1e-3)


def test_drift_is_at_most_what_false_pairs_over_the_gate_would_look_like():
    """Uniform residuals over the gate fit any s_drift; its limit is a third of the gate."""
    rng = np.random.default_rng(10)
    pair = given_pairs(rng, 400, planar=True)
    angle, radius = rng.uniform(0, 2 * np.pi, 400), 0.5 * np.sqrt(rng.uniform(0, 1, 400))
    aside = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(400)], -1)
    pairs = Pairs(
        pair.map_a,
        replace(pair.map_b, position_m=pair.map_b.position_m + aside),
        pair.correspondences,
    )
    found = Refinement(gate_m=0.5).refine(pairs, pair.T_a_b)
    assert found.drift_sigma_m == pytest.approx(0.5 / 3)


def test_a_whole_turn_more_makes_no_difference():
    pair, maps = offered(np.random.default_rng(11), 50, 1.0, 0.0)
    for turns in (-1, 0, 1):
        found = Refinement().refine(Pairs(*maps), pair.T_a_b + np.array([0, 0, turns * 2 * np.pi]))
        assert found.T_a_b[2] == pytest.approx(pair.T_a_b[2], abs=0.01)
        assert found.ok


def test_stays_local():
    pair, maps = offered(np.random.default_rng(2), 100, 1.0, 0.0)
    far = Refinement(gate_m=0.5).refine(Pairs(*maps), pair.T_a_b + np.array([5.0, 0, 0]))
    assert far.status is not Status.ACCEPTED or error(far.T_a_b, pair.T_a_b)[0] > 3


def test_heights_decide_unless_planar():
    pair, (map_a, map_b, c) = offered(np.random.default_rng(3), 50, 1.0, 0.0)
    lifted = replace(map_b, position_m=map_b.position_m + np.array([0, 0, 3.0]))
    assert Refinement().refine(Pairs(map_a, lifted, c), pair.T_a_b).status is Status.DEGENERATE
    flat = [replace(m, planar=True) for m in (map_a, lifted)]
    assert Refinement().refine(Pairs(*flat, c), pair.T_a_b).ok


def test_no_estimate_to_refine():
    _, maps = offered(np.random.default_rng(4), 50, 1.0, 0.0)
    found = Refinement().refine(Pairs(*maps), np.full(3, np.nan))
    assert found.status is Status.DEGENERATE
    assert "no estimate" in found.reason


def test_a_refinement_that_still_moves_is_refused():
    pair, maps = offered(np.random.default_rng(5), 50, 0.6, 0.1)
    found = Refinement(max_rounds=2).refine(Pairs(*maps), pair.T_a_b + np.array([0.2, 0.2, 0.01]))
    assert found.status is Status.REFUSED
    assert "moved" in found.reason


def test_wrong_arguments_are_named():
    _, maps = offered(np.random.default_rng(6), 5, 1.0, 0.0)
    with pytest.raises(ValueError, match="T_a_b"):
        Refinement().refine(Pairs(*maps), np.zeros(2))
    with pytest.raises(ValueError, match="gate_m"):
        Refinement(gate_m=0.0)
    with pytest.raises(ValueError, match="least_drift_m"):
        Refinement(least_drift_m=-0.1)
    with pytest.raises(ValueError, match="max_rounds"):
        Refinement(max_rounds=0)


@pytest.mark.parametrize("off_m", [0.0, 0.1])
def test_covariance_of_exact_maps_is_that_of_least_squares(off_m):
    """The motion of exact maps is found at once; s_drift must leave its start all the same."""
    pair, (map_a, map_b, c) = offered(np.random.default_rng(7), 60, 1.0, 0.0, sigma_m=0.0)
    stated = np.tile(0.02**2 * np.eye(3), (60, 1, 1))
    map_a, map_b = (replace(each, covariance_m2=stated) for each in (map_a, map_b))
    pairs = Pairs(map_a, map_b, c)
    found = Refinement().refine(pairs, pair.T_a_b + np.array([off_m, 0.0, 0.0]))
    S = residual_covariances(pair.T_a_b, pairs.covariance_a, pairs.covariance_b)
    J = motion_jacobian(pair.T_a_b, pairs.p_b)
    least_squares = np.linalg.inv(np.sum(np.swapaxes(J, 1, 2) @ np.linalg.inv(S) @ J, axis=0))
    np.testing.assert_allclose(found.T_a_b, pair.T_a_b, atol=1e-8)
    # a pair inside the gate is false with a small probability
    np.testing.assert_allclose(found.covariance, least_squares, rtol=0.02)
    assert found.drift_sigma_m < 1e-3


def test_labels_with_covariances_larger_than_the_gate_all_count():
    """An uncertain start turns a map as a whole: covariances are large, residuals are small."""
    rng = np.random.default_rng(3)
    pair = given_pairs(rng, 15, 1.0, 0.04, 0.0, planar=True)
    names = np.arange(15, dtype=np.int32)
    a, b = (
        replace(each, label=names, covariance_m2=each.covariance_m2 + s**2 * np.eye(3))
        for each, s in ((pair.map_a, 0.8), (pair.map_b, 0.3))
    )
    refined = Refinement().refine(Pairs(a, b, pair.correspondences), pair.T_a_b)
    assert refined.inlier.all()
    assert error(refined.T_a_b, pair.T_a_b)[0] < 0.1
