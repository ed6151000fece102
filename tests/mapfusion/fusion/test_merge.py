from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.align.alignment import degenerate
from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import AlignedPair, MergeParameters
from mapfusion.fusion.kalman import Kalman, KalmanDrift
from mapfusion.fusion.landmark_association import ABSENT, one_to_one
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from tests.mapfusion.robots_of_one_world import DRIFT_M, Robots


def test_every_landmark_once():
    robots = Robots([slice(0, 100), slice(60, 160), slice(140, 200)])
    fused = robots.merge()
    points = robots.point_of(fused)
    assert len(np.unique(points)) == len(points) == 200
    for rows, parents in zip(robots.rows, fused.parents.T, strict=True):
        known = parents != ABSENT
        assert sorted(parents[known]) == list(range(len(rows)))  # none lost, none twice
        np.testing.assert_array_equal(rows[parents[known]], points[known])
    # points 140 to 160 are known to robots 1 and 2 only: no alignment speaks of them
    assert np.sum(np.sum(fused.parents != ABSENT, axis=1) == 2) == 60
    assert fused.duplicate_share == 0
    assert fused.left_out == ()


def test_each_map_has_half_of_its_alignments_drift_and_the_first_their_mean():
    """Each map has half the variance of a pair: 0.06 m between two maps is 0.042 m of one."""
    robots = Robots([slice(0, 30)] * 3)
    for k, drift_m in enumerate((0.06, 0.08)):
        robots.alignments[k] = replace(robots.alignments[k], drift_sigma_m=drift_m)
    found = robots.merge().drift_sigma_m
    np.testing.assert_allclose(found, [0.05, 0.06 / 2**0.5, 0.08 / 2**0.5], rtol=1e-12)


def test_order_of_the_sums():
    """Fusing three in a row is the information form of all three."""
    robots = Robots([slice(0, 30)] * 3)
    fused = robots.merge(Kalman())
    total, weighted = np.zeros((30, 3, 3)), np.zeros((30, 3))
    for k in range(3):
        T = fused.T_first_map[k]
        S = se2.transform_covariances(T, robots.maps[k].covariance_m2)[fused.parents[:, k]]
        p = se2.transform_points(T, robots.maps[k].position_m)[fused.parents[:, k]]
        total += np.linalg.inv(S)
        weighted += np.linalg.solve(S, p[:, :, None])[:, :, 0]
    expected = np.linalg.inv(total)
    np.testing.assert_allclose(fused.landmarks.covariance_m2, expected, atol=1e-10)
    np.testing.assert_allclose(
        fused.landmarks.position_m, np.einsum("nij,nj->ni", expected, weighted), atol=1e-7
    )
    counts = sum(robots.maps[k].count[fused.parents[:, k]] for k in range(3))
    np.testing.assert_array_equal(fused.landmarks.count, counts)


def test_unmatched_landmarks_move_with_their_covariance():
    robots = Robots([slice(0, 40), slice(30, 70)])
    fused = robots.merge(Kalman())
    alone = np.flatnonzero(fused.parents[:, 0] == ABSENT)
    source = robots.maps[1][fused.parents[alone, 1]]
    T, c, s = fused.T_first_map[1], *(f(fused.T_first_map[1][2]) for f in (np.cos, np.sin))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(
        fused.landmarks.position_m[alone], source.position_m @ R.T + [T[0], T[1], 0], atol=1e-12
    )
    np.testing.assert_allclose(
        fused.landmarks.covariance_m2[alone], R @ source.covariance_m2 @ R.T, atol=1e-15
    )
    np.testing.assert_array_equal(fused.landmarks.descriptor[alone], source.descriptor)


@pytest.mark.parametrize("fuser", [KalmanDrift(), Kalman()])
def test_drift_makes_the_covariances_honest(fuser):
    robots = Robots([slice(0, 800), slice(200, 1000)])
    fused, use_drift = robots.merge(fuser), isinstance(fuser, KalmanDrift)
    e = robots.errors(fused)
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(fused.landmarks.covariance_m2), e)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 3 * len(e)) / len(e)
    assert (low < nees.mean() < high) == use_drift
    np.testing.assert_allclose(fused.drift_sigma_m, DRIFT_M * use_drift)


def test_fused_landmarks_beat_their_parents():
    robots = Robots([slice(0, 500), slice(0, 500)])
    fused = robots.merge()
    truth = se2.transform_points(se2.inverse(robots.T_world_map[0]), robots.world)
    parents = [
        se2.transform_points(T, m.position_m) - truth[rows]
        for T, m, rows in zip(fused.T_first_map, robots.maps, robots.rows, strict=True)
    ]
    rms = [np.sqrt(np.mean(np.sum(e**2, axis=1))) for e in (robots.errors(fused), *parents)]
    assert rms[0] < 0.85 * np.mean(rms[1:])


