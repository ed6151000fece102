"""Tests of `experiments.pipeline.stages.smooth`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.slam import ASSOCIATIONS, FINDINGS, POSES, Associations
from experiments.pipeline.stages.smooth import (
    WRITES,
    SmoothSettings,
    fused_iterations,
    iterations_of,
    log_until,
    map_files,
    parts,
    read_endings,
    read_smoothed,
    read_smoothed_path,
    run,
)
from experiments.pipeline.tables import write_rows
from mapfusion.errors import DamagedFileError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.files import POSE_FIELDS
from mapfusion.robot_log import (
    RobotLog,
    read_odometry_covariance,
    write_log,
    write_odometry_covariance,
)
from mapfusion.smoother.smooth import SmootherParameters, smooth, smoothed_map
from tests.mapfusion.smoother.white_noise_logs import dead_reckoned, white_noise_log

N_FRAMES, CHANGED_AT = 40, 20
STATED = MotionNoise()


def owners(log: RobotLog) -> np.ndarray:
    """Return the first observation of the landmark of each observation."""
    assert log.observations.label is not None
    _, first, inverse = np.unique(log.observations.label, return_index=True, return_inverse=True)
    return first[inverse]


def filtered(
    folder: Path, log: RobotLog, owner: np.ndarray, noise_factor: float = 1.0
) -> dict[str, Path]:
    """A log and what a filter left of it, which till `CHANGED_AT` took all for one landmark."""
    write_log(folder / "log", log)
    at = np.maximum(log.iteration, CHANGED_AT)
    rows = {"from_iteration": at, "observation": np.arange(len(owner)), "source_observation": owner}
    early = np.flatnonzero(log.iteration < CHANGED_AT)
    wrong = {"from_iteration": log.iteration[early], "observation": early, "source_observation": 0}
    changes = pd.concat([pd.DataFrame(wrong), pd.DataFrame(rows)]).sort_values("from_iteration")
    write_rows(folder / "slam" / "associations.parquet", ASSOCIATIONS, changes)
    poses = pd.DataFrame(dead_reckoned(log), columns=[f"final_{name}" for name in POSE_FIELDS])
    poses = poses.assign(iteration=np.arange(len(poses)), resampled=False, n_landmarks=0)
    write_rows(folder / "slam" / "poses.parquet", POSES, poses)
    write_rows(
        folder / "slam" / "findings.parquet", FINDINGS, [], {"noise_factor": str(noise_factor)}
    )
    return {"log": folder / "log", "slam": folder / "slam"}


def smoothed_at(
    inputs: dict[str, Path],
    folder: Path,
    *iterations: int,
    max_memory_gb: float = 1.0,
    motion: MotionNoise = STATED,
) -> None:
    settings = SmoothSettings(SmootherParameters(motion), 0.0, iterations, max_memory_gb)
    for part in parts(iterations):
        run(settings, Job(inputs, folder, part))


def test_it_is_the_smoother_on_the_log_so_far(tmp_path: Path) -> None:
    log = white_noise_log(np.random.default_rng(0), N_FRAMES, 25).log
    owner = owners(log)
    inputs, k = filtered(tmp_path, log, owner), 30
    smoothed_at(inputs, tmp_path / "out", k, N_FRAMES - 1)
    maps, paths = read_smoothed(tmp_path / "out"), read_smoothed_path(tmp_path / "out")
    assert list(maps) == list(paths) == [k, N_FRAMES - 1]
    early = log_until(log, k)
    assert early.iteration.max() == k
    seen = owner[: len(early.observations)]
    alone = smooth(early, seen, dead_reckoned(early), SmootherParameters())
    np.testing.assert_allclose(paths[k], alone.estimate.path, atol=1e-9)
    expected = smoothed_map(early, alone)
    np.testing.assert_allclose(maps[k].position_m, expected.position_m, atol=1e-9)
    np.testing.assert_allclose(maps[k].covariance_m2, expected.covariance_m2, atol=1e-9)
    np.testing.assert_array_equal(maps[k].source_observation, expected.source_observation)
    assert maps[k].joint is not None
    last_whole = read_smoothed(tmp_path / "out", only_last_joint=True)
    assert last_whole[k].joint is None
    assert last_whole[N_FRAMES - 1].joint is not None
    assert len(maps[N_FRAMES - 1]) >= len(maps[k]) > 5
    assert read_endings(tmp_path / "out")["n_steps"].min() >= 1


def test_smoother_has_the_motion_noise_of_the_filter(tmp_path: Path) -> None:
    log = white_noise_log(np.random.default_rng(0), N_FRAMES, 25).log
    last, given = N_FRAMES - 1, {}
    for name, factor in (("estimated", 3.0), ("stated", 1.0)):
        given[name] = filtered(tmp_path / name, log, owners(log), factor)
        smoothed_at(given[name], tmp_path / name / "out", last)
    told = STATED.scaled(3.0)
    smoothed_at(given["stated"], tmp_path / "told" / "out", last, motion=told)
    names = ("estimated", "told", "stated")
    paths = [read_smoothed_path(tmp_path / name / "out")[last] for name in names]
    np.testing.assert_array_equal(paths[0], paths[1])
    assert not np.array_equal(paths[0], paths[2])


def test_associations_are_those_of_the_filter_at_that_time(tmp_path: Path) -> None:
    log = white_noise_log(np.random.default_rng(1), N_FRAMES, 25).log
    associations = Associations.read(filtered(tmp_path, log, owners(log))["slam"])
    n = len(log_until(log, CHANGED_AT - 1).observations)
    np.testing.assert_array_equal(associations.at(CHANGED_AT - 1, n), np.zeros(n))
    n = len(log_until(log, CHANGED_AT).observations)
    np.testing.assert_array_equal(associations.at(CHANGED_AT, n), owners(log)[:n])
    whole = associations.at(CHANGED_AT, len(log.observations))
    np.testing.assert_array_equal(whole[log.iteration > CHANGED_AT], -1)


@pytest.mark.parametrize("planar", [False, True])
def test_a_robot_that_saw_nothing_has_an_empty_map(tmp_path: Path, planar: bool) -> None:
    log = white_noise_log(np.random.default_rng(2), N_FRAMES, 25, planar).log
    inputs = filtered(tmp_path, log, np.full(len(log.observations), -1))
    smoothed_at(inputs, tmp_path / "out", N_FRAMES - 1)
    (found,) = read_smoothed(tmp_path / "out").values()
    assert (len(found), found.planar, found.name) == (0, planar, log.robot)
    path = read_smoothed_path(tmp_path / "out")[N_FRAMES - 1]
    np.testing.assert_allclose(path, dead_reckoned(log), atol=1e-9)


def test_a_log_too_long_for_the_memory_given_has_no_map(tmp_path: Path) -> None:
    log = white_noise_log(np.random.default_rng(3), N_FRAMES, 25).log
    inputs = filtered(tmp_path, log, owners(log))
    smoothed_at(inputs, tmp_path / "out", 5, N_FRAMES - 1, max_memory_gb=1e-4)
    assert list(read_smoothed(tmp_path / "out")) == [5]
    reasons = read_endings(tmp_path / "out").set_index("iteration")["not_smoothed"]
    assert reasons[5] == ""
    assert "smooth.max_memory_gb is 0.0001" in reasons[N_FRAMES - 1]
    assert not any(path.exists() for path in map_files(tmp_path / "out", N_FRAMES - 1))


def test_all_that_is_promised_is_written_whether_smoothed_or_not(tmp_path: Path) -> None:
    log = white_noise_log(np.random.default_rng(3), N_FRAMES, 25).log
    smoothed_at(filtered(tmp_path, log, owners(log)), tmp_path / "out", 5, 39, max_memory_gb=1e-4)
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {name.format(part=k) for name in WRITES for k in (5, 39)} <= written
    assert {path.name for path in map_files(tmp_path / "out", 5)} <= written


@pytest.mark.parametrize("which", range(4))
def test_a_file_of_a_map_that_was_removed_is_damage(tmp_path: Path, which: int) -> None:
    log = white_noise_log(np.random.default_rng(3), N_FRAMES, 25).log
    smoothed_at(filtered(tmp_path, log, owners(log)), tmp_path / "out", 5)
    removed = map_files(tmp_path / "out", 5)[which]
    removed.unlink()
    with pytest.raises(DamagedFileError, match=f"{removed.name}: is missing"):
        read_smoothed(tmp_path / "out")


def test_fused_iterations_are_evaluated_ones() -> None:
    assert fused_iterations(1200, 25, None) == [250, 475, 725, 950, 1199]
    assert fused_iterations(1200, 25, 500) == [500, 1000, 1199]
    assert fused_iterations(44, 20, None) == [20, 40, 43]
    assert fused_iterations(2, 25, None) == [1]
    assert iterations_of(700, [250, 475, 725, 950, 1199]) == (250, 475, 699)
    assert iterations_of(1200, [500, 1199]) == (500, 1199)


def test_odometry_that_pictures_told_does_not_count_twice(tmp_path: Path) -> None:
    """With a covariance of its own beside the log, right and wrong odometry end in one path."""
    known = white_noise_log(np.random.default_rng(0), N_FRAMES, 200)
    wrong = replace(known.log, odometry=known.log.odometry * [1.5, 1, 1])
    apart = []
    for covariance in (None, np.tile(1e-12 * np.eye(3), (N_FRAMES, 1, 1))):
        write_odometry_covariance(tmp_path, covariance)
        told = read_odometry_covariance(tmp_path)
        own = SmootherParameters(stray_m=0.0, odometry_covariance=told)
        right, pulled = (
            smooth(log, owners(log), known.path, own).estimate.path for log in (known.log, wrong)
        )
        apart.append(np.abs(pulled - right)[:, :2].max())
    assert apart[0] > 0.003  # its level tells how wrong it is, so that it weighs little
    assert apart[1] < 0.001


def test_frames_that_see_nothing_hang_on_what_pictures_told(tmp_path: Path) -> None:
    """Tracks last some frames before any is observed: there the odometry is all there is."""
    known = white_noise_log(np.random.default_rng(0), N_FRAMES, 200)
    later = known.log.iteration >= 2
    log = replace(
        known.log, iteration=known.log.iteration[later], observations=known.log.observations[later]
    )
    told = np.tile(np.diag([1e-4, 1e-4, 1e-6]), (N_FRAMES, 1, 1))
    write_odometry_covariance(tmp_path, told)
    own = SmootherParameters(stray_m=0.0, odometry_covariance=read_odometry_covariance(tmp_path))
    made = smooth(log, owners(known.log)[later], known.path, own)
    assert np.hypot(*(made.estimate.path - known.path)[2, :2]) < 0.1
    # the way to the first frame that sees is known to 2 cm, and so is the map in its frame
    variance = np.diag(made.joint_covariance()).reshape(-1, 3)
    sigma = np.sqrt(variance[:, :2].sum(axis=1))
    assert np.median(sigma) < 0.1
