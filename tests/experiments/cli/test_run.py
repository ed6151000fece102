"""One tiny run from end to end: every table, every command, interruptions, reuse."""

import json
import shutil
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.result import run_scenario
from experiments.pipeline.stage import Job
from experiments.pipeline.stages.pipeline import build_pipeline
from experiments.pipeline.store import Store
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Recording, Simulation
from mapfusion.landmark_map import read_map
from mapfusion.robot_log import read_truth, write_truth_points, write_truth_poses
from tests.helpers.interrupting import interrupted
from tests.helpers.tiny_scenario import TINY, assert_same_tables, command, estimated_tables


def quietly(stage: str, done: int, total: int) -> None:
    """Progress nobody looks at."""


def test_every_table_is_there(tiny_result: Path, tiny: Simulation) -> None:
    for name in tables.ALL:
        table = tables.read(tables.table_path(tiny_result, name), name)  # checks the schema
        # sound logs have no findings, and the robots stay alone
        assert len(table) or name in ("findings", "adoptions", "team_members", "messages"), name
    found = estimated_tables(tiny_result)
    errors, estimates = found["errors"], found["estimates"]
    repetitions = {"ransac": 2, "svd": 1, "icp": 2}  # what draws nothing at random runs once
    for (_, aligner), rows in estimates.groupby(["iteration", "aligner"]):
        assert len(rows) == repetitions[aligner]
    assert estimates["aligner"].nunique() == len(repetitions)
    assert len(errors) == len(estimates) + 5  # the oracle, once an iteration
    assert sorted(errors["iteration"].unique()) == [10, 20, 30, 40, 43]
    assert (errors["n_true"] <= errors["n_correspondences"]).all()
    assert (errors["n_inliers"] <= errors["n_correspondences"]).all()
    for name in ("precision", "recall"):
        assert errors[name].dropna().between(0, 1).all()
    robots = found["robots"]
    assert (robots.groupby("robot").size() == 44).all()
    assert robots["path_error_m"].iloc[0] == pytest.approx(0, abs=0.01)
    assert robots["effective_sample_size"].between(1, 30).all()
    assert set(found["tracks"]["iteration"]) == {30, 31}
    assert set(found["map_fits"]["map"]) == {"R1", "R2", "fused"}


def test_maps_are_those_of_the_tables(tiny_result: Path) -> None:
    found = estimated_tables(tiny_result)
    for robot, rows in found["landmarks"].groupby("robot"):
        landmarks = read_map(tiny_result / "maps" / f"{robot}.parquet")
        np.testing.assert_array_equal(landmarks.position_m, rows[["x_m", "y_m", "z_m"]])
        assert landmarks.name == robot
    fused = read_map(tiny_result / "maps" / "fused.parquet")
    np.testing.assert_array_equal(fused.position_m, found["fused_map"][["x_m", "y_m", "z_m"]])


def test_estimates_lie_near_the_truth(tiny_result: Path) -> None:
    """Rough, so that it tells a broken run from a poor one: a room of 6 m, errors below 0.5 m."""
    found = estimated_tables(tiny_result)
    errors = found["errors"]
    ransac = errors[(errors["aligner"] == "ransac") & (errors["iteration"] == 43)]
    assert (ransac["refined_status"] == "accepted").all()
    assert (ransac["refined_translation_error_m"] < 0.5).all()
    assert (ransac["refined_rotation_error_rad"].abs() < 0.2).all()
    landmarks = found["landmarks"]
    off = landmarks[["x_m", "y_m"]].to_numpy() - landmarks[["truth_x_m", "truth_y_m"]].to_numpy()
    assert np.nanmedian(np.hypot(*off.T)) < 0.3