def test_alignment_uncertainty_against_monte_carlo():
    """A landmark far from the origin of its map, moved by motions drawn from the covariance."""
    robots = Robots([slice(0, 5), slice(3, 8)], drift_m=0.0)
    T, S_T = robots.alignments[0].T_a_b, robots.alignments[0].covariance
    plain, widened = (
        robots.merge(Kalman(), use_alignment_uncertainty=u).landmarks for u in (False, True)
    )
    fused = robots.merge()
    row = int(np.flatnonzero(fused.parents[:, 0] == ABSENT)[0])
    p_b = robots.maps[1].position_m[fused.parents[row, 1]]
    drawn = np.random.default_rng(0).multivariate_normal(T, S_T, 20_000)
    moved = np.array([se2.transform_points(t, p_b[None])[0, :2] for t in drawn])
    added = (widened.covariance_m2 - plain.covariance_m2)[row]
    np.testing.assert_allclose(added[:2, :2], np.cov(moved.T), rtol=0.1, atol=2e-4)
    assert np.all(added[2] == 0)


def test_second_pass_finds_what_the_alignment_missed():
    robots = Robots([slice(0, 100), slice(0, 100)])
    inlier = np.arange(100) < 70
    robots.alignments[0] = replace(robots.alignments[0], inlier=inlier)
    fused = robots.merge()
    assert len(fused.landmarks) == 100
    assert np.all(fused.parents != ABSENT)


@pytest.mark.parametrize("fuser", [KalmanDrift(), Kalman()])
def test_second_pass_keeps_the_share_its_gate_promises(fuser):
    robots = Robots([slice(0, 1500), slice(0, 1500)])
    robots.alignments[0] = replace(robots.alignments[0], inlier=np.zeros(1500, dtype=bool))
    fused = robots.merge(fuser, gate_probability=0.9)
    # heights keep more than theirs, 0.999: their floor covers errors that these maps do not have
    found = np.mean(np.all(fused.parents != ABSENT, axis=1)[fused.parents[:, 0] != ABSENT])
    assert found == pytest.approx(0.9, abs=0.025)


def test_one_to_one_takes_the_most_alike_first():
    i, j, dissimilarity = (
        np.array([0, 0, 1, 1, 2]),
        np.array([5, 6, 5, 6, 6]),
        np.array([3, 2, 1, 4, 0.5]),
    )
    rows, others = one_to_one(i, j, dissimilarity)
    assert set(zip(rows, others, strict=True)) == {(2, 6), (1, 5)}


def test_fused_landmark_keeps_the_descriptor_seen_more_often():
    robots = Robots([slice(0, 30), slice(0, 30)])
    fused = robots.merge()
    a, b = (m[fused.parents[:, k]] for k, m in enumerate(robots.maps))
    assert np.any(a.count > b.count)
    assert np.any(b.count > a.count)
    expected = np.where((b.count > a.count)[:, None], b.descriptor, a.descriptor)
    np.testing.assert_array_equal(fused.landmarks.descriptor, expected)


@pytest.mark.parametrize("wrong", ["label", "descriptor", "height", "place"])
def test_second_pass_pairs_only_what_may_be_one_point(wrong):
    robots = Robots([slice(0, 50), slice(0, 50)])
    robots.alignments[0] = replace(robots.alignments[0], inlier=np.zeros(50, dtype=bool))
    b = robots.maps[1]
    changed = {
        "label": {"label": np.arange(50, 100, dtype=np.int32)},
        "descriptor": {"descriptor": -b.descriptor},
        "height": {"position_m": b.position_m + np.array([0, 0, 2.0])},
        "place": {"position_m": b.position_m + np.array([3.0, 0, 0])},
    }[wrong]
    robots.maps[1] = replace(b, **changed)
    if wrong == "label":  # equal descriptors do not make up for different labels
        robots.maps[0] = replace(robots.maps[0], label=np.arange(50, dtype=np.int32))
    assert len(robots.merge().landmarks) == 100


def test_duplicates_that_remain_are_counted():
    """A robot that mapped 20 of its 80 points twice: fusing is one to one, so they remain."""
    robots = Robots([slice(0, 80), slice(80, 120)], drift_m=0.01)
    twice = np.concatenate([np.arange(80), np.arange(20)])
    robots.maps[0] = robots.maps[0][twice]
    fused = robots.merge()
    assert len(fused.landmarks) == 140
    assert fused.duplicate_share == pytest.approx(40 / 140)


def test_labels_pair_in_the_second_pass():
    robots = Robots([slice(0, 15), slice(5, 20)], labels=True, planar=True)
    robots.alignments[0] = replace(robots.alignments[0], inlier=np.zeros(10, dtype=bool))
    fused = robots.merge()
    assert sorted(fused.landmarks.label) == list(range(20))
    assert fused.landmarks.descriptor is None


