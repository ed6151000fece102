import numpy as np
import pytest
from scipy.spatial.distance import cdist

from mapfusion.align.aligners import as_aligner, make_aligner
from mapfusion.align.alignment import Pairs, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.icp import ClosestPoints, Icp, ImpIcp
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from tests.mapfusion.align.map_pairs import error, given_pairs, landmarks


def closest_points(pair):
    return ClosestPoints(Pairs(pair.map_a, pair.map_b, pair.correspondences))


def slow_icp(p_a, p_b, T, max_rounds):
    """Run ICP with an exhaustive search of all pairs in every round."""
    everyone = np.arange(len(p_b))

    def pair(T):
        return cdist(se2.transform_points(T, p_b), p_a).argmin(axis=1)

    nearest = pair(T)
    for _ in range(max_rounds):
        T = np.array(fit_rigid(p_a[nearest], p_b, everyone))
        before, nearest = nearest, pair(T)
        if np.array_equal(nearest, before):
            return T, nearest, True
    return T, nearest, False


@pytest.mark.parametrize("offset_m", [0.2, 1.0, 5.0])
@pytest.mark.parametrize("max_rounds", [3, 200])
def test_kernel_equals_its_twin(offset_m, max_rounds):
    pair = given_pairs(np.random.default_rng(0), 300, 0.7, 0.05)
    start = pair.T_a_b + np.array([offset_m, -offset_m, 0.1 * offset_m])
    closest = closest_points(pair)
    found = closest.descend(start, max_rounds)
    T, nearest, repeats = slow_icp(pair.map_a.position_m, pair.map_b.position_m, start, max_rounds)
    np.testing.assert_allclose(found.T_a_b, T, atol=1e-9)
    np.testing.assert_array_equal(found.inlier, nearest == np.arange(300))
    assert ("still changed" in found.refusal) == (not repeats)


def test_cost_is_the_summed_square_distance():
    pair = given_pairs(np.random.default_rng(1), 80, 0.5, 0.05)
    cost = closest_points(pair).cost_m2(pair.T_a_b)
    moved = se2.transform_points(pair.T_a_b, pair.map_b.position_m)
    assert cost == pytest.approx(np.sum(cdist(moved, pair.map_a.position_m).min(axis=1) ** 2))


def test_of_several_starts_the_first_with_the_least_cost_is_taken():
    pair, rng = given_pairs(np.random.default_rng(1), 80, 0.5, 0.05), np.random.default_rng(2)
    closest = closest_points(pair)
    for _ in range(20):
        starts = list(pair.T_a_b + rng.normal(0, 0.5, (4, 3)))
        starts.insert(2, starts[int(np.argmin([closest.cost_m2(T) for T in starts]))].copy())
        cost = [closest.cost_m2(T) for T in starts]
        assert closest.nearest_of(starts) is starts[int(np.argmin(cost))]


def test_cost_is_not_summed_up_beyond_what_is_asked():
    pair = given_pairs(np.random.default_rng(1), 80, 0.5, 0.05)
    closest = closest_points(pair)
    cost = closest.cost_m2(pair.T_a_b)
    assert closest.cost_m2(pair.T_a_b, cost) == cost
    assert cost / 2 < closest.cost_m2(pair.T_a_b, cost / 2) < cost


def test_planar_maps_ignore_heights():
    rng = np.random.default_rng(2)
    p = rng.uniform(0, 10, (50, 3))
    other = np.column_stack([p[:, :2], rng.uniform(0, 10, 50)])
    maps = landmarks(p, planar=True), landmarks(other, planar=True)
    nobody = np.empty(0, np.int64)
    closest = ClosestPoints(Pairs(*maps, Correspondences(nobody, nobody, np.empty(0))))
    assert closest.cost_m2(np.zeros(3)) == pytest.approx(0, abs=1e-20)


def share_of_good_answers(name, pair):
    close = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        aligner = make_aligner(name)
        alignment = as_aligner(aligner).align(pair.map_a, pair.map_b, pair.correspondences, rng)
        close += error(alignment.T_a_b, pair.T_a_b)[0] < 0.5
    return close / 60


def test_a_better_start_makes_a_good_answer_more_probable():
    pair = given_pairs(np.random.default_rng(3), 100, 0.6, 0.03)
    # descriptors of true pairs are nearer, as they are in truth
    pair.correspondences.distance[pair.is_true] *= 0.5
    assert share_of_good_answers("impicp", pair) > share_of_good_answers("icp", pair) + 0.2


def test_starts_come_from_the_best_matching():
    """False pairs with large descriptor distances do not affect the start."""
    pair = given_pairs(np.random.default_rng(4), 100, 0.5, 0.02)
    pair.correspondences.distance[:] = np.where(pair.is_true, 0.1, 0.2)
    for seed in range(10):
        alignment = as_aligner(ImpIcp(best_share=0.5)).align(
            pair.map_a, pair.map_b, pair.correspondences, np.random.default_rng(seed)
        )
        assert alignment.status is Status.ACCEPTED
        assert error(alignment.T_a_b, pair.T_a_b)[0] < 0.5


@pytest.mark.parametrize(
    ("aligner", "name", "value"),
    [
        (Icp, "max_rounds", 0),
        (ImpIcp, "max_rounds", 0),
        (ImpIcp, "sets", 0),
        (ImpIcp, "best_share", 0.0),
        (ImpIcp, "best_share", 1.5),
    ],
)
def test_wrong_parameters_are_named(aligner, name, value):
    with pytest.raises(ValueError, match=name):
        aligner(**{name: value})
