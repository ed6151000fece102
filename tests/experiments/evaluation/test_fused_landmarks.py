"""Fused landmarks and their consistency."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from experiments.evaluation import tables
from experiments.evaluation.fused_landmarks import (
    FusedTeam,
    MergeSettings,
    fused_motion_rows,
    fusion_rows,
    landmark_nees,
    landmark_nees_rows,
    map_fit_rows,
    mean_nees_band,
)
from experiments.evaluation.truth import EvaluatedRobot, MapPair, join_map_pairs
from experiments.pipeline.stages.align import estimate_row, unpacked
from mapfusion.align.alignment import Alignment, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import AlignedPair, FusedMap, Fusion, MergeParameters
from mapfusion.fusion.kalman import KalmanDrift
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.verification.false_alarms import Verdict
from tests.helpers.made_up_maps import (
    ACCEPTED,
    ITERATION,
    NO_RIVALS,
    landmark_map,
    offered,
    paired,
    robot,
)

T_WORLD_A = np.array([1.0, 2.0, 0.3])
T_WORLD_B = np.array([4.0, -1.0, 3.0])
N = 3000
SIGMA_M = 0.02
BY_RANSAC = MergeSettings("ransac", MergeParameters())


def met(
    a: EvaluatedRobot, b: EvaluatedRobot, found: Alignment, verdict: Verdict = ACCEPTED
) -> list[MapPair]:
    """Two maps whose landmarks correspond row by row, all of them inliers of what was found."""
    n = len(found.inlier)
    row = {"robot_a": "A", "robot_b": "B", "iteration": ITERATION, "aligner": "ransac"}
    row |= {"repetition": 0} | estimate_row(n, found, found, verdict)
    pairs = paired(list(range(n)), list(range(n)))
    return join_map_pairs([a, b], pd.DataFrame([row]), offered("A", "B", pairs), NO_RIVALS)


def fused_pairs(drift_sigma_m: float, seed: int = 6) -> pd.DataFrame:
    """Two noisy maps of one world, aligned by the true motion; drift is noise in the plane."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 200, (N, 3))
    drift = drift_sigma_m / np.sqrt(2) * np.array([1, 1, 0])  # half of its variance in each map
    real = np.hypot(SIGMA_M, drift)
    a = robot("A", points, T_WORLD_A, rng.normal(0, real, (N, 3)), SIGMA_M)
    b = robot("B", points, T_WORLD_B, rng.normal(0, real, (N, 3)), SIGMA_M)
    T_true = se2.between(T_WORLD_A, T_WORLD_B)
    found = Alignment(
        T_true,
        1e-12 * np.eye(3),
        np.ones(N, bool),
        0.0,
        Status.ACCEPTED,
        drift_sigma_m=drift_sigma_m,
    )
    return fusion_rows(met(a, b, found), BY_RANSAC, 0.1)


def test_fusing_equal_maps_halves_the_variance() -> None:
    rows = fused_pairs(drift_sigma_m=0.0)
    assert len(rows) == N
    assert rows["true_pair"].all()
    assert (rows["degrees_of_freedom"] == 3).all()
    rms = {name: np.sqrt(np.mean(rows[f"error_{name}_m"] ** 2)) for name in ("a", "b", "fused")}
    # RMS of 3 N normal errors: relative standard deviation 1 / sqrt(6 N) = 0.75 %
    assert rms["a"] == pytest.approx(SIGMA_M * np.sqrt(3), rel=0.03)
    assert rms["b"] == pytest.approx(SIGMA_M * np.sqrt(3), rel=0.03)
    assert rms["fused"] == pytest.approx(SIGMA_M * np.sqrt(3 / 2), rel=0.03)
    # equal parents: the fused landmark lies half way, so never farther off than the worse one
    assert (rows["error_fused_m"] <= rows[["error_a_m", "error_b_m"]].max(axis=1) + 1e-12).all()


def test_nees_is_consistent_with_drift_and_not_without() -> None:
    rows = fused_pairs(drift_sigma_m=0.06)
    # real variance over the landmarks' own in x and y; heights do not drift
    share = (2 * (1 + (0.06 / np.sqrt(2) / SIGMA_M) ** 2) + 1) / 3
    # mean of chi-square(3) / 3 over N: standard deviation sqrt(2 / 3 / N) = 1.5 %
    per_degree = rows[["nees_with_drift", "nees_without_drift"]].mean() / 3
    assert per_degree["nees_with_drift"] == pytest.approx(1, rel=0.06)
    assert per_degree["nees_without_drift"] == pytest.approx(share, rel=0.06)


