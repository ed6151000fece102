"""Recorded logs without truth: all that can be had without it, and a word where it is needed."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.tables import UNKNOWN
from experiments.pipeline.store import Store
from experiments.reports.figures.result_tables import ResultTables
from experiments.scenario.settings import Simulation
from tests.helpers.report_page import page_of
from tests.helpers.tiny_scenario import assert_refused, command, estimated_tables

# The smoother has the setting of simulated pictures.
SCENARIO = """
schema_version: 1
name: recorded
seed: 3
logs: [R1, R2]
slam: {filter: {n_particles: 30, proposal: motion}}
smooth: {stray_m: 0.003}
align:
  evidence: {least_ratio: 1}
  repetitions: 2
  aligners:
    - {name: ransac, method: ransac}
    - {name: svd, method: svd}
    - {name: icp, method: icp}
evaluate: {every: 10, timing_points: 2, timing_repeats: 1}
fuse: {every: 40}
"""
NEED_THE_TRUTH = {"errors", "fusion", "true_pairs", "path_statistics", "map_fits", "landmark_nees"}
# Of logs without pictures that agree with themselves, of robots that stay alone.
SOUND = {"tracks", "findings", "adoptions", "team_members", "messages"}
NEED_THE_TRUTH |= {"team", "team_pairs", "fusers", "fuser_coverage", "smoothed_errors"}


@pytest.fixture(scope="module")
def scenario(
    tiny: Simulation, tiny_results: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    run = EvaluatedRun.of(tiny, Store.of(tiny_results))
    for robot in run.pipeline.robots:
        (folder / robot.name).mkdir()
        for name in ("frames.parquet", "observations.parquet"):
            shutil.copy(run.store.path(robot.log) / name, folder / robot.name / name)
    (folder / "recorded.yaml").write_text(SCENARIO, encoding="utf-8")
    return folder / "recorded.yaml"


def test_there_is_a_result_without_errors(
    scenario: Path, tiny_results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = scenario.parent / "results"
    reply = command(capsys, "run", scenario, "--jobs", 1, "--results", results)
    assert (reply.code, reply.complaints) == (0, [])
    for text in ("Answers (no truth: errors are unknown)", "Robots (no truth: no errors)"):
        assert text in reply.out
    assert "not drawn: fig04_translation_error: no truth" in reply.out
    result = results / "recorded-3"
    found, simulated = estimated_tables(result), estimated_tables(tiny_results / "tiny-3")
    assert {name for name in found if name not in SOUND and found[name].empty} == NEED_THE_TRUTH
    assert found["estimates"].equals(simulated["estimates"])
    assert found["fused"]["x_m"].equals(simulated["fused"]["x_m"])
    assert found["robots"][["path_error_m", "odometry_error_m"]].isna().all(axis=None)
    data = ResultTables(result)
    assert (data.table("aligner_timings")["n_common"] == UNKNOWN).all()
    assert data.no_truth
    assert data.start_pose("R1") is None
    assert (data.pairs, data.aligners) == ([("R1", "R2")], ["ransac", "svd", "icp"])
    page = page_of(result, result / "report.html")
    assert "No truth is known" in page.words
    assert_refused(command(capsys, "statistics", result), "recorded-3", "no truth is known")


def test_what_needs_the_truth_is_refused_before_any_work(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = ("--set", "expect={path_rmse_m: {max: 1}}")
    reply = command(capsys, "run", scenario, *expected, "--results", tmp_path / "new")
    assert_refused(reply, "recorded.yaml", "expect.path_rmse_m", "R1 has no truth_poses.parquet")
    assert not (tmp_path / "new").exists()


POSES, POINTS = "truth_poses.parquet", "truth_points.parquet"


def partly_known(
    tiny: Simulation, tiny_results: Path, scenario: Path, folder: Path, names: dict[str, list[str]]
) -> Path:
    """Copy the recorded scenario with some tables of the truth, by robot."""
    run = EvaluatedRun.of(tiny, Store.of(tiny_results))
    for robot in run.pipeline.robots:
        shutil.copytree(scenario.parent / robot.name, folder / robot.name)
        for name in names.get(robot.name, []):
            shutil.copy(run.store.path(robot.log) / name, folder / robot.name / name)
    return Path(shutil.copy(scenario, folder / "recorded.yaml"))


ERRORS = ["translation_error_m", "rotation_error_rad", "refined_translation_error_m"]


def test_true_poses_alone_judge_paths_and_alignments(
    tiny: Simulation,
    tiny_results: Path,
    scenario: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    known = {"R1": [POSES], "R2": [POSES]}
    own = partly_known(tiny, tiny_results, scenario, tmp_path, known)
    results = tmp_path / "results"
    expected = ("--set", "expect={path_rmse_m: {max: 1}}")
    reply = command(capsys, "run", own, *expected, "--jobs", 1, "--results", results)
    assert reply.code == 0
    assert "true points are unknown" in reply.err
    found = estimated_tables(results / "recorded-3")
    whole = estimated_tables(tiny_results / "tiny-3")
    # Errors of estimates follow from the poses alone, so they are those of the whole truth.
    of_methods = found["errors"]["aligner"] != "oracle"
    np.testing.assert_array_equal(
        found["errors"].loc[of_methods, ERRORS], whole["errors"].loc[of_methods, ERRORS]
    )
    np.testing.assert_array_equal(found["robots"]["path_error_m"], whole["robots"]["path_error_m"])
    # The poses place the observations, so common landmarks are known up to their noise.
    ours, theirs = (each["errors"]["n_common"].to_numpy() for each in (found, whole))
    assert np.mean(np.abs(ours - theirs)) < 0.3 * np.mean(theirs)
    assert found["map_fits"].empty
    assert found["landmark_nees"].empty
    assert found["fusion"].empty
    assert found["fusers"]["landmark_rmse_m"].isna().all()
    assert command(capsys, "check", own, *expected, "--results", results).code == 0


def test_true_points_alone_judge_maps_and_alignments(
    tiny: Simulation,
    tiny_results: Path,
    scenario: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    known = {"R1": [POINTS], "R2": [POINTS]}
    own = partly_known(tiny, tiny_results, scenario, tmp_path, known)
    results = tmp_path / "results"
    assert command(capsys, "run", own, "--jobs", 1, "--results", results).code == 0
    found = estimated_tables(results / "recorded-3")
    whole = estimated_tables(tiny_results / "tiny-3")
    assert found["robots"]["path_error_m"].isna().all()
    # A rigid fit of the maps to the points does not depend on the poses.
    np.testing.assert_allclose(found["map_fits"]["rmse_m"], whole["map_fits"]["rmse_m"])
    np.testing.assert_array_equal(found["errors"]["n_true"], whole["errors"]["n_true"])
    # The origins of the maps are fitted: the motions differ by the errors of the maps.
    apart = found["errors"]["translation_error_m"] - whole["errors"]["translation_error_m"]
    assert found["errors"]["translation_error_m"].notna().any()
    assert float(apart.abs().median()) < 0.2
    assert found["errors"]["alignment_nees"].isna().all()


def test_pairs_of_robots_with_truth_are_judged(
    tiny: Simulation,
    tiny_results: Path,
    scenario: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    known = {"R1": [POSES, POINTS]}
    own = partly_known(tiny, tiny_results, scenario, tmp_path, known)
    results = tmp_path / "results"
    assert command(capsys, "run", own, "--jobs", 1, "--results", results).code == 0
    found = estimated_tables(results / "recorded-3")
    whole = estimated_tables(tiny_results / "tiny-3")
    assert found["errors"].empty
    of_first = found["robots"]["robot"] == "R1"
    assert found["robots"].loc[~of_first, "path_error_m"].isna().all()
    np.testing.assert_array_equal(
        found["robots"].loc[of_first, "path_error_m"],
        whole["robots"].loc[of_first, "path_error_m"],
    )
    fits = found["map_fits"].set_index("map")["rmse_m"]
    assert fits["R1"] == whole["map_fits"].set_index("map")["rmse_m"]["R1"]
    assert np.isnan(fits["R2"])


def test_results_that_cannot_be_written_are_told_before_any_work(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recorded-3").mkdir()
    (tmp_path / "recorded-3" / "figures").write_text("no folder")
    reply = command(capsys, "run", scenario, "--results", tmp_path)
    assert_refused(reply, "recorded-3/figures", "cannot be written")
    assert not (tmp_path / "store").exists()


def test_errors_tell_why_a_refinement_was_refused(tiny_results: Path) -> None:
    errors = estimated_tables(tiny_results / "tiny-3")["errors"]
    refined = errors["refined_status"] == "accepted"
    assert np.array_equal(errors["refined_reason"] == "", refined)
    assert not refined.all()
