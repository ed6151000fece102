"""Tests of `experiments.evaluation.map_errors`."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from experiments.evaluation import tables
from experiments.evaluation.map_consistency import fit_to_truth, relative_consistency
from experiments.evaluation.map_errors import (
    FILTERED,
    FUSED,
    NOMINAL_COVERAGES,
    SMOOTHED,
    EvaluatedFusion,
    GivenMap,
    SmoothedRobot,
    alignment_nees,
    coverage_rows,
    error_rows,
    first_shared_iteration,
    smoothed_path_rows,
)
from experiments.evaluation.path_errors import robot_paths
from experiments.evaluation.result import run_scenario
from experiments.evaluation.truth import EvaluatedRobot, PathTruth, join_map_pairs
from experiments.pipeline.stages import smooth
from experiments.pipeline.stages.align import alignment_of, estimate_row, unpacked
from experiments.reports.report.document import write_report
from experiments.reports.run_screen import print_result
from experiments.scenario.loading import load_scenario
from mapfusion.align.alignment import Alignment, Status, degenerate
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Verdict
from mapfusion.verification.verdict import Verifier
from tests.experiments.evaluation.evaluated_teams import (
    BENT_M,
    PARTS,
    K,
    evaluated_robots,
    evaluated_team,
)
from tests.helpers.made_up_maps import (
    ACCEPTED,
    ITERATION,
    NO_RIVALS,
    landmark_map,
    offered,
    paired,
    robot,
)
from tests.helpers.made_up_maps import robot as made_up_robot
from tests.mapfusion.fusion.drawn_maps import DrawnTeam


def coverage(fusions: Sequence[EvaluatedFusion]) -> pd.DataFrame:
    return tables.as_table("fuser_coverage", coverage_rows(fusions))


def counted(landmarks: LandmarkMap, truth: np.ndarray, d: int = 3) -> np.ndarray:
    """Probabilities (n,) of the smallest ellipses that hold the true points."""
    off, S = (landmarks.position_m - truth)[:, :d], landmarks.covariance_m2[:, :d, :d]
    squared = [e @ np.linalg.solve(own, e) for e, own in zip(off, S, strict=True)]
    return chi2.cdf(squared, d)


@pytest.mark.parametrize("planar", [False, True])
def test_shares_are_those_of_landmarks_counted_one_by_one(planar: bool) -> None:
    """Before fusing those of all robots together, not the mean of their shares."""
    team = DrawnTeam(PARTS, 1, planar, BENT_M)
    judged = evaluated_team(team)
    rows, d = coverage([judged]), 2 if planar else 3
    needed = np.concatenate([counted(own, team.truth(k), d) for k, own in enumerate(team.maps)])
    before = rows[rows["map"] == FILTERED].set_index("nominal")
    assert (before["n_landmarks"] == len(needed)).all()
    assert before["frame_coverage"].to_dict() == {
        p: np.mean(needed <= p) for p in NOMINAL_COVERAGES
    }
    after, row = rows[rows["map"] == FUSED].set_index("nominal"), judged.row()
    assert after.loc[0.95, "coverage"] == row["coverage_95"]
    assert after.loc[0.95, "frame_coverage"] == row["frame_coverage_95"]
    assert (after["fuser"] == "joint").all()
    assert (before["fuser"] == "").all()


def test_maps_that_are_as_sure_as_they_may_be_keep_to_the_diagonal() -> None:
    fusions = [evaluated_team(DrawnTeam(PARTS, seed, bent_m=BENT_M)) for seed in range(30)]
    rows = pd.concat([coverage([each]) for each in fusions])
    for of, own in rows.groupby("map"):
        mean = own.groupby("nominal")[["coverage", "frame_coverage"]].mean()
        assert mean.sub(mean.index, axis=0).abs().to_numpy().max() < 0.05, of


def test_gross_landmarks_are_left_out() -> None:
    team = DrawnTeam(PARTS, 2, bent_m=BENT_M)
    team.pairs = []
    whole = coverage([evaluated_team(team)]).set_index(["map", "nominal"])
    position = team.maps[0].position_m.copy()
    position[:4] += 0.4
    team.maps[0] = replace(team.maps[0], position_m=position)
    rows = coverage([evaluated_team(team)]).set_index(["map", "nominal"])
    lost = whole["n_landmarks"] - rows["n_landmarks"]
    assert (lost == 4).all()
    assert rows.loc[(FUSED, 0.99), "coverage"] > 0.9


def test_smoothed_maps_stand_beside_the_filters_and_only_the_end_counts() -> None:
    team = DrawnTeam(PARTS, 3, bent_m=BENT_M)
    judged = evaluated_team(team)
    rough = [replace(own, covariance_m2=own.covariance_m2 / 100, joint=None) for own in team.maps]
    given = [
        GivenMap(robot, own.landmarks, own.points_world_m, worse, own.of_filter_world_m)
        for robot, own, worse in zip(evaluated_robots(team), judged.given, rough, strict=True)
    ]
    end = replace(judged, given=given)
    rows = coverage([replace(judged, iteration=K - 1), end, replace(end, fuser="other")])
    assert rows[["map", "fuser"]].drop_duplicates().to_numpy().tolist() == [
        [FILTERED, ""],
        [SMOOTHED, ""],
        [FUSED, "joint"],
        [FUSED, "other"],
    ]
    assert (rows["iteration"] == K).all()
    at = rows[rows["nominal"] == 0.9].set_index("map")["coverage"]
    assert at[SMOOTHED] > 0.8
    assert at[FILTERED] < 0.3


def test_where_nothing_was_fused_or_no_truth_is_known_there_are_no_rows() -> None:
    team = DrawnTeam(PARTS, 4, bent_m=BENT_M)
    team.world_m[:] = np.nan
    assert coverage([evaluated_team(team)]).empty
    assert coverage([]).empty


def _fitted_errors(position: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Lengths after the rigid fit in the plane, by the singular values (Umeyama 1991)."""
    p, q = position - position.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(q[:, :2].T @ p[:, :2])
    R = (U @ np.diag([1, np.linalg.det(U @ Vt)]) @ Vt).T
    plane = p[:, :2] - q[:, :2] @ R.T
    return np.linalg.norm(np.column_stack([plane, position[:, 2] - truth[:, 2]]), axis=1)


