"""Viewing evidence beside a map's file: there, absent, damaged, of another map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapfusion.errors import InputError
from mapfusion.landmark_map import read_map, write_map
from mapfusion.viewing import viewing_paths
from tests.mapfusion.evidence.two_rooms import Wall, mapped

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
