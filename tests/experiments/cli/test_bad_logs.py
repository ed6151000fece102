"""Recordings and stores that are not what they should be: one line, exit code 2."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.judge.result import run_scenario
from experiments.scenario.loading import load_scenario
from mapfusion.robot_log import read_log, write_log
from tests.helpers.tiny_scenario import assert_refused, command


def recorded(tmp_path: Path, *names: str) -> Path:
    """A scenario on logs in folders of these names."""
    path = tmp_path / "recorded.yaml"
    path.write_text(f"schema_version: 1\nname: recorded\nlogs: [{', '.join(names)}]\n")
    return path


def copied_log(log: Path, folder: Path, **changes: object) -> None:
    write_log(folder, replace(read_log(log), **changes))
    for name in ("truth_poses.parquet", "truth_points.parquet"):
        (folder / name).write_bytes((log / name).read_bytes())


def test_logs_cannot_write_outside_the_results(
    tiny_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copied_log(tiny_log, tmp_path / "log", robot="../../../outside")
    reply = command(capsys, "run", recorded(tmp_path, "log"), "--results", tmp_path / "results")
    assert_refused(reply, "../../../outside", "frames.parquet")
    assert not list(tmp_path.rglob("outside*"))


def test_two_logs_of_one_robot(
    tiny_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copied_log(tiny_log, tmp_path / "a")
    copied_log(tiny_log, tmp_path / "b")
    reply = command(capsys, "run", recorded(tmp_path, "a", "b"), "--results", tmp_path / "results")
    assert_refused(reply, "robot R1 is in another log")


def test_truth_of_another_log(
    tiny_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = read_log(tiny_log)
    rows = log.iteration < 20
    copied_log(
        tiny_log,
        tmp_path / "log",
        iteration=log.iteration[rows],
        observations=log.observations[rows],
    )
    path = recorded(tmp_path, "log")
    reply = command(capsys, "run", path, "--jobs", 1, "--results", tmp_path / "results")
    assert reply.code == 2
    assert len(reply.complaints) == 1
    assert "truth_points.parquet" in reply.complaints[0]


def test_empty_log(tiny_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = read_log(tiny_log)
    copied_log(
        tiny_log,
        tmp_path / "log",
        time_s=log.time_s[:0],
        odometry=log.odometry[:0],
        iteration=log.iteration[:0],
        observations=log.observations[:0],
    )
    reply = command(capsys, "slam", tmp_path / "log", "-o", tmp_path / "m.parquet")
    assert_refused(reply, "frames.parquet", "no frame")
    reply = command(capsys, "run", recorded(tmp_path, "log"), "--results", tmp_path / "results")
    assert_refused(reply, "frames.parquet", "no frame")


def test_damaged_store_is_named(
    tiny_path: Path, tiny_results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(tiny_results / "store", tmp_path / "store")
    for stage in ("observed", "log", "slam", "align", "judge"):
        shutil.rmtree(tmp_path / "store" / stage)
    chunk = next((tmp_path / "store" / "features").rglob("features_000020.parquet"))
    chunk.write_bytes(chunk.read_bytes()[:100])
    reply = command(capsys, "run", tiny_path, "--jobs", 1, "--results", tmp_path)
    assert reply.code == 2
    assert len(reply.complaints) == 1
    assert str(chunk) in reply.complaints[0]
    assert "delete its folder" in reply.complaints[0]
    shutil.rmtree(chunk.parent)
    run_scenario(load_scenario(tiny_path), tmp_path, 1, lambda stage, done, total: None)