def test_figures_are_those_of_the_landmarks_one_by_one() -> None:
    team = DrawnTeam(PARTS, 1, bent_m=BENT_M)
    judged = evaluated_team(team)
    row, fused = judged.row(), judged.fusion
    truth = np.full((len(fused.landmarks), 3), np.nan)
    for k, part in enumerate(team.parts):
        has = fused.parents[:, k] != ABSENT
        truth[has] = team.world_m[part][fused.parents[has, k]]
    truth = se2.transform_points(se2.inverse(team.T_world_map[0]), truth)
    off = np.linalg.norm(fused.landmarks.position_m - truth, axis=1)
    errors = _fitted_errors(fused.landmarks.position_m, truth)
    assert errors.max() < 0.15  # none is gross
    assert row["landmark_rmse_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)
    assert row["fitted_rmse_m"] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-6)
    assert row["fitted_median_m"] == pytest.approx(np.median(errors), rel=1e-6)
    assert (row["gross_share"], row["n_robots"], row["fuser"]) == (0.0, 3, "joint")
    assert row["fallback"] == ""
    ratios = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        both = np.all(fused.parents[:, [a, b]] != ABSENT, axis=1)
        rms = [np.sqrt(np.mean(errors[both] ** 2))]
        for k in (a, b):
            own = _fitted_errors(team.maps[k].position_m, team.truth(k))
            rms.append(np.sqrt(np.mean(own[fused.parents[both, k]] ** 2)))
        ratios.append(rms[0] / min(rms[1:]))
    assert row["over_better_parent"] == pytest.approx(np.median(ratios), rel=1e-6)
    assert row["over_better_filter"] == row["over_better_parent"]  # it was given the filter's maps
    nees = []
    for k in (1, 2):
        T = fused.T_first_map[k] - se2.between(team.T_world_map[0], team.T_world_map[k])
        T[2] = se2.wrap(T[2])
        nees.append(T @ np.linalg.solve(fused.motion_covariance[k], T) / 3)
    assert row["alignment_nees_per_dof"] == pytest.approx(np.median(nees))
    stated = [fused.motion_covariance[k] for k in (1, 2)]
    sigma_m = np.median([np.sqrt(S[0, 0] + S[1, 1]) for S in stated])
    assert row["alignment_sigma_m"] == pytest.approx(sigma_m)
    assert row["alignment_sigma_rad"] == pytest.approx(np.median([S[2, 2] ** 0.5 for S in stated]))


