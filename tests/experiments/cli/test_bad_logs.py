"""Recordings and stores that are not what they should be: one line, exit code 2."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from mapfusion.robot_log import read_log, write_log
from tests.helpers.tiny_scenario import assert_refused, assert_same_tables, command


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


@pytest.mark.parametrize(
    ("jobs", "left_out", "where"),
    [
        (2, ("observed", "log", "slam", "align", "judge"), "features/*/features_000020.parquet"),
        (1, ("features", "observed", "log", "slam", "align", "judge"), "faces/*/*_0001.bmp"),
        (1, (), "judge/*/errors.parquet"),
        (1, (), "slam/*/done.json"),
        (1, (), "log/*/observations.parquet"),
    ],
)
def test_a_damaged_stage_is_named_and_made_again(
    jobs: int,
    left_out: tuple[str, ...],
    where: str,
    tiny_path: Path,
    tiny_result: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("experiments.reports.figures.drawing.FIGURES", ())  # drawn in other tests
    shutil.copytree(tiny_result.parent / "store", tmp_path / "store")
    for stage in left_out:
        shutil.rmtree(tmp_path / "store" / stage)
    damaged, *_ = (tmp_path / "store").glob(where)
    flip(damaged, damaged.stat().st_size // 2)
    reply = command(capsys, "run", tiny_path, "--jobs", jobs, "--results", tmp_path)
    assert reply.code == 0, reply.err
    complaint, *more = reply.complaints
    assert str(damaged) in complaint
    assert f"the stage {where.partition('/')[0]} is discarded and computed again" in complaint
    assert not more
    assert_same_tables(tmp_path / tiny_result.name, tiny_result)


def flip(path: Path, byte: int) -> None:
    """Change one bit of a file, its other names apart."""
    data = bytearray(path.read_bytes())
    data[byte] ^= 4
    path.unlink()
    path.write_bytes(data)
