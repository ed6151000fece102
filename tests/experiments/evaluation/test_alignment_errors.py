"""Errors and times of alignments."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from experiments.evaluation.alignment_errors import (
    alignment_nees,
    error_rows,
    first_shared_iteration,
)
from experiments.evaluation.path_errors import robot_paths
from experiments.evaluation.truth import EvaluatedRobot, PathTruth, join_map_pairs
from experiments.pipeline.stages.align import alignment_of, estimate_row, unpacked
from mapfusion.align.alignment import Alignment, Status, degenerate
from mapfusion.geometry import se2
from mapfusion.verification.false_alarms import Verdict
from mapfusion.verification.verdict import Verifier
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
POINTS = np.random.default_rng(5).uniform(0, 6, (12, 3))


def judged(estimated: Alignment, refined: Alignment, index_b: list[int]) -> pd.DataFrame:
    """Error rows of one estimate on two perfect maps; landmark i of a is paired to index_b[i]."""
    pairs = paired(list(range(len(index_b))), index_b)
    names = {"robot_a": "A", "robot_b": "B", "iteration": ITERATION}
    row = names | {"aligner": "ransac", "repetition": 0}
    estimates = pd.DataFrame([row | estimate_row(len(pairs), estimated, refined, ACCEPTED)])
    a, b = robot("A", POINTS, T_WORLD_A), robot("B", POINTS, T_WORLD_B)
    (met,) = join_map_pairs([a, b], estimates, offered("A", "B", pairs), NO_RIVALS)
    return error_rows(met, Verifier(), 0.1).set_index("aligner")


def alignment(T_a_b: np.ndarray, inlier: list[bool]) -> Alignment:
    return Alignment(T_a_b, np.diag([0.01, 0.04, 0.0025]), np.array(inlier), 0.0, Status.ACCEPTED)


def test_errors_of_a_known_estimate() -> None:
    T_true = se2.compose(se2.inverse(T_WORLD_A), T_WORLD_B)
    estimated = T_true + np.array([0.3, -0.4, 0.05])
    refined = T_true + np.array([0.1, 0.0, -0.05])
    estimated[2] += 2 * np.pi  # the same rotation
    # ten pairs; the last two are false
    rows = judged(
        alignment(estimated, [False] * 10),
        alignment(refined, [True] * 6 + [False] * 3 + [True]),
        [*range(8), 9, 8],
    )
    row = rows.loc["ransac"]
    assert row["translation_error_m"] == pytest.approx(0.5)
    assert row["rotation_error_rad"] == pytest.approx(0.05)  # estimate minus truth
    assert row["refined_translation_error_m"] == pytest.approx(0.1)
    assert row["refined_rotation_error_rad"] == pytest.approx(-0.05)
    assert row["n_true"] == 8
    assert row["n_common"] == 12
    assert row["n_inliers"] == 7
    assert row["precision"] == pytest.approx(6 / 7)
    assert row["recall"] == pytest.approx(6 / 8)
    assert row["alignment_nees"] == pytest.approx(0.1**2 / 0.01 + 0.05**2 / 0.0025)
    assert row["oracle_distance_m"] == pytest.approx(0.1, abs=1e-6)
    assert row["oracle_distance_rad"] == pytest.approx(0.05, abs=1e-6)


def test_the_oracle_recovers_perfect_maps() -> None:
    failed = degenerate("no idea", 12)
    rows = judged(failed, failed, [*range(10), 11, 10])
    oracle = rows.loc["oracle"]
    assert oracle["refined_translation_error_m"] == pytest.approx(0, abs=1e-9)
    assert oracle["refined_rotation_error_rad"] == pytest.approx(0, abs=1e-9)
    assert oracle["precision"] == oracle["recall"] == 1
    assert oracle["n_true"] == 10


def test_a_failed_alignment_is_a_row() -> None:
    failed = degenerate("no idea", 12)
    row = judged(failed, failed, list(range(12))).loc["ransac"]
    assert row["status"] == "degenerate"
    assert row["reason"] == "no idea"
    assert np.isnan(row["translation_error_m"])
    assert np.isnan(row["alignment_nees"])
    assert np.isnan(row["precision"])
    assert row["recall"] == 0


def test_rotation_error_wraps() -> None:
    T_true = se2.compose(se2.inverse(T_WORLD_A), T_WORLD_B)
    for turn in (3.0, -3.0):
        turned = alignment(T_true + np.array([0, 0, turn]), [True] * 12)
        row = judged(turned, turned, list(range(12))).loc["ransac"]
        assert row["rotation_error_rad"] == pytest.approx(turn)
        assert row["refined_rotation_error_rad"] == pytest.approx(turn)


def test_an_alignment_survives_its_row() -> None:
    rng = np.random.default_rng(1)
    square = rng.normal(size=(3, 3))
    inlier = rng.random(13) < 0.5
    refined = Alignment(
        rng.normal(size=3), square @ square.T, inlier, 0.1, Status.REFUSED, "a reason", 0.2
    )
    row = estimate_row(
        13, degenerate("other", 13), refined, Verdict(Status.REFUSED, np.nan, "a reason")
    )
    found = alignment_of(row, 13)
    np.testing.assert_array_equal(found.T_a_b, refined.T_a_b)
    np.testing.assert_allclose(found.covariance, refined.covariance, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.inlier, inlier)
    assert (found.status, found.reason) == (Status.REFUSED, "a reason")
    assert found.drift_sigma_m == 0.2
    assert not unpacked(row["inliers"], 13).any()


def test_a_refused_alignment_is_refused_when_read_again() -> None:
    accepted = alignment(np.array([1.0, 2.0, 0.3]), [True] * 4)
    row = estimate_row(4, accepted, accepted, Verdict(Status.REFUSED, 1.5, "chance does as well"))
    assert (row["refined_status"], row["accepted"], row["log10_false_alarms"]) == (
        "accepted",
        False,
        1.5,
    )
    found = alignment_of(row, 4)
    assert (found.status, found.reason) == (Status.REFUSED, "chance does as well")


def test_alignment_nees_follows_its_law() -> None:
    """Errors drawn from the covariance: chi-square, 3 degrees of freedom, headings near pi."""
    rng = np.random.default_rng(3)
    square = rng.normal(size=(3, 3)) * [1, 1, 0.1]
    covariance = square.T @ square
    T_true = np.array([5.0, -3.0, np.pi - 0.01])
    drawn = rng.multivariate_normal(T_true, covariance, 4000)
    drawn[:, 2] = se2.wrap(drawn[:, 2])
    nees = np.array([alignment_nees(T, covariance, T_true) for T in drawn])
    # mean of n draws: 3 with a standard deviation of sqrt(6 / n)
    assert np.mean(nees) == pytest.approx(3, abs=4 * np.sqrt(6 / len(nees)))
    for probability in (0.5, 0.9, 0.99):
        share = np.mean(nees <= chi2.ppf(probability, 3))
        sigma = np.sqrt(probability * (1 - probability) / len(nees))
        assert share == pytest.approx(probability, abs=4 * sigma)


def test_alignment_nees_leaves_its_arguments_alone() -> None:
    T, T_true = np.array([0.0, 0.0, 7.0]), np.zeros(3)
    alignment_nees(T, np.eye(3), T_true)
    assert T.tolist() == [0, 0, 7]
    assert np.isnan(alignment_nees(np.full(3, np.nan), np.eye(3), T_true))
    assert np.isnan(alignment_nees(T, np.full((3, 3), np.nan), T_true))


def test_a_robot_whose_log_ended_keeps_its_last_map() -> None:
    early, late = robot("A", POINTS[:3], T_WORLD_A), robot("A", POINTS[:5], T_WORLD_A)
    both = EvaluatedRobot(
        "A",
        {5: early.maps[ITERATION], 9: late.maps[ITERATION]},
        {5: POINTS[:3], 9: POINTS[:5]},
        early.path,
    )
    assert [len(both.at(k)[0]) for k in (1, 5, 8, 9, 100)] == [3, 3, 3, 5, 5]
    assert [len(both.at(k)[1]) for k in (1, 5, 8, 9, 100)] == [3, 3, 3, 5, 5]


def test_paths_and_their_errors() -> None:
    """A square of 1 m; odometry turns 0.1 rad too far at one corner, 0.2 too little at another."""
    quarter = np.pi / 2
    turns = quarter + 0.1, quarter, quarter - 0.2
    odometry = np.array([[0, 0, 0], *([1, 0, turn] for turn in turns)])
    truth = np.array([[0, 0, 0], [1, 0, quarter], [1, 1, 2 * quarter], [0, 1, 3 * quarter]])
    poses = pd.DataFrame({"iteration": range(4)})
    for i, name in enumerate(("x_m", "y_m", "theta_rad")):
        poses[f"final_{name}"] = truth[:, i]
        poses[f"online_{name}"] = truth[:, i] + (0.3, 0.3, 2 * np.pi)[i]
    for name in ("effective_sample_size", "resampled", "n_landmarks", "spread_m"):
        poses[name] = 1
    rows = robot_paths(poses, odometry, PathTruth(truth, np.zeros(3)))
    dead_reckoned = rows[["odometry_x_m", "odometry_y_m"]].to_numpy()
    turn = quarter + 0.1
    expected = [[0, 0], [1, 0], [1 + np.cos(turn), np.sin(turn)]]
    np.testing.assert_allclose(dead_reckoned[:3], expected, atol=1e-12)
    np.testing.assert_array_equal(rows["final_x_m"], truth[:, 0])
    np.testing.assert_allclose(rows["path_error_m"], np.hypot(0.3, 0.3))
    np.testing.assert_allclose(rows["path_error_rad"], 0, atol=1e-12)  # a whole turn is none
    np.testing.assert_allclose(rows["odometry_error_rad"], [0, 0.1, 0.1, -0.1], atol=1e-12)
    assert rows["odometry_error_m"].iloc[2] == pytest.approx(2 * np.sin(0.05))  # a chord


RADIUS_M = 0.1
WORLD = np.random.default_rng(0).uniform(0, 20, (40, 3))  # no two within the radius


def seeing(name: str, by_iteration: dict[int, list[int]], off_m: float = 0.0) -> EvaluatedRobot:
    """A robot that has these points of the world in its maps, each off by so much along x."""
    points = {k: WORLD[rows] + [off_m, 0, 0] for k, rows in by_iteration.items()}
    maps = {k: landmark_map(own, name) for k, own in points.items()}
    return EvaluatedRobot(name, maps, points, PathTruth(np.zeros((1, 3)), np.zeros(3)))


def first(*robots: EvaluatedRobot) -> int | None:
    return first_shared_iteration(robots, RADIUS_M)


def test_three_common_landmarks_of_any_two_are_shared_ground() -> None:
    a = seeing("R1", {10: [0, 1], 20: [0, 1, 2, 3], 30: [0, 1, 2, 3]})
    b = seeing("R2", {10: [0, 1], 20: [2, 3, 8, 9], 30: [1, 2, 3, 8]})
    assert first(a, b) == 30  # two are too few
    c = seeing("R3", {10: [9], 20: [2, 8, 9], 30: [9]})
    assert first(a, b, c) == 20  # R2 and R3, whatever is later
    assert first(c, b, a) == 20


def test_points_beside_each_other_are_not_one() -> None:
    a, rows = seeing("R1", {10: [0, 1, 2], 20: [0, 1, 2]}), {10: [0, 1, 2], 20: [0, 1, 2]}
    assert first(a, seeing("R2", rows, 0.9 * RADIUS_M)) == 10
    assert first(a, seeing("R2", rows, 1.1 * RADIUS_M)) is None


def test_a_robot_whose_log_has_ended_keeps_its_map() -> None:
    a = seeing("R1", {10: [0, 1, 2]})
    b = seeing("R2", {10: [5, 6, 7], 20: [5, 6, 7], 30: [0, 1, 2]})
    assert first(a, b) == 30