def test_over_the_filter_is_of_the_same_landmarks_in_the_filter_s_maps() -> None:
    """Maps given are half as far off as the filter's, which lists its landmarks backwards."""
    team = DrawnTeam(PARTS, 2, bent_m=BENT_M)
    filters = evaluated_robots(team)
    rough = []
    for k, mapped in enumerate(filters):
        own, points = mapped.at(K)
        worse = team.truth(k) + 2 * (own.position_m - team.truth(k))
        backwards = np.arange(len(own))[::-1]
        rough_map = type(own)(
            worse, own.covariance_m2, own.count, own.source_observation, own.descriptor
        )[backwards]
        rough.append(
            EvaluatedRobot(mapped.name, {K: rough_map}, {K: points[backwards]}, mapped.path)
        )
    fused = merge(team.maps, team.pairs).fused[0]
    given = []
    for mapped, good in zip(rough, filters, strict=True):
        smoothed = SmoothedRobot(
            mapped, np.zeros((1, 3)), good.maps, good.points_world_m, {}, {}, {"not_smoothed": ""}
        )
        given.append(GivenMap.at(mapped, smoothed, K))
    row = EvaluatedFusion("joint", K, fused, given).row()
    assert row["over_better_filter"] == pytest.approx(row["over_better_parent"] / 2, rel=0.1)


def test_a_map_of_one_robot_has_no_parents_to_be_better_than() -> None:
    team = DrawnTeam(PARTS, 3, bent_m=BENT_M)
    team.pairs = []
    row = evaluated_team(team).row()
    assert np.isnan([row["over_better_parent"], row["alignment_nees_per_dof"]]).all()
    assert row["n_robots"] == 1


def test_motions_are_judged_by_the_median_robot_and_across_the_half_turn() -> None:
    """Three maps are off by 0.1, 0.2 and 0.9 m, and by 0.01, 0.02 and 0.3 rad."""
    team = DrawnTeam([slice(0, 20)] * 4, 5, bent_m=BENT_M)
    team.T_world_map[:, 2] = [3.1, -3.1, 0.5, -0.4]
    fused = evaluated_team(team).fusion
    sigma = np.diag([0.1, 0.1, 0.01]) ** 2
    T = np.array([se2.between(team.T_world_map[0], own) for own in team.T_world_map])
    T[1:, 0] += [0.1, -0.2, 0.9]
    T[1:, 2] += [0.01 + 2 * np.pi, -0.02, 0.3]
    fused = replace(fused, T_first_map=T, motion_covariance=np.tile(sigma, (4, 1, 1)))
    given = [GivenMap.at(robot, None, K) for robot in evaluated_robots(team)]
    row = EvaluatedFusion("joint", K, fused, given).row()
    assert row["alignment_error_m"] == pytest.approx(0.2)
    assert row["alignment_error_rad"] == pytest.approx(0.02)
    assert row["alignment_nees_per_dof"] == pytest.approx((4 + 4) / 3)  # 2, 8 and 981 over 3


def test_a_fused_map_is_held_against_the_truth_in_its_own_frame() -> None:
    """The first robot met nobody, so the map is in the frame of the second."""
    team = DrawnTeam(PARTS, 6, bent_m=BENT_M)
    team.pairs = [pair for pair in team.pairs if 0 not in (pair.a, pair.b)]
    judged = evaluated_team(team)
    assert judged.fusion.members.tolist() == [1, 2]
    assert judged.row()["landmark_rmse_m"] < 0.1