@pytest.mark.parametrize("planar", [False, True])
def test_fused_landmarks_are_judged_by_the_middle_of_two_truths(planar: bool) -> None:
    """Corners 0.08 m apart, fused half way; their variances (sigma^2 each) halve."""
    points = np.random.default_rng(1).uniform(0, 5, (6, 3)) * [1, 1, 0]
    apart = np.array([0.0, 0.08, 0.0])
    a, b = robot("A", points, np.zeros(3)), robot("B", points + apart, np.zeros(3))
    for one in (a, b):
        one.maps[ITERATION] = replace(one.maps[ITERATION], planar=planar)
    found = Alignment(
        np.zeros(3), np.eye(3), np.ones(6, bool), 0.0, Status.ACCEPTED, drift_sigma_m=0.0
    )
    rows = fusion_rows(met(a, b, found), BY_RANSAC, 0.1)
    assert rows["error_fused_m"].to_numpy() == pytest.approx(0, abs=1e-9)
    assert rows["error_a_m"].to_numpy() == pytest.approx(0.04)
    assert rows["error_b_m"].to_numpy() == pytest.approx(0.04)
    assert rows["nees_with_drift"].to_numpy() == pytest.approx(0, abs=1e-9)
    assert (rows["degrees_of_freedom"] == (2 if planar else 3)).all()


def test_only_accepted_alignments_are_fused() -> None:
    points = np.random.default_rng(1).uniform(0, 5, (6, 3))
    a, b = (robot(name, points, np.zeros(3)) for name in ("A", "B"))
    found = Alignment(
        np.zeros(3), np.eye(3), np.ones(6, bool), 0.0, Status.ACCEPTED, drift_sigma_m=0.0
    )
    for verdict, n, left_out in (
        (ACCEPTED, 6, ()),
        (Verdict(Status.REFUSED, 1.0, "chance does as well"), 6, (("B", "chance does as well"),)),
    ):
        team = FusedTeam.of([a, b], met(a, b, found, verdict), BY_RANSAC)
        fused = team.fused
        assert fused is not None
        assert fused.left_out == left_out
        assert len(fused.landmarks) == n  # fused with B's, or A's alone
        assert (fused.parents[:, 1] == ABSENT).all() == bool(left_out)
        motions = pd.DataFrame(fused_motion_rows(team)).set_index("robot")
        assert motions["left_out"].to_dict() == {"A": "", "B": dict(left_out).get("B", "")}
        assert np.isnan(motions.loc["B", "tx_m"]) == bool(left_out)


def test_truth_of_fused_landmarks_and_fits() -> None:
    points = np.arange(18, dtype=float).reshape(6, 3)
    a, b = robot("A", points[:4], T_WORLD_A), robot("B", points[2:], T_WORLD_B)
    a.points_world_m[ITERATION][1] = np.nan
    parents = np.array([[0, ABSENT], [1, ABSENT], [2, 0], [3, 2], [ABSENT, 3]])
    landmarks = robot("A", np.zeros((5, 3)), np.zeros(3)).maps[ITERATION]
    fused = FusedMap(
        landmarks, parents, np.zeros((2, 3)), np.zeros((2, 3, 3)), np.zeros(2), 0.0, ()
    )
    team = FusedTeam([a, b], [], ITERATION, Fusion((fused,), ()))
    truth = team.truth_of(fused)
    np.testing.assert_array_equal(truth[0], points[0])
    assert np.isnan(truth[1]).all()
    np.testing.assert_array_equal(truth[2], points[2])
    np.testing.assert_array_equal(truth[3], (points[3] + points[4]) / 2)
    np.testing.assert_array_equal(truth[4], points[5])
    rows = pd.DataFrame(map_fit_rows(team)).set_index("map")
    assert rows["n_landmarks"].to_dict() == {"A": 3, "B": 4, "fused": 4}
    assert rows["rmse_m"][["A", "B"]].to_numpy() == pytest.approx(0, abs=1e-9)
    assert list(pd.DataFrame(map_fit_rows(FusedTeam([a], [], ITERATION, None)))["map"]) == ["A"]