def test_finished_stages_are_reused_and_fresh_computes_again(
    tiny: Simulation, tiny_results: Path, tmp_path: Path
) -> None:
    told: list[str] = []

    def tell(stage: str, done: int, total: int) -> None:
        told.append(stage)

    finished = EvaluatedRun.of(tiny, Store.of(tiny_results))
    finished.execute(1, tell)
    assert told == []

    quick = tiny.model_copy(update={"drive": tiny.drive.model_copy(update={"frames": 4})})
    run_scenario(quick, tmp_path, 1, quietly)
    marks = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("done*.json")}
    run_scenario(quick, tmp_path, 1, tell, fresh=True)
    assert set(told) == {stage.label for stage in finished.stages()} | {"write the tables"}
    assert all(path.stat().st_mtime_ns > before for path, before in marks.items())


def test_nothing_of_an_earlier_run_is_left(
    tiny_path: Path, tiny_results: Path, tmp_path: Path
) -> None:
    shutil.copytree(tiny_results, tmp_path, dirs_exist_ok=True)
    result = tmp_path / "tiny-3"
    outdated = [result / "maps" / "R3.parquet", result / "keyframes" / "R1_00099.png"]
    for path in outdated:
        path.write_bytes(b"of an earlier run")
    run_scenario(load_scenario(tiny_path), tmp_path, 1, quietly)
    assert not any(path.exists() for path in outdated)
    assert len(list((result / "keyframes").iterdir())) == 4


def test_ctrl_c_before_the_command_starts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def press() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("experiments.pipeline.stage.use_kernel_cache", press)
    reply = command(capsys, "scenarios", "--schema")
    assert reply.code == 130
    assert len(reply.err.splitlines()) == 1


@pytest.mark.parametrize("by_terminal", [True, False])
def test_interrupted_run_goes_on_and_gives_the_same_tables(
    tiny: Simulation, tiny_path: Path, tiny_result: Path, tmp_path: Path, by_terminal: bool
) -> None:
    def rendered() -> list[Path]:
        return list(results.rglob("features/*/done_*.json"))

    results, held = tmp_path / "results", tmp_path / "held"
    held.mkdir()
    command_line = ["run", tiny_path, "--jobs=2", f"--results={results}"]
    ended = interrupted(
        command_line, held, "features_000020.parquet", lambda: bool(rendered()), by_terminal
    )
    assert ended.returncode == 130
    assert "Traceback" not in ended.stderr
    complaints = [line for line in ended.stderr.splitlines() if line.startswith("mapfusion: ")]
    assert len(complaints) == 1
    assert "interrupted" in complaints[0]
    marks = rendered()
    chunks = [m.with_name(f"features{m.stem.removeprefix('done')}.parquet") for m in marks]
    kept = {path: path.stat().st_mtime_ns for path in (*marks, *chunks)}
    assert 1 <= len(marks) < 6
    assert not (results / "tiny-3").exists()

    run_scenario(tiny, results, 2, quietly)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(rendered()) == 6
    assert_same_tables(results / "tiny-3", tiny_result)  # which one process made in one go


