from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from experiments.evaluation.alignment_errors import EvaluatedRobot
from experiments.evaluation.fused_landmarks import (
    FusedTeam,
    landmark_nees,
    landmark_nees_rows,
    mean_nees_band,
)
from mapfusion.align.alignment import Alignment, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fused_map import AlignedPair
from mapfusion.fusion.kalman import KalmanDrift
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from tests.helpers.made_up_maps import ITERATION, landmark_map, robot

SIGMA_M = 0.02
T_WORLD_A, T_WORLD_B = np.array([1.0, 2.0, 0.3]), np.array([4.0, -1.0, 3.0])


@pytest.mark.parametrize("planar", [False, True])
def test_consistent_landmarks_are_chi_square(planar: bool) -> None:
    rng = np.random.default_rng(0)
    n, dof = 4000, 2 if planar else 3
    roots = rng.normal(size=(n, 3, 3)) + 2 * np.eye(3)
    covariances = 1e-3 * roots @ np.swapaxes(roots, 1, 2)
    truth = rng.uniform(-9, 9, (n, 3))
    errors = np.sqrt(1e-3) * np.einsum("nij,nj->ni", roots, rng.normal(size=(n, 3)))
    landmarks = landmark_map(truth + errors, planar=planar)
    landmarks.covariance_m2[:] = covariances
    nees = landmark_nees(landmarks, truth)
    slow = [
        e[:dof] @ np.linalg.inv(c[:dof, :dof]) @ e[:dof]
        for e, c in zip(errors, covariances, strict=True)
    ]
    np.testing.assert_allclose(nees, slow, rtol=1e-6)
    low, high = mean_nees_band(n, dof, 0.999)
    assert low < nees.mean() / dof < high
    assert np.mean(nees <= chi2.ppf(0.95, dof)) == pytest.approx(0.95, abs=0.012)  # 3.5 sigma


def test_band_narrows_as_one_over_the_root_of_n() -> None:
    for n, dof in ((10, 2), (1000, 3)):
        low, high = mean_nees_band(n, dof)
        assert low < 1 < high
        assert high - low == pytest.approx(2 * 1.96 * np.sqrt(2 / (n * dof)), rel=0.02)


def merged(a: EvaluatedRobot, b: EvaluatedRobot, pairs: np.ndarray) -> FusedTeam:
    T_a_b = se2.between(T_WORLD_A, T_WORLD_B)
    n = len(pairs)
    found = Alignment(T_a_b, np.eye(3), np.ones(n, bool), 0.0, Status.ACCEPTED, drift_sigma_m=0.0)
    offered = Correspondences(pairs[:, 0], pairs[:, 1], np.zeros(n))
    maps = [a.maps[ITERATION], b.maps[ITERATION]]
    return FusedTeam(
        [a, b], [], ITERATION, merge(maps, [AlignedPair(0, 1, found, offered)], fuser=KalmanDrift())
    )


def two_robots(points_a: Float, points_b: Float) -> tuple[EvaluatedRobot, EvaluatedRobot]:
    rng = np.random.default_rng(1)
    noise_a, noise_b = (SIGMA_M * rng.normal(size=points_a.shape) for _ in range(2))
    a = robot("A", points_a, T_WORLD_A, noise_a, SIGMA_M)
    return a, robot("B", points_b, T_WORLD_B, noise_b, SIGMA_M)


def test_before_and_after_merging_consistent_maps() -> None:
    points = np.random.default_rng(2).uniform(0, 200, (2000, 3))
    # only the first 1200 are common ground
    a, b = two_robots(points, np.where(np.arange(2000)[:, None] < 1200, points, points + 500))
    pairs = np.stack([np.arange(1200)] * 2, axis=1)
    rows = pd.DataFrame(landmark_nees_rows(merged(a, b, pairs), 0.1))
    counts = rows.set_index(["map", "landmarks"])["n_landmarks"].to_dict()
    assert counts == {
        ("A", "own"): 2000,
        ("A", "before fusing"): 1200,
        ("B", "own"): 2000,
        ("B", "before fusing"): 1200,
        ("fused", "fused"): 1200,
        ("fused", "carried over"): 1600,
    }
    assert (rows["degrees_of_freedom"] == 3).all()
    for row in rows.to_dict("records"):
        low, high = mean_nees_band(row["n_landmarks"], 3, 0.999)
        assert low < row["nees_mean"] / 3 < high
        assert row["share_in_gate"] == pytest.approx(0.95, abs=0.03)


def test_false_pairs_have_no_truth_and_unknown_landmarks_no_nees() -> None:
    points = np.random.default_rng(3).uniform(0, 50, (6, 3))
    elsewhere = points.copy()
    elsewhere[0] += 0.5  # fused all the same, as a false pair
    a, b = two_robots(points, elsewhere)
    a.points_world_m[ITERATION] = points.copy()
    a.points_world_m[ITERATION][1] = np.nan
    team = merged(a, b, np.stack([np.arange(4)] * 2, axis=1))
    rows = pd.DataFrame(landmark_nees_rows(team, 0.1))
    counts = rows.set_index(["map", "landmarks"])["n_landmarks"].to_dict()
    assert counts[("fused", "fused")] == counts[("A", "before fusing")] == 2
    assert counts[("A", "own")] == 5


def test_one_robot_alone() -> None:
    a, _ = two_robots(np.zeros((0, 3)), np.zeros((0, 3)))
    rows = landmark_nees_rows(FusedTeam([a], [], ITERATION, None), 0.1)
    assert [(row["landmarks"], row["n_landmarks"]) for row in rows] == [("own", 0)]


@pytest.mark.parametrize(("planar", "dof"), [(True, 2), (False, 3)])
def test_a_map_s_nees_worked_out_by_hand(planar: bool, dof: int) -> None:
    """The NEES are 0, 1, 4, 6.5 and 20; the 95 % gate is 5.99 with 2 degrees, 7.81 with 3."""
    squares = np.array([0.0, 1.0, 4.0, 6.5, 20.0])
    points = np.random.default_rng(4).uniform(0, 9, (5, 3)) * [1, 1, not planar]
    off = SIGMA_M * np.sqrt(squares)[:, None] * [0.6, -0.8, 0.0]
    a = robot("A", points, T_WORLD_A, off, SIGMA_M)
    a.maps[ITERATION] = replace(a.maps[ITERATION], planar=planar)
    (row,) = landmark_nees_rows(FusedTeam([a], [], ITERATION, None), 0.1)
    assert (row["n_landmarks"], row["degrees_of_freedom"]) == (5, dof)
    assert row["nees_mean"] == pytest.approx(31.5 / 5)
    assert row["nees_median"] == pytest.approx(4.0)
    assert row["share_in_gate"] == pytest.approx((3 if planar else 4) / 5)