POINTS = np.random.default_rng(0).uniform(-4, 4, (30, 3))
WORLD = np.array([1.0, 2.0, 0.5])
ENDING = {
    "n_steps": 4,
    "observation_dof": 9.0,
    "offset_dof": 5.0,
    "observation_level": 1.0,
    "not_smoothed": "",
}


def smoothed_robot() -> SmoothedRobot:
    """The filter errs by 0.04 m along its path, the smoother by 0.01 m; landmarks alike."""
    rng = np.random.default_rng(1)
    owner = made_up_robot("R1", POINTS, WORLD, 0.03 * rng.standard_normal((30, 3)))
    truth = owner.in_map_frame(POINTS)
    landmarks = landmark_map(truth + 0.01 * rng.standard_normal((30, 3)), "R1", 0.01)
    path = np.zeros((ITERATION + 1, 3))
    paths = {3: path[:4], ITERATION: path + np.array([0.01, 0.0, 0.0])}
    points = {3: POINTS[:10], ITERATION: POINTS}
    maps = {3: landmarks[np.arange(10)], ITERATION: landmarks}
    covariances = {k: np.zeros((len(path), 3, 3)) for k, path in paths.items()}
    filter_path = path + np.array([0.0, 0.04, 0.0])
    return SmoothedRobot(owner, filter_path, maps, points, paths, covariances, dict(ENDING))


def test_a_row_tells_of_the_last_map_and_the_whole_path() -> None:
    smoothed = smoothed_robot()
    row = smoothed.row()
    assert row["path_rmse_m"] == pytest.approx(0.01)
    assert row["filter_path_rmse_m"] == pytest.approx(0.04)
    assert row["filter_over_smoother"] == pytest.approx(4)
    landmarks = smoothed.maps[ITERATION]
    fit = fit_to_truth(landmarks, POINTS)
    assert row["landmark_rmse_m"] == fit.rmse_m < row["filter_landmark_rmse_m"]
    assert row["nees_per_dof"] == relative_consistency(landmarks, fit).nees_per_dof
    assert (row["n_landmarks"], row["gross_share"], row["n_steps"]) == (30, 0.0, 4)


def test_frames_of_unknown_truth_are_left_out_of_path_errors() -> None:
    smoothed = smoothed_robot()
    smoothed.paths[ITERATION][2, 0] = 9.0
    smoothed.robot.path.T_map_robot[2] = np.nan
    row = smoothed.row()
    assert row["path_rmse_m"] == pytest.approx(0.01)


def test_a_robot_that_is_not_smoothed_to_its_end_has_the_reason() -> None:
    smoothed = smoothed_robot()
    del smoothed.maps[ITERATION], smoothed.paths[ITERATION]
    smoothed.ending["not_smoothed"] = "takes 3.0 GB"
    smoothed = replace(smoothed, not_smoothed={ITERATION: "takes 3.0 GB"})
    row = smoothed.row()
    told = "takes 3.0 GB; its map until frame 3 stands in"
    assert (row["n_landmarks"], row["not_smoothed"]) == (0, told)
    assert np.isnan(row["path_rmse_m"])
    assert np.isnan(row["filter_over_smoother"])
    assert "landmark_rmse_m" not in row


def test_paths_are_listed_by_iteration_and_frame() -> None:
    rows = smoothed_path_rows([smoothed_robot()])
    assert rows.groupby("iteration").size().to_dict() == {3: 4, ITERATION: ITERATION + 1}
    assert rows["frame"].tolist() == [*range(4), *range(ITERATION + 1)]
    assert smoothed_path_rows([]).empty


EARLY, LAST = 40, 43  # iterations that maps of the tiny scenario are fused at
BOTH = ("R1", "R2")
EARLIER = f"its map until frame {EARLY} stands in"
FILTER_S = "FastSLAM's map stands in"


def fails_at(monkeypatch: pytest.MonkeyPatch, places: list[tuple[str, int]]) -> None:
    """Have smoothing fail for robots at iterations."""
    works = smooth.smooth_log

    def fails(settings, log, landmark, path, attitude):
        if (log.robot, len(log) - 1) not in places:
            return works(settings, log, landmark, path, attitude)
        nothing = np.empty((0, 3)), np.empty((0, 3, 3))
        return None, *nothing, landmark, (0, np.nan, np.nan, np.nan, "fails here")

    monkeypatch.setattr(smooth, "smooth_log", fails)


