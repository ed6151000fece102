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
    coverage_rows,
    smoothed_path_rows,
)
from experiments.evaluation.result import run_scenario
from experiments.evaluation.truth import EvaluatedRobot
from experiments.pipeline.stages import smooth
from experiments.reports.report.document import write_report
from experiments.reports.terminal.run_screen import print_result
from experiments.scenario.loading import load_scenario
from mapfusion.fusion.aligned_landmarks import ABSENT
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from tests.experiments.evaluation.evaluated_teams import (
    BENT_M,
    PARTS,
    K,
    evaluated_robots,
    evaluated_team,
)
from tests.helpers.made_up_maps import ITERATION, landmark_map
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
    for k, robot in enumerate(filters):
        own, points = robot.at(K)
        worse = team.truth(k) + 2 * (own.position_m - team.truth(k))
        backwards = np.arange(len(own))[::-1]
        rough_map = type(own)(
            worse, own.covariance_m2, own.count, own.source_observation, own.descriptor
        )[backwards]
        rough.append(EvaluatedRobot(robot.name, {K: rough_map}, {K: points[backwards]}, robot.path))
    fused = merge(team.maps, team.pairs).fused[0]
    given = []
    for robot, good in zip(rough, filters, strict=True):
        smoothed = SmoothedRobot(
            robot, np.zeros((1, 3)), good.maps, good.points_world_m, {}, {"not_smoothed": ""}
        )
        given.append(GivenMap.at(robot, smoothed, K))
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
    return SmoothedRobot(
        owner, path + np.array([0.0, 0.04, 0.0]), maps, points, paths, dict(ENDING)
    )


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
        return None, np.empty((0, 3)), landmark, (0, np.nan, np.nan, np.nan, "fails here")

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
