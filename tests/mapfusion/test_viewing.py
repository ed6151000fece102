"""Tests of `mapfusion.viewing`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapfusion.errors import InputError
from mapfusion.landmark_map import read_map, write_map
from mapfusion.robot_log import Observations, RobotLog
from mapfusion.viewing import BEARINGS, RANGES, Viewing, bearing_bin, viewing_of_log, viewing_paths
from tests.mapfusion.verification.two_rooms import FARTHEST_M, HALF_VIEW_RAD, Wall, mapped


def evidence(last_x: float = 6.0) -> tuple[Viewing, np.ndarray]:
    landmarks = mapped(Wall(8, seed=1), 2, last_x, seed=2, noise_m=1e-6)
    assert landmarks.viewing is not None
    return landmarks.viewing, landmarks.position_m


def test_directions_and_distances_are_means_over_the_frames_that_saw_them() -> None:
    viewing, position = evidence()
    for k in range(0, len(viewing), 7):
        apart = position[k, :2] - viewing.pose[:, :2]
        bearing = np.arctan2(apart[:, 1], apart[:, 0]) - viewing.pose[:, 2]
        range_m = np.hypot(*apart.T)
        seen = (np.abs(bearing) < HALF_VIEW_RAD) & (range_m < FARTHEST_M)
        assert viewing.n_views[k] == seen.sum()
        assert viewing.distance_m[k] == pytest.approx(range_m[seen].mean(), abs=1e-4)
        assert viewing.direction_rad[k] == pytest.approx(
            (bearing + viewing.pose[:, 2])[seen].mean(), abs=0.01
        )


def test_it_reaches_as_far_as_landmarks_were_seen() -> None:
    """A wall 3 m ahead: 3 m / cos(bearing), as nearly as landmarks lie in each part."""
    viewing, _ = evidence()
    low, high = viewing.field.bearing_rad
    assert -HALF_VIEW_RAD <= low < -0.9 * HALF_VIEW_RAD
    assert 0.9 * HALF_VIEW_RAD < high <= HALF_VIEW_RAD
    middle = low + (np.arange(BEARINGS) + 0.5) * (high - low) / BEARINGS
    seen = viewing.reach_m > 0
    expected = np.broadcast_to(3 / np.cos(middle), viewing.reach_m.shape)
    np.testing.assert_allclose(viewing.reach_m[seen], expected[seen], atol=0.15)
    assert seen.mean() > 0.4
    assert viewing.field.range_m == pytest.approx([3.0, 3.0 / np.cos(HALF_VIEW_RAD)], abs=0.05)


@pytest.mark.parametrize("n", [1, 2, 7, 200, 3001])
def test_a_field_of_view_ends_at_quantiles(n: int) -> None:
    """Ranges, bearings and heights equal NumPy's to the last bit."""
    rng, stray = np.random.default_rng(n), (0.005, 1 - 0.005)
    position = rng.normal(size=(n, 3)) * [3, 2, 0.5] + [9, 0, 0]
    observations = Observations(position, np.tile(np.eye(3), (n, 1, 1)))
    log = RobotLog("R", False, np.zeros(1), np.zeros((1, 3)), np.zeros(n, int), observations)
    none = np.empty(0, dtype=np.int64)
    field = viewing_of_log(log.iteration, position, np.full(n, -1), np.zeros((1, 3)), none).field
    bearing = np.arctan2(position[:, 1], position[:, 0])
    np.testing.assert_array_equal(field.bearing_rad, np.quantile(bearing, stray))
    range_m = np.hypot(position[:, 0], position[:, 1])
    np.testing.assert_array_equal(field.range_m, np.quantile(range_m, stray))
    step, told = field.range_m[1] / RANGES, 0
    for k, ends in enumerate(field.height_m):
        own = position[(k * step <= range_m) & (range_m < (k + 1) * step), 2]
        if len(own) < 20:
            assert ends[0] > ends[1]
        else:
            np.testing.assert_array_equal(ends, np.quantile(own, stray))
            told += 1
    assert told >= (3 if n > 1000 else 0)


def test_bearings_beyond_the_field_of_view_are_in_its_last_parts() -> None:
    field = evidence()[0].field
    low, high = field.bearing_rad
    edges = bearing_bin(np.array([low - 1, low, high, high + 1]), field)
    assert edges.tolist() == [0, 0, BEARINGS - 1, BEARINGS - 1]


def test_some_landmarks_of_a_map_keep_theirs_and_all_frames() -> None:
    landmarks = mapped(Wall(8, seed=1), 2, 4, seed=2)
    rows = np.array([5, 2])
    some, viewing = landmarks[rows].viewing, landmarks.viewing
    assert some is not None
    assert viewing is not None
    np.testing.assert_array_equal(some.distance_m, viewing.distance_m[rows])
    assert len(some.pose) == len(viewing.pose)
    with pytest.raises(ValueError, match="viewing: of 2 landmarks"):
        landmarks.__class__(**{**vars(landmarks), "viewing": some})


def test_joined_landmarks_are_turned() -> None:
    viewing, _ = evidence()
    both = viewing.joined(viewing[:3], np.pi / 2)
    assert len(both) == len(viewing) + 3
    turned = viewing.direction_rad[:3] + np.pi / 2
    np.testing.assert_allclose(np.cos(both.direction_rad[-3:]), np.cos(turned), atol=1e-12)
    np.testing.assert_array_equal(both.pose, viewing.pose)


MAP = mapped(Wall(6, seed=3), 1, 4, seed=4)


def test_round_trip(tmp_path: Path) -> None:
    write_map(tmp_path / "R1.parquet", MAP)
    read, written = read_map(tmp_path / "R1.parquet").viewing, MAP.viewing
    assert read is not None
    assert written is not None
    for name in ("direction_rad", "distance_m", "n_views", "pose", "reach_m"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    for name, values in vars(written.field).items():
        np.testing.assert_array_equal(getattr(read.field, name), values)


def test_a_map_without_any_leaves_none_of_an_earlier_map(tmp_path: Path) -> None:
    path = tmp_path / "R1.parquet"
    write_map(path, MAP)
    write_map(path, replace(MAP, viewing=None))
    assert not any(each.exists() for each in viewing_paths(path))
    assert read_map(path).viewing is None


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    path = tmp_path / "R1.parquet"
    write_map(path, MAP)
    of_landmarks, of_frames = viewing_paths(path)
    frames = of_frames.read_bytes()
    of_frames.unlink()
    with pytest.raises(InputError, match=r"R1\.frames\.parquet: no such file"):
        read_map(path)
    of_frames.write_bytes(frames)
    write_map(tmp_path / "few.parquet", MAP[np.arange(4)])
    few, _ = viewing_paths(tmp_path / "few.parquet")
    of_landmarks.write_bytes(few.read_bytes())
    with pytest.raises(InputError, match=r"R1\.viewing\.parquet: of 4 landmarks, R1\.parquet has"):
        read_map(path)
    of_landmarks.write_bytes(of_frames.read_bytes())
    with pytest.raises(InputError, match="kind is viewed_frames, expected landmark_viewing"):
        read_map(path)