@pytest.mark.parametrize(("radius_m", "true"), [(0.079, False), (0.081, True)])
def test_a_pair_is_true_whose_points_lie_within_the_radius(radius_m: float, true: bool) -> None:
    points = np.random.default_rng(1).uniform(0, 5, (6, 3))
    a, b = (
        robot("A", points, np.zeros(3)),
        robot("B", points + np.array([0.0, 0.08, 0.0]), np.zeros(3)),
    )
    found = Alignment(
        np.zeros(3), np.eye(3), np.ones(6, bool), 0.0, Status.ACCEPTED, drift_sigma_m=0.0
    )
    rows = fusion_rows(met(a, b, found), BY_RANSAC, radius_m)
    assert rows["apart_m"].to_numpy() == pytest.approx(0.08)
    assert (rows["true_pair"] == true).all()


PLAN = ["x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2"]


def read(result: Path, name: str) -> pd.DataFrame:
    return tables.read(tables.table_path(result, name), name)


def test_the_last_maps_are_the_landmarks(tiny_result: Path) -> None:
    history, landmarks = read(tiny_result, "map_history"), read(tiny_result, "landmarks")
    assert sorted(history["iteration"].unique()) == [10, 20, 30, 40, 43]
    last = history[history["iteration"] == 43].merge(landmarks, on=["robot", "landmark"])
    assert len(last) == len(landmarks)
    for name in PLAN:
        single = last[f"{name}_y"].to_numpy().astype(np.float32)
        np.testing.assert_array_equal(last[f"{name}_x"].to_numpy(), single)


def test_the_true_pairs_are_as_many_as_the_evaluation_counted(tiny_result: Path) -> None:
    key = ["robot_a", "robot_b", "iteration"]
    errors = read(tiny_result, "errors").groupby(key)[["n_true", "n_correspondences"]].first()
    judged = read(tiny_result, "true_pairs").set_index(key)
    assert len(judged) == len(errors)
    for index, row in judged.iterrows():
        bits = unpacked(row["true_pair"], row["n_correspondences"])
        assert bits.sum() == errors.loc[index, "n_true"]
        assert row["n_correspondences"] == errors.loc[index, "n_correspondences"]


def test_what_inliers_fuse_to_is_in_the_fused_map(tiny_result: Path) -> None:
    """The merge at the end joins these, and with its second pass some more."""
    history, fused = read(tiny_result, "fused_history"), read(tiny_result, "fused")
    last = history[history["iteration"] == 43]
    both = fused[fused["n_parents"] == 2]
    joined = last.merge(both, on=["landmark_a", "landmark_b"])
    assert 0 < len(joined) == len(last) <= len(both)
    np.testing.assert_allclose(joined["x_m_x"], joined["x_m_y"], atol=1e-5)
    np.testing.assert_allclose(joined["cov_yy_m2_x"], joined["cov_yy_m2_y"], rtol=1e-5)


def test_only_accepted_alignments_fuse(tiny_result: Path) -> None:
    estimates = read(tiny_result, "estimates")
    merged = estimates[(estimates["aligner"] == "ransac") & (estimates["repetition"] == 0)]
    accepted = merged[merged["refined_status"] == "accepted"]["iteration"]
    assert set(read(tiny_result, "fused_history")["iteration"]) <= set(accepted)


def test_the_fused_motions_are_those_that_moved_the_landmarks(tiny_result: Path) -> None:
    """A landmark that one robot alone saw lies in the fused map where its motion puts it."""
    fused, landmarks = read(tiny_result, "fused"), read(tiny_result, "landmarks")
    carried = fused[fused["n_parents"] == 1].merge(
        landmarks, left_on=["robot_a", "landmark_a"], right_on=["robot", "landmark"]
    )
    for row in read(tiny_result, "fused_motions").to_dict("records"):
        own = carried[carried["robot"] == row["robot"]]
        T_first_robot = np.array([row["tx_m"], row["ty_m"], row["theta_rad"]])
        moved = se2.transform_points(T_first_robot, own[["x_m_y", "y_m_y", "z_m_y"]].to_numpy())
        np.testing.assert_allclose(moved, own[["x_m_x", "y_m_x", "z_m_x"]], atol=1e-9)
        assert (row["left_out"] == "") == bool(len(own))
        added = [
            own[[f"cov_xx_m2_{side}", f"cov_yy_m2_{side}"]].to_numpy().sum() for side in "xy"
        ]  # a turn changes no trace
        expected = 2 * len(own) * row["drift_sigma_m"] ** 2
        np.testing.assert_allclose(added[0] - added[1], expected, atol=1e-9)


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
