"""The smoother's maps and paths beside the truth and the filter's."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.evaluation.map_consistency import fitted, relative_consistency
from experiments.evaluation.smoothed_robots import SmoothedRobot, smoothed_path_rows, smoother_rows
from tests.helpers.made_up_maps import ITERATION, landmark_map, robot

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
    owner = robot("R1", POINTS, WORLD, 0.03 * rng.standard_normal((30, 3)))
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
    (row,) = smoother_rows([smoothed])
    assert row["path_rmse_m"] == pytest.approx(0.01)
    assert row["filter_path_rmse_m"] == pytest.approx(0.04)
    assert row["filter_over_smoother"] == pytest.approx(4)
    landmarks = smoothed.maps[ITERATION]
    fit = fitted(landmarks, POINTS)
    assert row["landmark_rmse_m"] == fit.rmse_m < row["filter_landmark_rmse_m"]
    assert row["nees_per_dof"] == relative_consistency(landmarks, fit).nees_per_dof
    assert (row["n_landmarks"], row["gross_share"], row["n_steps"]) == (30, 0.0, 4)


def test_frames_of_unknown_truth_are_left_out_of_path_errors() -> None:
    smoothed = smoothed_robot()
    smoothed.paths[ITERATION][2, 0] = 9.0
    smoothed.robot.path.T_map_robot[2] = np.nan
    (row,) = smoother_rows([smoothed])
    assert row["path_rmse_m"] == pytest.approx(0.01)


def test_a_robot_that_is_not_smoothed_to_its_end_has_the_reason() -> None:
    smoothed = smoothed_robot()
    del smoothed.maps[ITERATION], smoothed.paths[ITERATION]
    smoothed.ending["not_smoothed"] = "takes 3.0 GB"
    smoothed = replace(smoothed, not_smoothed={ITERATION: "takes 3.0 GB"})
    (row,) = smoother_rows([smoothed])
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
