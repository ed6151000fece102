"""Logs that stay in memory are those on disk, and no more of them than there is room for."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.pipeline.kept_logs import KeptLogs
from mapfusion.robot_log import RobotLog, read_log, write_log
from tests.mapfusion.smoother.white_noise_logs import white_noise_log


def written(folder: Path, seed: int) -> RobotLog:
    log = white_noise_log(np.random.default_rng(seed), 20, 15).log
    write_log(folder, log)
    return read_log(folder)


def n_bytes(log: RobotLog) -> int:
    seen = log.observations
    assert seen.label is not None
    arrays = (log.time_s, log.odometry, log.iteration, seen.position_m, seen.covariance_m2)
    return sum(each.nbytes for each in (*arrays, seen.label))


def test_a_log_is_read_once(tmp_path: Path) -> None:
    expected, kept = written(tmp_path / "a", 0), KeptLogs()
    first = kept.read(tmp_path / "a")
    assert kept.read(tmp_path / "a") is first
    np.testing.assert_array_equal(first.odometry, expected.odometry)
    np.testing.assert_array_equal(first.observations.position_m, expected.observations.position_m)


def test_a_log_that_was_written_again_is_read_again(tmp_path: Path) -> None:
    log, kept = written(tmp_path / "a", 0), KeptLogs()
    kept.read(tmp_path / "a")
    write_log(tmp_path / "a", replace(log, time_s=log.time_s + 1))
    np.testing.assert_array_equal(kept.read(tmp_path / "a").time_s, log.time_s + 1)


def test_the_one_asked_for_least_recently_makes_room(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in "abc"]
    sizes = [n_bytes(written(folder, seed)) for seed, folder in enumerate(folders)]
    kept = KeptLogs(sum(sizes) - 1)
    a, b = kept.read(folders[0]), kept.read(folders[1])
    assert kept.read(folders[0]) is a
    c = kept.read(folders[2])
    assert [kept.read(folder) is log for folder, log in zip(folders, (a, b, c), strict=True)] == [
        True,
        False,
        False,  # b has taken its place
    ]


def test_a_log_that_is_too_large_is_not_kept(tmp_path: Path) -> None:
    log = written(tmp_path / "a", 0)
    kept = KeptLogs(n_bytes(log) - 1)
    assert kept.read(tmp_path / "a") is not kept.read(tmp_path / "a")
