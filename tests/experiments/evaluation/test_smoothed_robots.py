"""Smoothed maps and paths against the truth, and maps that stand in where smoothing failed."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation import tables
from experiments.evaluation.map_consistency import fit_to_truth, relative_consistency
from experiments.evaluation.result import run_scenario
from experiments.evaluation.smoothed_robots import SmoothedRobot, smoothed_path_rows, smoother_rows
from experiments.pipeline.stages import smooth
from experiments.reports.report.document import write_report
from experiments.reports.terminal.run_screen import print_result
from experiments.scenario.loading import load_scenario
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
    fit = fit_to_truth(landmarks, POINTS)
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
