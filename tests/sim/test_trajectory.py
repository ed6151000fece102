"""Tests of `sim.trajectory`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mapfusion.errors import InputError
from mapfusion.geometry.se3 import in_space
from sim.trajectory import (
    TRAJECTORY,
    AttitudeNoise,
    BodySway,
    Trajectory,
    read_trajectory,
    write_trajectory,
)

RNG = np.random.default_rng(0)
TRAJECTORY_OF_TWO = Trajectory(
    ("b", "a"), np.arange(5) * 0.25, RNG.normal(size=(2, 5, 3)), RNG.normal(size=(2, 5, 2))
)


def test_written_and_read_it_is_the_same(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t.parquet", TRAJECTORY_OF_TWO)
    back = read_trajectory(tmp_path / "t.parquet")
    assert back.robots == ("b", "a")
    for name in ("time_s", "T_world_robot", "wheel_rad"):
        np.testing.assert_array_equal(getattr(back, name), getattr(TRAJECTORY_OF_TWO, name))
    assert len(back) == 5
    assert back.index("a") == 1


def test_readable_with_plain_pandas(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t.parquet", TRAJECTORY_OF_TWO)
    table = pd.read_parquet(tmp_path / "t.parquet")
    row = table[(table["robot"] == "a") & (table["iteration"] == 3)].iloc[0]
    assert row["time_s"] == 0.75
    pose = row[["x_m", "y_m", "theta_rad"]].to_numpy(dtype=float)
    np.testing.assert_array_equal(pose, TRAJECTORY_OF_TWO.T_world_robot[1, 3])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([*range(5), *range(5, 9)], "rows must be ordered"),
        ([1, 0, *range(2, 10)], "rows must be ordered"),
        ([0, 5, 1, 6, 2, 7, 3, 8, 4, 9], "rows must be ordered"),
        ([], "holds no rows"),
    ],
)
def test_disordered_rows_are_refused(tmp_path: Path, rows: list[int], message: str) -> None:
    path = tmp_path / "t.parquet"
    write_trajectory(path, TRAJECTORY_OF_TWO)
    pq.write_table(pq.read_table(path).take(pa.array(rows, pa.int32())), path)
    with pytest.raises(InputError, match=f"t.parquet: {message}"):
        read_trajectory(path)


def test_values_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    write_trajectory(path, TRAJECTORY_OF_TWO)
    table = pq.read_table(path)
    damaged = table.set_column(3, TRAJECTORY.field("x_m"), pa.array([np.nan] * 10))
    pq.write_table(damaged, path)
    with pytest.raises(InputError, match=r"t.parquet: T_world_robot: contains NaN"):
        read_trajectory(path)


def test_missing_file_and_unknown_robot_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_trajectory(tmp_path / "none.parquet")
    with pytest.raises(InputError, match="robot c: unknown, there are b, a"):
        TRAJECTORY_OF_TWO.index("c")


def test_names_and_times_must_make_sense() -> None:
    poses, wheels = np.zeros((2, 3, 3)), np.zeros((2, 3, 2))
    with pytest.raises(ValueError, match="a name occurs twice"):
        Trajectory(("a", "a"), np.arange(3.0), poses, wheels)
    with pytest.raises(ValueError, match="time_s: must increase"):
        Trajectory(("a", "b"), np.array([0.0, 1, 1]), poses, wheels)
    with pytest.raises(ValueError, match="wheel_rad: shape"):
        Trajectory(("a", "b"), np.arange(3.0), poses, wheels[:1])


def test_bodies_that_tilt_are_written_and_read(tmp_path: Path) -> None:
    assert TRAJECTORY_OF_TWO.bodies(1).shape == (2, 3)
    tilted = replace(TRAJECTORY_OF_TWO, tilt_rad=0.1 * RNG.normal(size=(2, 5, 2)))
    write_trajectory(tmp_path / "t.parquet", tilted)
    back = read_trajectory(tmp_path / "t.parquet")
    assert tilted.tilt_rad is not None
    assert back.tilt_rad is not None
    np.testing.assert_array_equal(back.tilt_rad, tilted.tilt_rad)
    expected = in_space(tilted.T_world_robot[:, 3], tilted.tilt_rad[:, 3])
    np.testing.assert_array_equal(back.bodies(3), expected)


def test_the_version_without_tilts_is_read(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    write_trajectory(path, TRAJECTORY_OF_TWO)
    table = pq.read_table(path)
    metadata = {**table.schema.metadata, b"mapfusion.schema_version": b"1"}
    older = table.drop_columns(["roll_rad", "pitch_rad"]).replace_schema_metadata(metadata)
    pq.write_table(older, path)
    back = read_trajectory(path)
    assert back.tilt_rad is None
    np.testing.assert_array_equal(back.T_world_robot, TRAJECTORY_OF_TWO.T_world_robot)
    pq.write_table(table.replace_schema_metadata(metadata), path)
    with pytest.raises(InputError, match=r"t\.parquet: columns are not those of trajectory"):
        read_trajectory(path)


def test_spread_and_correlation_are_as_set() -> None:
    time_s = 0.2 * np.arange(40_000)
    tilt = BodySway(0.05, 0.5).tilts(time_s, np.random.default_rng(0))
    assert tilt.std(axis=0) == pytest.approx([0.05, 0.05], rel=0.03)
    for lag in (1, 3):
        product = np.mean(tilt[lag:] * tilt[:-lag], axis=0) / 0.05**2
        assert product == pytest.approx([np.exp(-0.4 * lag)] * 2, abs=0.03)
    assert abs(np.corrcoef(tilt.T)[0, 1]) < 0.03


def test_after_a_pause_nothing_is_left() -> None:
    time_s = np.array([0.0, 1e-9, 1e6])
    drawn = [BodySway(0.05).tilts(time_s, np.random.default_rng(k)) for k in range(4000)]
    first, soon, late = np.array(drawn)[..., 0].T
    np.testing.assert_allclose(soon, first, atol=1e-4)
    assert abs(np.corrcoef(first, late)[0, 1]) < 0.05
    assert late.std() == pytest.approx(0.05, rel=0.05)


def test_what_is_measured_errs_anew_in_each_frame() -> None:
    tilt = np.full((20_000, 2), 0.02)
    error = AttitudeNoise(sigma_rad=0.005).applied(tilt, np.random.default_rng(1)) - tilt
    assert error.std(axis=0) == pytest.approx([0.005, 0.005], rel=0.03)
    assert abs(np.mean(error[1:] * error[:-1])) < 0.03 * 0.005**2
