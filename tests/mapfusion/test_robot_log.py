"""Tests of `mapfusion.robot_log`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from mapfusion.errors import InputError
from mapfusion.robot_log import (
    FILE,
    Observations,
    RobotLog,
    read_log,
    read_odometry_covariance,
    read_truth,
    write_log,
    write_observations,
    write_odometry_covariance,
    write_truth_points,
    write_truth_poses,
)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    assert read_odometry_covariance(tmp_path) is None
    root = np.random.default_rng(0).normal(size=(5, 3, 3))
    covariance = root @ root.swapaxes(1, 2)
    write_odometry_covariance(tmp_path, covariance)
    found = read_odometry_covariance(tmp_path)
    assert found is not None
    np.testing.assert_allclose(found, covariance, rtol=1e-15)
    write_odometry_covariance(tmp_path, None)
    assert not (tmp_path / FILE).exists()


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    write_odometry_covariance(tmp_path, np.tile(np.eye(3), (3, 1, 1)))
    path = tmp_path / FILE
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match=FILE):
        read_odometry_covariance(tmp_path)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda c: c.__setitem__((2, 1, 1), np.nan), "column cov_yy: is nan in row 2"),
        (lambda c: c.__setitem__((2, 1, 1), -1e-3), "not positive definite in row 2"),
    ],
)
def test_what_is_no_covariance_is_named_by_row(tmp_path: Path, spoil, said: str) -> None:
    covariance = np.tile(np.eye(3), (4, 1, 1))
    covariance[0] = 0.0  # of no motion
    write_odometry_covariance(tmp_path, covariance)
    assert read_odometry_covariance(tmp_path) is not None
    spoil(covariance)
    write_odometry_covariance(tmp_path, covariance)
    with pytest.raises(InputError, match=f"{FILE}: {said}"):
        read_odometry_covariance(tmp_path)


@pytest.mark.parametrize("n_frames", [3, 5])
def test_one_row_belongs_to_each_frame_of_the_log(tmp_path: Path, n_frames: int) -> None:
    write_odometry_covariance(tmp_path, np.tile(np.eye(3), (4, 1, 1)))
    assert read_odometry_covariance(tmp_path, 4) is not None
    with pytest.raises(InputError, match=f"{FILE}: has 4 rows, the log {n_frames} frames"):
        read_odometry_covariance(tmp_path, n_frames)


def a_log(descriptor=True, label=True, uvd=True, n=6, planar=False):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(n, 3, 3))
    observations = Observations(
        rng.normal(size=(n, 3)),
        root @ np.swapaxes(root, 1, 2),
        rng.normal(size=(n, 64)).astype(np.float32) if descriptor else None,
        rng.integers(0, 9, n).astype(np.int32) if label else None,
        rng.normal(size=(n, 3)).astype(np.float32) if uvd else None,
        rng.integers(-1, 4, n).astype(np.int32) if uvd else None,
    )
    odometry = rng.normal(size=(4, 3))
    odometry[0] = 0
    iteration = np.sort(rng.choice([0, 2, 3], n)).astype(np.int32)  # frame 1 sees nothing
    return RobotLog("north", planar, np.arange(4) * 0.1, odometry, iteration, observations)


def assert_equal(log, other):
    for name in ("robot", "planar"):
        assert getattr(log, name) == getattr(other, name)
    for name in ("time_s", "odometry", "iteration"):
        np.testing.assert_array_equal(getattr(log, name), getattr(other, name))
    for name in Observations.__dataclass_fields__:
        ours, theirs = (getattr(x.observations, name) for x in (log, other))
        assert (ours is None) == (theirs is None)
        if ours is not None:
            np.testing.assert_array_equal(ours, theirs)
            assert getattr(ours, "dtype", None) == getattr(theirs, "dtype", None)


@pytest.mark.parametrize("optional", [True, False])
@pytest.mark.parametrize("planar", [True, False])
def test_round_trip(tmp_path, optional, planar):
    log = a_log(optional, optional, optional, planar=planar)
    write_log(tmp_path / "north", log)
    assert_equal(read_log(tmp_path / "north"), log)


def test_a_log_of_the_version_before_has_no_tracks(tmp_path):
    log = a_log()
    write_log(tmp_path, log)
    earlier = pq.read_table(tmp_path / "observations.parquet").drop_columns("track")
    about = earlier.schema.metadata | {b"mapfusion.schema_version": b"1"}
    pq.write_table(earlier.replace_schema_metadata(about), tmp_path / "observations.parquet")
    without = replace(log, observations=replace(log.observations, track=None))
    assert_equal(read_log(tmp_path), without)
    later = about | {b"mapfusion.schema_version": b"4"}
    pq.write_table(earlier.replace_schema_metadata(later), tmp_path / "observations.parquet")
    with pytest.raises(InputError, match="schema_version is 4, this program reads 3"):
        read_log(tmp_path)


def test_log_that_saw_nothing(tmp_path):
    log = a_log(n=0)
    write_log(tmp_path, log)
    read = read_log(tmp_path)
    assert len(read) == 4
    assert len(read.observations) == 0
    np.testing.assert_array_equal(read.frame_starts(), np.zeros(5))


def test_frames_and_their_observations():
    log = replace(a_log(), iteration=np.array([0, 0, 2, 2, 2, 3], np.int32))
    np.testing.assert_array_equal(log.frame_starts(), [0, 2, 2, 5, 6])
    third = log.observations[slice(2, 5)]
    assert len(third) == 3
    np.testing.assert_array_equal(third.label, log.observations.label[2:5])


def test_truth_round_trip(tmp_path):
    rng = np.random.default_rng(1)
    poses, points = rng.normal(size=(4, 3)), rng.normal(size=(6, 3))
    points[2] = np.nan  # unknown
    write_truth_poses(tmp_path, poses)
    write_truth_points(tmp_path, points)
    truth = read_truth(tmp_path)
    np.testing.assert_array_equal(truth.T_world_robot, poses)
    np.testing.assert_array_equal(truth.point_world_m, points)


def test_log_holds_no_truth(tmp_path):
    write_log(tmp_path, a_log())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["frames.parquet", "observations.parquet"]
    with pytest.raises(InputError, match="truth_poses"):
        read_truth(tmp_path)


def test_tables_are_readable_with_plain_pandas(tmp_path):
    log = a_log()
    write_log(tmp_path, log)
    frame = pd.read_parquet(tmp_path / "observations.parquet")
    np.testing.assert_array_equal(frame["x_m"], log.observations.position_m[:, 0])
    np.testing.assert_array_equal(np.stack(frame["descriptor"]), log.observations.descriptor)


@pytest.mark.parametrize("name", ["frames.parquet", "observations.parquet"])
def test_missing_or_foreign_table_is_named(tmp_path, name):
    write_log(tmp_path, a_log())
    other = {"frames.parquet": "observations.parquet", "observations.parquet": "frames.parquet"}
    (tmp_path / name).write_bytes((tmp_path / other[name]).read_bytes())
    with pytest.raises(InputError, match=f"{name}: kind is robot_log"):
        read_log(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(InputError, match=f"{name}: no such file"):
        read_log(tmp_path)


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere: no such folder"):
        read_log(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("iteration", "message"),
    [
        ([3, 2, 2, 2, 0, 0], "is 2 in row 1, after 3; sort the rows"),
        ([0, 0, 0, 0, 0, 9], "is 9 in row 5, but frames.parquet ends with frame 3"),
        ([0, 0, 0, 0, 0, 4], "is 4 in row 5, but frames.parquet ends with frame 3"),
        ([-1, 0, 0, 0, 0, 0], "is -1 in row 0; frames are 0, 1, 2"),
    ],
)
def test_observations_of_no_frame_are_bad_input(tmp_path, iteration, message):
    log = a_log()
    write_log(tmp_path, log)
    write_observations(tmp_path, np.array(iteration), log.observations)
    with pytest.raises(InputError, match=message):
        read_log(tmp_path)


def read_with(folder, table, column, row, value):
    """Write a log as CSV tables, one cell replaced, and read it."""
    write_log(folder, a_log(descriptor=False))
    for name in ("frames", "observations"):
        rows = pd.read_parquet(folder / f"{name}.parquet").drop(
            columns="descriptor", errors="ignore"
        )
        if name == table:
            rows[column] = rows[column].astype(object)
            rows.loc[row, column] = value
        (folder / f"{name}.parquet").unlink()
        rows.to_csv(folder / f"{name}.csv", index=False)
    return read_log(folder)


@pytest.mark.parametrize(
    ("table", "column", "row", "value", "said"),
    [
        ("frames", "time_s", 2, 0.1, "is 0.1 in row 2, after 0.1; times must increase"),
        ("frames", "time_s", 3, 0.05, "is 0.05 in row 3, after 0.2; times must increase"),
        ("frames", "time_s", 1, "nan", "is nan in row 1"),
        ("frames", "odometry_x_m", 2, 1e300, "is 1e[+]300 in row 2; .* at most 1e[+]07 m"),
        ("frames", "odometry_y_m", 2, -1.1e7, "is -11000000 in row 2; .* at most 1e[+]07 m"),
        ("frames", "odometry_theta_rad", 3, 1e9, "is 1e[+]09 in row 3; .* in radians, is at most"),
        ("frames", "odometry_theta_rad", 3, "-inf", "is -inf in row 3"),
        ("observations", "x_m", 3, "nan", "is nan in row 3"),
        ("observations", "cov_xy_m2", 4, "inf", "is inf in row 4"),
        ("observations", "u_px", 1, "-inf", "is -inf in row 1; .* NaN for none"),
        ("observations", "label", 5, -2, "is -2 in row 5; labels are -1 for none"),
        ("observations", "track", 5, -7, "is -7 in row 5; tracks are -1 for none"),
    ],
)
def test_a_cell_that_is_not_as_documented_is_named(tmp_path, table, column, row, value, said):
    with pytest.raises(InputError, match=f"{table}.csv: column {column}: {said}"):
        read_with(tmp_path, table, column, row, value)


@pytest.mark.parametrize(
    ("column", "value"),
    [("odometry_x_m", 1e7), ("odometry_theta_rad", 360.0), ("odometry_theta_rad", -360.0)],
)
def test_values_on_the_bounds_are_read(tmp_path, column, value):
    # a turn of 360 may be one in degrees; who reads the log can say so
    log = read_with(tmp_path, "frames", column, 2, value)
    assert value in log.odometry[2]


def test_motion_before_the_first_frame_is_not_used(tmp_path):
    log = read_with(tmp_path, "frames", "odometry_x_m", 0, 5.0)
    np.testing.assert_array_equal(log.odometry, a_log(descriptor=False).odometry)


def test_half_a_descriptor_is_bad_input(tmp_path):
    log = a_log()
    write_log(tmp_path, log)
    log.observations.descriptor[2, 7:] = np.nan
    write_observations(tmp_path, log.iteration, log.observations)
    with pytest.raises(
        InputError, match=r"descriptor: number 7 is nan in row 2; .* whole cell empty"
    ):
        read_log(tmp_path)
    log.observations.descriptor[2] = np.nan  # none is fine
    write_observations(tmp_path, log.iteration, log.observations)
    assert np.isnan(read_log(tmp_path).observations.descriptor[2]).all()


def test_wrong_arguments_are_named():
    log = a_log()
    o = log.observations
    with pytest.raises(
        ValueError, match=r"covariance_m2: shape is \(5, 3, 3\), expected \(6, 3, 3\)"
    ):
        replace(o, covariance_m2=o.covariance_m2[:5])
    with pytest.raises(ValueError, match="descriptor"):
        replace(o, descriptor=o.descriptor[:, :32])
    with pytest.raises(ValueError, match="descriptor"):
        replace(o, descriptor=o.descriptor[:4])
    with pytest.raises(ValueError, match="label"):
        replace(o, label=o.label[:2])
    with pytest.raises(ValueError, match="uvd_px"):
        replace(o, uvd_px=o.uvd_px[:, :2])
    with pytest.raises(ValueError, match="odometry"):
        replace(log, odometry=log.odometry[:2])
    with pytest.raises(ValueError, match="iteration"):
        replace(log, iteration=log.iteration[:2])


def test_folders_above_logs_and_recordings_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"frames\.parquet: no such file"):
        read_log(tmp_path)
    for k in range(7):
        (tmp_path / f"R{k}").mkdir()
        (tmp_path / f"R{k}" / "frames.csv").write_text("iteration\n")
        said = "is no log; name one log, such as .*R0$"
        if k:
            more = ", ..." if k > 4 else ""
            names = ", ".join(f"R{each}" for each in range(min(k + 1, 5)))
            said = rf"is a folder of {k + 1} robot logs \({names}{more}\); name one log, such as"
        with pytest.raises(InputError, match=said):
            read_log(tmp_path)
    (tmp_path / "empty" / "ranges.csv").write_text("time_s\n")
    with pytest.raises(InputError, match=r"`mapfusion import ranges .*empty -o logs` makes a log"):
        read_log(tmp_path / "empty")
