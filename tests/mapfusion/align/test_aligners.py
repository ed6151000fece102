"""Properties of every aligner."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.aligners import ALIGNERS, as_aligner, make_aligner
from mapfusion.align.alignment import Pairs, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.refinement import Oracle, Refinement
from mapfusion.align.svd import Svd
from mapfusion.geometry import se2
from tests.mapfusion.align.map_pairs import (
    MapPair,
    error,
    given_pairs,
    landmarks,
    motion,
    moved,
    swapped,
)

NAMES = list(ALIGNERS)
NAMED = {name: make_aligner(name) for name in NAMES} | {"svd solved": Svd("solved")}


def estimate(name, pair, seed=0):
    """Align by name; "refined" is RANSAC with refinement, "oracle" receives the true pairs."""
    maps = pair.map_a, pair.map_b, pair.correspondences
    if name == "oracle":
        return Oracle().align(Pairs(*maps), pair.is_true)
    if name == "refined":
        return Refinement().refine(Pairs(*maps), estimate("ransac", pair, seed).T_a_b)
    return as_aligner(NAMED[name]).align(*maps, np.random.default_rng(seed))


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("name", [*NAMED, "refined", "oracle"])
def test_exact_without_noise(name, planar):
    pair = given_pairs(np.random.default_rng(0), 60, planar=planar)
    found = estimate(name, pair)
    assert found.status is Status.ACCEPTED
    assert found.reason == ""
    assert found.inlier.all()
    assert error(found.T_a_b, pair.T_a_b) == pytest.approx((0, 0), abs=1e-9)


@pytest.mark.parametrize(
    ("name", "true_share", "sigma_m"),
    [
        ("ransac", 0.4, 0.05),
        ("refined", 0.4, 0.05),
        ("oracle", 0.4, 0.05),
        # noise on one side, or a pairing from one side, is not the same from the other
        *[(name, 1.0, 0.0) for name in NAMED if name != "ransac"],
    ],
)
def test_exchanged_maps_give_the_inverse(name, true_share, sigma_m):
    pair = given_pairs(np.random.default_rng(1), 100, true_share, sigma_m)
    there, back = estimate(name, pair), estimate(name, swapped(pair))
    np.testing.assert_array_equal(there.inlier, back.inlier)
    assert error(se2.inverse(back.T_a_b), there.T_a_b) == pytest.approx((0, 0), abs=2e-7)


@pytest.mark.parametrize("name", [*NAMED, "refined", "oracle"])
def test_follows_the_frames_of_the_maps(name):
    rng = np.random.default_rng(2)
    pair = given_pairs(rng, 100, 0.6, 0.05)
    T_u_a, T_v_b = motion(rng), motion(rng)
    if name == "svd":  # as printed it follows map b's turns only: see test_svd
        T_v_b[:2] = 0
    other = replace(pair, map_a=moved(pair.map_a, T_u_a), map_b=moved(pair.map_b, T_v_b))
    found, found_other = estimate(name, pair), estimate(name, other)
    expected = se2.compose(se2.compose(T_u_a, found.T_a_b), se2.inverse(T_v_b))
    np.testing.assert_array_equal(found.inlier, found_other.inlier)
    assert error(found_other.T_a_b, expected) == pytest.approx((0, 0), abs=2e-6)


@pytest.mark.parametrize("name", [*NAMED, "refined", "oracle"])
def test_order_of_pairs_and_landmarks_does_not_matter(name):
    rng = np.random.default_rng(3)
    pair = given_pairs(rng, 80, 0.9, 0.02)
    rows, to_a, to_b = (rng.permutation(80) for _ in range(3))
    c = pair.correspondences
    shuffled = replace(
        pair,
        map_a=pair.map_a[to_a],
        map_b=pair.map_b[to_b],
        correspondences=Correspondences(
            np.argsort(to_a)[c.index_a[rows]],
            np.argsort(to_b)[c.index_b[rows]],
            c.distance[rows],
        ),
        is_true=pair.is_true[rows],
    )
    # draws differ with the order: the methods that start from one are given a few
    good = [
        (first, second)
        for first, second in (
            (estimate(name, pair, s), estimate(name, shuffled, s)) for s in range(12)
        )
        if error(first.T_a_b, second.T_a_b) == pytest.approx((0, 0), abs=1e-6)
    ]
    assert len(good) >= (3 if "icp" in name else 12)
    for first, second in good:
        np.testing.assert_array_equal(first.inlier[rows], second.inlier)


def pairs_of(n):
    return Correspondences(np.arange(n), np.arange(n), np.zeros(n))


def described(p, name):
    n = len(p)
    return replace(landmarks(p, name=name), descriptor=np.zeros((n, 64), np.float32))


def degenerate_inputs():
    rng = np.random.default_rng(4)
    p = rng.uniform(0, 10, (40, 3))
    place = np.tile([[3.0, 4.0, 1.0]], (40, 1))
    empty = described(np.zeros((0, 3)), "south")
    bare = landmarks(p, name="south")
    full = described(p, "north")
    return {
        "no pairs": (full, full, 0, "0 correspondences"),
        "one pair": (full, full, 1, "1 correspondences"),
        "two pairs": (full, full, 2, ""),
        "coincident": (described(place, "north"), described(place, "south"), 40, ""),
        "coincident with noise": (
            described(place + rng.normal(0, 0.01, (40, 3)), "north"),
            described(place + rng.normal(0, 0.01, (40, 3)), "south"),
            40,
            "",
        ),
        "no descriptors": (full, bare, 0, "0 correspondences"),
        "empty a": (empty, full, 0, "map south is empty"),
        "empty b": (full, empty, 0, "map south is empty"),
        "both empty": (empty, empty, 0, "is empty"),
    }


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", [*NAMED, "oracle"])
@pytest.mark.parametrize("case", degenerate_inputs())
def test_degenerate_input_is_a_status(name, case):
    map_a, map_b, n, reason = degenerate_inputs()[case]
    pair = MapPair(map_a, map_b, np.zeros(3), pairs_of(n), np.ones(n, dtype=bool))
    found = estimate(name, pair)
    refined = Refinement().refine(Pairs(map_a, map_b, pairs_of(n)), found.T_a_b)
    for alignment in (found, refined):
        assert alignment.status is not Status.ACCEPTED
        assert alignment.reason
        assert alignment.inlier.shape == (n,)
        is_nan = bool(np.isnan(alignment.T_a_b).any())
        assert is_nan == (alignment.status is Status.DEGENERATE)
    assert reason in found.reason


@pytest.mark.parametrize("name", [*NAMED, "oracle"])
def test_index_outside_its_map_is_named(name):
    full = landmarks(np.zeros((5, 3)))
    for wrong, pairs in (
        ("index_a", Correspondences(np.array([0, 5]), np.array([0, 1]), np.zeros(2))),
        ("index_b", Correspondences(np.array([0, 1]), np.array([-1, 1]), np.zeros(2))),
    ):
        with pytest.raises(ValueError, match=wrong):
            estimate(name, MapPair(full, full, np.zeros(3), pairs, np.ones(2, dtype=bool)))


def test_oracle_asks_for_one_mark_a_pair():
    full = landmarks(np.zeros((5, 3)))
    with pytest.raises(ValueError, match="is_true"):
        Oracle().align(Pairs(full, full, pairs_of(5)), np.ones(4, dtype=bool))


def test_oracle_ignores_false_pairs():
    pair = given_pairs(np.random.default_rng(5), 200, 0.3, 0.05)
    half = pair.is_true & (np.arange(200) % 2 == 0)  # true pairs, too, that it is not told of
    found = estimate("oracle", replace(pair, is_true=half))
    np.testing.assert_array_equal(found.inlier, half)
    assert error(found.T_a_b, pair.T_a_b)[0] < 0.05


def test_oracle_starts_from_the_true_pairs_alone():
    """False pairs agree on a motion 10 m away; a fit to all pairs would be out of the gate."""
    pair = given_pairs(np.random.default_rng(6), 100)
    position, is_true = pair.map_b.position_m.copy(), np.arange(100) < 40
    position[~is_true, :2] += [8.0, -6.0]
    shifted = replace(pair, map_b=replace(pair.map_b, position_m=position), is_true=is_true)
    found = estimate("oracle", shifted)
    assert found.status is Status.ACCEPTED
    assert error(found.T_a_b, pair.T_a_b) == pytest.approx((0, 0), abs=1e-9)


def test_true_pairs_outside_the_gate_are_no_inliers_of_the_oracle():
    """Three true pairs have residuals of metres because of drift."""
    pair = given_pairs(np.random.default_rng(7), 60)
    far = np.array([3, 10, 41])
    position = pair.map_b.position_m.copy()
    position[far, :2] += [[5.0, 0.0], [0.0, -4.0], [3.0, 3.0]]
    drifted = replace(pair, map_b=replace(pair.map_b, position_m=position))
    found = estimate("oracle", drifted)
    np.testing.assert_array_equal(np.flatnonzero(~found.inlier), far)
    assert error(found.T_a_b, pair.T_a_b) == pytest.approx((0, 0), abs=1e-6)


def test_unknown_names_and_parameters():
    with pytest.raises(ValueError, match="unknown aligner 'ransack', known are ransac, svd, icp"):
        make_aligner("ransack")
    with pytest.raises(ValueError, match=r"ransac.*gate_mm"):
        make_aligner("ransac", gate_mm=3)
    with pytest.raises(ValueError, match=r"ransac.*floor"):
        make_aligner("ransac", height={"floor": 3})
    made = make_aligner("ransac", gate_m=0.2, height={"floor_m": 0.1})
    assert (made.gate_m, made.height.floor_m, made.height.probability) == (0.2, 0.1, 0.999)