def test_truth_is_for_the_evaluation_alone(
    tiny: Simulation, tiny_results: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    folders = []
    run = EvaluatedRun.of(tiny, Store.of(tiny_results))
    for robot in run.pipeline.robots:
        folder, log = tmp_path / robot.name, run.store.path(robot.log)
        folder.mkdir()
        for name in ("frames.parquet", "observations.parquet"):
            (folder / name).hardlink_to(log / name)
        truth = read_truth(log)
        write_truth_poses(folder, rng.permutation(truth.T_world_robot))
        write_truth_points(folder, rng.permutation(truth.point_world_m) + 100)
        folders.append(folder)
    shuffled = Recording.model_validate(
        {"schema_version": 1, "name": "shuffled", "seed": tiny.seed, "logs": [*map(str, folders)]}
        | {
            name: getattr(tiny, name)
            for name in ("slam", "smooth", "align", "evaluate", "merge", "fuse")
        }
    )
    result = run_scenario(shuffled, tmp_path / "results", 1, quietly)
    before = estimated_tables(tiny_results / "tiny-3")
    after = estimated_tables(result)
    for name in ("estimates", "correspondences", "clouds"):
        pd.testing.assert_frame_equal(after[name], before[name], check_exact=True, obj=name)
    estimated = [c for c in before["landmarks"] if not c.startswith("truth")]
    pd.testing.assert_frame_equal(after["landmarks"][estimated], before["landmarks"][estimated])
    estimated = [c for c in before["fused"] if not c.startswith("truth")]
    pd.testing.assert_frame_equal(after["fused"][estimated], before["fused"][estimated])
    estimated = [c for c in before["paths"] if not c.startswith("truth")]
    pd.testing.assert_frame_equal(after["paths"][estimated], before["paths"][estimated])
    # the truth did change, and the judgement with it
    assert not before["errors"]["translation_error_m"].equals(
        after["errors"]["translation_error_m"]
    )


def test_estimating_opens_no_truth(tiny: Simulation, tiny_results: Path, tmp_path: Path) -> None:
    """The filter and the aligners run where the truth is not even on disk."""
    run = EvaluatedRun.of(tiny, Store.of(tiny_results))
    folders = {}
    for robot in run.pipeline.robots:
        folders[robot.log.key] = log = tmp_path / robot.name
        log.mkdir()
        for name in ("frames.parquet", "observations.parquet"):
            (log / name).hardlink_to(run.store.path(robot.log) / name)
        folders[robot.slam.key] = log / "slam"
        robot.slam.work(robot.slam.settings, Job({"log": log}, log / "slam"))
        folders[robot.smooth.key], inputs = log / "smooth", {"log": log, "slam": log / "slam"}
        for part in robot.smooth.parts:
            robot.smooth.work(robot.smooth.settings, Job(inputs, log / "smooth", part))
    (pair,) = run.pipeline.pairs
    for number, stage in enumerate(pair.filtered.estimates.before.values()):
        folders[stage.key] = tmp_path / f"{stage.name}{number}"
        inputs = {name: folders[before.key] for name, before in stage.before.items()}
        stage.work(stage.settings, Job(inputs, folders[stage.key], "000"))
        assert (folders[stage.key] / "batch_000.parquet").is_file()


def test_only_the_changed_aligner_runs_again(tiny: Simulation) -> None:
    changed = tiny.align.aligners[0].model_copy(update={"parameters": {"gate_m": 0.25}})
    entries = [changed, *tiny.align.aligners[1:]]
    other = tiny.model_copy(update={"align": tiny.align.model_copy(update={"aligners": entries})})
    before, after = (
        build_pipeline(scenario).pairs[0].filtered.estimates.before for scenario in (tiny, other)
    )
    same = {name: after[name].key == stage.key for name, stage in before.items()}
    assert same == {"match": True, "aligner 0": False, "aligner 1": True, "aligner 2": True}


@pytest.mark.parametrize("merges", [False, True])
def test_maps_are_fused_again_when_the_aligner_changed_that_merges_them(
    tiny: Simulation, merges: bool
) -> None:
    entries = [*tiny.align.aligners]
    (row,) = [i for i, entry in enumerate(entries) if entry.name == tiny.merge.aligner]
    if not merges:
        row = (row + 1) % len(entries)
    entries[row] = entries[row].model_copy(update={"time_limit_s": 7.5})
    other = tiny.model_copy(update={"align": tiny.align.model_copy(update={"aligners": entries})})
    before, after = (build_pipeline(scenario).fusers for scenario in (tiny, other))
    assert [before[name].key != after[name].key for name in before] == [merges] * len(before)


def test_commands_one_by_one(
    tiny_path: Path, tiny_results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs, maps = tmp_path / "logs", [tmp_path / "R1.parquet", tmp_path / "R2.parquet"]
    scenario = ("--scenario", tiny_path, "--seed", 3)
    reply = command(capsys, "record", tiny_path, "-o", logs, "--jobs", 1, "--results", tiny_results)
    assert reply.code == 0
    assert sorted(path.name for path in logs.iterdir()) == ["R1", "R2"]
    for path in maps:
        assert command(capsys, "slam", logs / path.stem, "-o", path, *scenario).code == 0
        of_the_run = read_map(tiny_results / "tiny-3" / "maps" / path.name)
        np.testing.assert_array_equal(read_map(path).position_m, of_the_run.position_m)
    reply = command(capsys, "align", *maps, *scenario)
    assert reply.code == 0
    assert all(name in reply.out for name in ("ransac", "svd", "icp"))
    reply = command(capsys, "merge", *maps, "-o", tmp_path / "fused.parquet", *scenario)
    assert reply.code == 0
    fused, parts = read_map(tmp_path / "fused.parquet"), [read_map(path) for path in maps]
    assert max(map(len, parts)) < len(fused) < sum(map(len, parts))


@pytest.mark.usefixtures("quick_save")
def test_figures(tiny_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = shutil.copytree(tiny_result, tmp_path / "result")
    reply = command(capsys, "report", copy, "--figures", "--jobs", 1)
    assert reply.code == 0
    drawn = {path.name[:5] for path in (copy / "figures").glob("fig*")}
    skipped = {line.split()[2][:5] for line in reply.out.splitlines() if "not drawn" in line}
    assert drawn | skipped == {f"fig{number:02d}" for number in range(1, 14)}
    assert not drawn & skipped


@pytest.mark.parametrize(("most", "code"), [(1.0, 0), (1e-9, 1)])
def test_check(
    tiny_path: Path,
    tiny_results_copy: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    most: float,
    code: int,
) -> None:
    junit = tmp_path / "junit.xml"
    reply = command(
        capsys,
        *("check", tiny_path, "--jobs", 1, "--results", tiny_results_copy, "--seeds", 3),
        *("--set", f"expect.path_rmse_m.max={most}", "--junit", junit),
    )
    assert reply.code == code
    assert ET.parse(junit).getroot().get("failures") == str(code)
    assert f"{1 - code} passed, {code} failed" in reply.out


def test_run_shows_the_aligners(
    tiny_path: Path,
    tiny_results_copy: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("experiments.reports.figures.drawing.FIGURES", ())  # drawn in other tests
    reply = command(capsys, "run", tiny_path, "--jobs", 1, "--results", tiny_results_copy)
    assert reply.code == 0
    assert all(name in reply.out for name in ("ransac", "svd", "icp", "oracle", "R1", "R2"))
    resolved = json.loads((tiny_results_copy / "tiny-3" / "scenario.json").read_text())
    assert resolved["slam"]["filter"]["n_particles"] == 30


@pytest.mark.usefixtures("quick_save")
def test_a_second_run_draws_nothing_starts_no_process_and_tells_where_time_went(
    tiny_path: Path,
    tiny_results_copy: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise AssertionError("something is left to do")

    figures = ("fig08_fused_landmark", "fig10_fused_map")
    monkeypatch.setattr("experiments.reports.figures.drawing.FIGURES", figures)
    arguments = ("run", tiny_path, "--results", tiny_results_copy)
    assert command(capsys, *arguments, "--jobs", 1).code == 0
    monkeypatch.setattr("experiments.pipeline.workers.ProcessPoolExecutor", refused)
    monkeypatch.setattr("experiments.reports.figures.drawing.draw_figure", refused)
    reply = command(capsys, *arguments, "--jobs", 2)
    assert reply.code == 0
    timings = tables.read(
        tables.table_path(tiny_results_copy / "tiny-3", "timings"), "timings"
    ).set_index(["stage", "name"])["elapsed_s"]
    outside = ["tables", "start", "figures"]
    assert timings.index.unique("stage").tolist()[-3:] == outside
    assert timings["figures"].index.tolist() == [f"{name}:elapsed_s" for name in figures]
    assert (timings[outside] > 0).all()
    # the table has one row for each of them, in whole seconds and tenths
    shown = {line.split("  ")[0].strip(): line for line in reply.out.splitlines()}
    assert set(outside) <= set(shown)
    assert f"{timings['slam'].filter(like='elapsed_s').sum():.1f}" in shown["slam"]


# in six frames robots see less than a room, one piece of wall, and nothing that must be seen again
SMALL = ["align.evidence.place_m=0", "align.evidence.region_m=0.5"]


@pytest.mark.usefixtures("quick_save")
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("one robot", ["robots=[{name: R1, start: [1.2, 1.2, 0.6], route: [[4.8, 1.2]]}]"]),
        # no wall is this near: nothing is seen, all maps are empty
        ("blind", ["vision.max_depth_m=0.1"]),
        ("nothing alike", ["align.match.max_descriptor_distance=0.001"]),
        ("empty at first", ["evaluate.every=1", "drive.frames=6", "slam.min_count=4", *SMALL]),
    ],
)
def test_runs_with_little_to_go_on(
    tiny_results: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    overrides: list[str],
) -> None:
    if name == "nothing alike":  # differs from a usual run in its tables alone
        monkeypatch.setattr("experiments.reports.figures.drawing.FIGURES", ())
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    changes = [part for override in overrides for part in ("--set", override)]
    if not any("drive.frames" in override for override in overrides):
        changes += ["--set", "drive.frames=12", "--set", "evaluate.every=5"]
    reply = command(capsys, "run", path, "--jobs", 1, "--results", tmp_path, *changes)
    assert reply.code == (1 if name == "blind" else 0)
    told = [line.partition("merged")[2] for line in reply.complaints if "merged" in line]
    unusable = [line for line in reply.complaints if "no robot's map can be used" in line]
    assert bool(unusable) == (name == "blind")
    unmerged = {
        "blind": [", and none share ground"],
        "nothing alike": [", though some share ground"],
    }
    assert told == unmerged.get(name, [])
    errors = tables.read(tables.table_path(tmp_path / "tiny-3", "errors"), "errors")
    if name == "one robot":
        assert not len(errors)
    else:
        assert (errors["status"] == "degenerate").any()
        assert (errors["reason"][errors["status"] == "degenerate"] != "").all()
    reply = command(
        capsys, "check", path, "--jobs", 1, "--results", tmp_path, "--seeds", 3, *changes
    )
    assert reply.code == (name == "nothing alike")


def test_a_dry_run_prints_the_plan_and_writes_nothing(
    tiny_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "results"
    reply = command(capsys, "run", tiny_path, "--dry-run", "--results", results, "--jobs", 1)
    assert reply.code == 0
    assert "tiny, seed 3: 2 robots, 44 frames each; images: PyBullet's TinyRenderer" in reply.out
    assert ["slam", "0", "2"] in [line.split()[:3] for line in reply.out.splitlines()]
    assert "Nothing was run." in reply.out
    assert not results.exists()
    wrong = ("run", tiny_path, "--dry-run", "--set", "drive.frames=1")
    assert command(capsys, *wrong).code == 2


def test_a_run_without_figures_leaves_none_and_ends_with_advice(
    tiny_path: Path, tiny_results_copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = tiny_results_copy / "tiny-3" / "figures"
    figures.mkdir(exist_ok=True)
    outdated, own = figures / "fig10_fused_map.png", figures / "mine.png"
    for file in (outdated, own):
        file.write_bytes(b"")
    arguments = ("run", tiny_path, "--results", tiny_results_copy, "--no-figures", "--jobs", 1)
    reply = command(capsys, *arguments)
    assert reply.code == 0
    assert [file.name for file in figures.iterdir()] == [own.name]
    *_, images, advice, opens = reply.out.strip().splitlines()
    assert images == "Images of the cameras: PyBullet's TinyRenderer"
    assert advice.startswith("Method to use: ")
    assert "xa0" not in advice
    assert opens == f"Open the report: mapfusion report {tiny_results_copy / 'tiny-3'} --open"