@pytest.mark.parametrize(
    ("places", "instead"),
    [
        ([("R1", EARLY), ("R1", LAST)], {"R1": FILTER_S}),
        ([("R1", EARLY), ("R2", LAST)], {"R2": EARLIER}),
        ([(name, k) for name in BOTH for k in (EARLY, LAST)], dict.fromkeys(BOTH, FILTER_S)),
    ],
)
def test_the_run_ends_and_says_what_stands_in(
    places: list[tuple[str, int]],
    instead: dict[str, str],
    tiny_path: Path,
    tiny_results: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(tiny_results / "store", tmp_path / "store")
    fails_at(monkeypatch, places)
    scenario = load_scenario(tiny_path, ["smooth.max_memory_gb=0.9"])  # a key of its own
    result = run_scenario(scenario, tmp_path, 1, lambda *_: None)
    told = {name: f"{name} is not smoothed: fails here; {what}" for name, what in instead.items()}

    smoother = tables.read(tables.table_path(result, "smoother"), "smoother")
    reasons = smoother.set_index("robot")["not_smoothed"]
    assert reasons.to_dict() == {
        name: f"fails here; {instead[name]}" if name in instead else "" for name in BOTH
    }
    rows = tables.read(tables.table_path(result, "fusers"), "fusers").set_index(
        ["fuser", "iteration"]
    )
    assert rows["n_robots"].eq(2).all()  # nobody is left out for it
    said = rows["fallback"]
    assert said["joint", LAST] == "; ".join(told.values())
    early = [name for name in BOTH if (name, EARLY) in places]
    assert [name in said["joint", EARLY] for name in BOTH] == [name in early for name in BOTH]
    assert not said["kalman"].any()  # it is given the filter's maps as ever
    coverage = tables.read(tables.table_path(result, "fuser_coverage"), "fuser_coverage")
    given = set(coverage["map"])
    assert ("smoothed" in given) == (list(instead.values()) != [FILTER_S] * 2)

    print_result(result, ())
    screen, page = capsys.readouterr().out, write_report(result).read_text(encoding="utf-8")
    shown = " ".join(screen.split())
    for line in told.values():
        assert line in shown
        assert line.replace("'", "&#39;") in page
    assert ("stands in" in shown) == ("stands in" in page) == bool(instead)


T_WORLD_A = np.array([1.0, 2.0, 0.3])
T_WORLD_B = np.array([4.0, -1.0, 3.0])
GROUND = np.random.default_rng(5).uniform(0, 6, (12, 3))


def judged(estimated: Alignment, refined: Alignment, index_b: list[int]) -> pd.DataFrame:
    """Error rows of one estimate on two perfect maps; landmark i of a is paired to index_b[i]."""
    pairs = paired(list(range(len(index_b))), index_b)
    names = {"robot_a": "A", "robot_b": "B", "iteration": ITERATION}
    row = names | {"aligner": "ransac", "repetition": 0}
    estimates = pd.DataFrame([row | estimate_row(len(pairs), estimated, refined, ACCEPTED)])
    a, b = robot("A", GROUND, T_WORLD_A), robot("B", GROUND, T_WORLD_B)
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
    early, late = robot("A", GROUND[:3], T_WORLD_A), robot("A", GROUND[:5], T_WORLD_A)
    both = EvaluatedRobot(
        "A",
        {5: early.maps[ITERATION], 9: late.maps[ITERATION]},
        {5: GROUND[:3], 9: GROUND[:5]},
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
MATCHED_M = np.random.default_rng(0).uniform(0, 20, (40, 3))  # no two within the radius


def seeing(name: str, by_iteration: dict[int, list[int]], off_m: float = 0.0) -> EvaluatedRobot:
    """A robot that has these points of the world in its maps, each off by so much along x."""
    points = {k: MATCHED_M[rows] + [off_m, 0, 0] for k, rows in by_iteration.items()}
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
