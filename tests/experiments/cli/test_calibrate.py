"""`mapfusion study calibrate`: corrected logs beside the truth, and refusals in one line."""

import json
from pathlib import Path

import numpy as np
import pytest

from mapfusion.robot_log import (
    read_log,
    read_truth,
    write_log,
    write_truth_points,
    write_truth_poses,
)
from tests.helpers.tiny_scenario import assert_refused, command
from tests.mapfusion.smoother.test_odometry_calibration import planar_log


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """A log with its truth, short."""
    log = planar_log(np.random.default_rng(1), 60)
    write_log(tmp_path / "raw", log)
    write_truth_poses(tmp_path / "raw", np.full((60, 3), np.nan))
    write_truth_points(tmp_path / "raw", np.full((len(log.observations), 3), 2.0))
    return tmp_path / "raw"


def test_corrected_logs_are_what_the_constants_say(
    raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(capsys, "study", "calibrate", raw, "-o", tmp_path / "logs", "--json")
    assert reply.code == 0
    found = json.loads(reply.out)
    (robot,) = found["robots"]
    before, after = read_log(raw), read_log(tmp_path / "logs" / "R1")
    np.testing.assert_allclose(
        after.odometry[:, :2], (1 + robot["distance"]) * before.odometry[:, :2]
    )
    np.testing.assert_array_equal(after.observations.position_m, before.observations.position_m)
    assert np.all(read_truth(tmp_path / "logs" / "R1").point_world_m == 2.0)
    shown = command(capsys, "study", "calibrate", raw, "-o", tmp_path / "again").out
    assert "rotation_rad_per_sqrt_rad" in shown
    assert "R1" in shown
    assert ("not settled" in shown) == (not found["settled"])


def test_rounds_that_end_before_their_time_say_so(
    raw: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mapfusion.smoother.odometry_calibration._MOST_ROUNDS", 1)
    assert "not settled" in command(capsys, "study", "calibrate", raw).out
    found = json.loads(command(capsys, "study", "calibrate", raw, "--json").out)
    assert (found["n_rounds"], found["settled"]) == (1, False)


def test_corrected_logs_may_lie_beside_the_folder_of_the_raw_ones(
    raw: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    below = raw.parent / "results" / "raw"
    below.mkdir(parents=True)
    own = raw.rename(below / "R1")
    assert command(capsys, "study", "calibrate", own, "-o", below.parent).code == 0
    assert (below.parent / "R1" / "frames.parquet").is_file()


def test_a_log_is_not_written_over(raw: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = raw.rename(raw.parent / "R1")
    assert_refused(
        command(capsys, "study", "calibrate", own, "-o", own.parent), "--output", "R1 is an input"
    )
    reply = command(capsys, "study", "calibrate", own, own, "-o", own.parent / "logs")
    assert_refused(reply, "R1", "more than one log")
