"""The table of coverages, against landmarks counted one by one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from experiments.evaluation import tables
from experiments.evaluation.fused_map_errors import (
    FILTERED,
    FUSED,
    NOMINAL,
    SMOOTHED,
    GivenMap,
    JudgedFusion,
    coverage_rows,
)
from mapfusion.landmark_map import LandmarkMap
from tests.experiments.judge.judged_teams import BENT_M, PARTS, K, evaluated_robots, judged_team
from tests.mapfusion.fuse.drawn_maps import DrawnTeam


def coverage(fusions: Sequence[JudgedFusion]) -> pd.DataFrame:
    return tables.framed("fuser_coverage", coverage_rows(fusions))


def counted(landmarks: LandmarkMap, truth: np.ndarray, d: int = 3) -> np.ndarray:
    """Probabilities (n,) of the smallest ellipses that hold the true points."""
    off, S = (landmarks.position_m - truth)[:, :d], landmarks.covariance_m2[:, :d, :d]
    squared = [e @ np.linalg.solve(own, e) for e, own in zip(off, S, strict=True)]
    return chi2.cdf(squared, d)


@pytest.mark.parametrize("planar", [False, True])
def test_shares_are_those_of_landmarks_counted_one_by_one(planar: bool) -> None:
    """Before fusing those of all robots together, not the mean of their shares."""
    team = DrawnTeam(PARTS, 1, planar, BENT_M)
    judged = judged_team(team)
    rows, d = coverage([judged]), 2 if planar else 3
    needed = np.concatenate([counted(own, team.truth(k), d) for k, own in enumerate(team.maps)])
    before = rows[rows["map"] == FILTERED].set_index("nominal")
    assert (before["n_landmarks"] == len(needed)).all()
    assert before["frame_coverage"].to_dict() == {p: np.mean(needed <= p) for p in NOMINAL}
    after, row = rows[rows["map"] == FUSED].set_index("nominal"), judged.row()
    assert after.loc[0.95, "coverage"] == row["coverage_95"]
    assert after.loc[0.95, "frame_coverage"] == row["frame_coverage_95"]
    assert (after["fuser"] == "joint").all()
    assert (before["fuser"] == "").all()


def test_maps_that_are_as_sure_as_they_may_be_keep_to_the_diagonal() -> None:
    fusions = [judged_team(DrawnTeam(PARTS, seed, bent_m=BENT_M)) for seed in range(30)]
    rows = pd.concat([coverage([each]) for each in fusions])
    for of, own in rows.groupby("map"):
        mean = own.groupby("nominal")[["coverage", "frame_coverage"]].mean()
        assert mean.sub(mean.index, axis=0).abs().to_numpy().max() < 0.05, of


def test_gross_landmarks_are_left_out() -> None:
    team = DrawnTeam(PARTS, 2, bent_m=BENT_M)
    team.pairs = []
    whole = coverage([judged_team(team)]).set_index(["map", "nominal"])
    position = team.maps[0].position_m.copy()
    position[:4] += 0.4
    team.maps[0] = replace(team.maps[0], position_m=position)
    rows = coverage([judged_team(team)]).set_index(["map", "nominal"])
    lost = whole["n_landmarks"] - rows["n_landmarks"]
    assert (lost == 4).all()
    assert rows.loc[(FUSED, 0.99), "coverage"] > 0.9


def test_smoothed_maps_stand_beside_the_filters_and_only_the_end_counts() -> None:
    team = DrawnTeam(PARTS, 3, bent_m=BENT_M)
    judged = judged_team(team)
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
    assert coverage([judged_team(team)]).empty
    assert coverage([]).empty