def test_one_label_is_one_landmark_however_distorted_the_maps():
    robots = Robots([slice(0, 15), slice(0, 15)], labels=True, planar=True)
    robots.alignments[0] = replace(robots.alignments[0], inlier=np.zeros(15, dtype=bool))
    b = robots.maps[1]
    robots.maps[1] = replace(b, position_m=b.position_m + np.array([3.0, 0, 0]))
    fused = robots.merge()
    assert sorted(fused.landmarks.label) == list(range(15))


def test_planar_maps_stay_in_the_plane():
    robots = Robots([slice(0, 30), slice(0, 30)], planar=True)
    fused = robots.merge().landmarks
    assert fused.planar
    assert np.all(fused.position_m[:, 2] == 0)
    assert np.all(fused.covariance_m2[:, 2] == 0)


def test_maps_that_did_not_align_are_left_out():
    robots = Robots([slice(0, 50), slice(20, 70), slice(40, 90)])
    n = len(robots.correspondences[0])
    robots.alignments[0] = degenerate("two correspondences only", n)
    fused = robots.merge()
    assert fused.left_out == (("robot 1", "two correspondences only"),)
    assert np.all(fused.parents[:, 1] == ABSENT)
    assert np.isnan(fused.T_first_map[1]).all()
    assert len(fused.landmarks) == 90
    robots.alignments[1] = degenerate("none", len(robots.correspondences[1]))
    assert len(robots.merge().landmarks) == 50


def test_empty_maps_merge():
    robots = Robots([slice(0, 20), slice(0, 20)])
    nothing = np.zeros(0, dtype=np.int64)
    robots.maps[1] = robots.maps[1][nothing]
    robots.correspondences[0] = Correspondences(nothing, nothing, np.zeros(0))
    robots.alignments[0] = replace(robots.alignments[0], inlier=np.zeros(0, dtype=bool))
    assert len(robots.merge().landmarks) == 20
    robots.maps[0] = robots.maps[0][nothing]
    fused = robots.merge()
    assert len(fused.landmarks) == 0
    assert fused.duplicate_share == 0


def test_wrong_arguments_are_named():
    robots = Robots([slice(0, 20), slice(0, 20)])
    maps, alignment, found = robots.maps, robots.alignments[0], robots.correspondences[0]

    def refused(match, *pairs):
        with pytest.raises(ValueError, match=match):
            merge(maps, pairs)

    with pytest.raises(ValueError, match="maps: 1 given"):
        merge(maps[:1], [])
    pair = AlignedPair(0, 1, alignment, found)
    refused(r"pairs\[1\]: 1 and 0 are given twice", pair, replace(pair, a=1, b=0))
    refused(r"pairs\[0\]: 0 and 2 are no two of 2 maps", replace(pair, b=2))
    refused("1 and 1 are no two", replace(pair, a=1))
    short = replace(alignment, inlier=np.ones(3, dtype=bool))
    refused("inlier", replace(pair, alignment=short))
    double = Correspondences(np.zeros(20, np.int64), np.arange(20), np.zeros(20))
    refused("index_a: inliers are not one to one", replace(pair, correspondences=double))
    outside = Correspondences(np.arange(20), np.arange(20) + 1, np.zeros(20))
    refused("index_b: lies outside", replace(pair, correspondences=outside))
    with pytest.raises(ValueError, match="gate_probability"):
        MergeParameters(gate_probability=1.0)
    with pytest.raises(ValueError, match="max_descriptor_distance"):
        MergeParameters(max_descriptor_distance=0.0)


def test_drift_shifts_and_turns_a_map_about_what_was_aligned_in_the_other():
    """s_drift shifts each axis, and turns the map by s_drift over the arm about the pairs' middle.

    The expected covariance comes from numerical derivatives of such a shift and turn.
    """
    robots = Robots([slice(0, 20), slice(10, 30)])
    drift_m, own = 0.3, robots.alignments[0].covariance
    T = robots.alignments[0].T_a_b
    robots.alignments[0] = replace(robots.alignments[0], drift_sigma_m=drift_m)
    p_a = robots.maps[0].position_m[robots.correspondences[0].index_a, :2]
    middle = p_a.mean(axis=0)
    arm_m = np.sqrt(np.mean(np.sum((p_a - middle) ** 2, axis=1)))

    def moved(x: float, y: float, turn: float) -> np.ndarray:
        at = np.array([*middle, 0.0])
        about = se2.compose(se2.compose(at, np.array([x, y, turn])), -at)
        return se2.compose(about, T)

    h = 1e-6
    ways = [moved(*step) - moved(*-step) for step in h * np.diag([1, 1, 1 / arm_m])]
    J = np.array(ways).T / (2 * h)
    found = robots.merge().motion_covariance[1]
    np.testing.assert_allclose(found, own + drift_m**2 * J @ J.T, rtol=1e-6, atol=1e-12)
