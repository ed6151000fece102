"""Tests of `mapfusion.landmark_map`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mapfusion.align.correspondences import match
from mapfusion.errors import InputError
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.landmark_map import LandmarkMap, joint_path, read_map, write_map


def joint_map(n: int = 5, rank: int = 4, seed: int = 0) -> LandmarkMap:
    rng = np.random.default_rng(seed)
    root = 0.01 * rng.normal(size=(n, 3, 3))
    joint = JointCovariance(root @ np.swapaxes(root, 1, 2), rng.normal(size=(n, rank, 3)))
    counts = np.full(n, 4, np.int32)
    position = rng.normal(size=(n, 3))
    return LandmarkMap(position, joint.marginal_m2, counts, np.arange(n), name="R1", joint=joint)


@pytest.mark.parametrize(("n", "rank"), [(5, 4), (1, 1), (5, 0), (0, 3), (0, 0)])
def test_round_trip(tmp_path: Path, n: int, rank: int) -> None:
    """Own covariances are read bit for bit; without shared variables one of zeros is read."""
    written = joint_map(n, rank)
    assert written.joint is not None
    write_map(tmp_path / "R1.parquet", written)
    assert (tmp_path / "R1.joint.parquet").is_file()
    read = read_map(tmp_path / "R1.parquet").joint
    assert read is not None
    np.testing.assert_array_equal(read.own_m2, written.joint.own_m2)
    assert read.rank == max(rank, 1)
    np.testing.assert_array_equal(
        read.common_m[:, :rank], written.joint.common_m.astype(np.float32)
    )
    np.testing.assert_allclose(read.marginal_m2, written.covariance_m2, rtol=0, atol=1e-6)


def test_a_map_without_one_leaves_none_of_an_earlier_map(tmp_path: Path) -> None:
    path, landmarks = tmp_path / "R1.parquet", joint_map()
    write_map(path, landmarks)
    write_map(path, replace(landmarks, joint=None))
    assert not joint_path(path).exists()
    assert read_map(path).joint is None


def test_a_damaged_one_is_named(tmp_path: Path) -> None:
    path = tmp_path / "R1.parquet"
    write_map(path, joint_map())
    data = bytearray(joint_path(path).read_bytes())
    data[len(data) // 2] ^= 0xFF
    joint_path(path).write_bytes(data)
    with pytest.raises(InputError, match=r"R1\.joint\.parquet: damaged"):
        read_map(path)
    joint_path(path).write_bytes(path.read_bytes())
    with pytest.raises(InputError, match=r"R1\.joint\.parquet: kind is landmark_map"):
        read_map(path)


@pytest.mark.parametrize(
    ("other", "told"),
    [(joint_map(4), "of 4 landmarks, R1.parquet has 5"), (joint_map(seed=1), "in row 0")],
)
def test_that_of_another_map_is_refused(tmp_path: Path, other: LandmarkMap, told: str) -> None:
    write_map(tmp_path / "other.parquet", other)
    write_map(tmp_path / "R1.parquet", joint_map())
    (tmp_path / "other.joint.parquet").replace(tmp_path / "R1.joint.parquet")
    with pytest.raises(InputError, match=rf"R1\.joint\.parquet: .*{told}.*; remove it"):
        read_map(tmp_path / "R1.parquet")


def a_map(descriptor=True, label=True, n=5, planar=False):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(n, 3, 3))
    return LandmarkMap(
        rng.normal(size=(n, 3)),
        root @ np.swapaxes(root, 1, 2),
        rng.integers(1, 9, n).astype(np.int32),
        rng.integers(0, 99, n).astype(np.int64),
        rng.normal(size=(n, 64)).astype(np.float32) if descriptor else None,
        rng.integers(0, 9, n).astype(np.int32) if label else None,
        planar,
        "north",
    )


@pytest.mark.parametrize("optional", [True, False])
@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("n", [1, 5])
def test_round_trip_landmark_map(tmp_path, optional, planar, n):
    written = a_map(optional, optional, n, planar)
    write_map(tmp_path / "map.parquet", written)
    read = read_map(tmp_path / "map.parquet")
    for name in LandmarkMap.__dataclass_fields__:
        np.testing.assert_equal(getattr(read, name), getattr(written, name))


@pytest.mark.parametrize("name", ["map.parquet", "map.csv"])
def test_attributes_round_trip(tmp_path, name):
    size_m, category = np.array([0.3, np.nan, 1.5]), np.array([2, -1, 0], np.int32)
    written = replace(a_map(n=3), size_m=size_m, category=category)
    write_map(tmp_path / name, written)
    read = read_map(tmp_path / name)
    np.testing.assert_array_equal(read.size_m, size_m)
    np.testing.assert_array_equal(read.category, category)
    some = read[np.array([2, 0])]
    np.testing.assert_array_equal(some.size_m, size_m[[2, 0]])


@pytest.mark.parametrize(("column", "value"), [("size_m", 0.0), ("category", -2)])
def test_an_unusable_attribute_is_named(tmp_path, column, value):
    frame = pd.DataFrame({"x_m": [0.0, 1.0], "y_m": 0.0, "cov_xx_m2": 1.0, "cov_xy_m2": 0.0})
    frame = frame.assign(cov_yy_m2=1.0, **{column: [1, value]})
    frame.to_csv(tmp_path / "map.csv", index=False)
    with pytest.raises(InputError, match=rf"column {column}: is {value:g} in row 1"):
        read_map(tmp_path / "map.csv")


def test_empty_map_round_trips(tmp_path):
    write_map(tmp_path / "map.parquet", a_map(n=0))
    assert len(read_map(tmp_path / "map.parquet")) == 0


def test_rows_keep_all_that_belongs_to_them():
    landmarks = a_map()
    some = landmarks[np.array([3, 1])]
    assert (len(some), some.name, some.planar) == (2, "north", False)
    for name in (
        "position_m",
        "covariance_m2",
        "count",
        "source_observation",
        "descriptor",
        "label",
    ):
        np.testing.assert_array_equal(getattr(some, name), getattr(landmarks, name)[[3, 1]])


def test_readable_with_plain_pandas(tmp_path):
    landmarks = a_map()
    write_map(tmp_path / "map.parquet", landmarks)
    frame = pd.read_parquet(tmp_path / "map.parquet")
    np.testing.assert_array_equal(frame[["x_m", "y_m", "z_m"]], landmarks.position_m)
    np.testing.assert_array_equal(frame["cov_xy_m2"], landmarks.covariance_m2[:, 0, 1])


def test_unusable_file_is_named(tmp_path):
    path = tmp_path / "map.parquet"
    with pytest.raises(InputError, match=r"map\.parquet: no such file"):
        read_map(path)
    write_map(path, a_map())
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"map\.parquet: damaged"):
        read_map(path)
    spoilt = a_map()
    spoilt.position_m[2, 0] = np.inf
    write_map(path, spoilt)
    with pytest.raises(InputError, match=r"map\.parquet: column x_m: is inf in row 2; give a"):
        read_map(path)


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("cov_yz_m2", np.nan, "is nan in row 3; give a finite number"),
        ("count", 0, "is 0 in row 3; a landmark has at least one observation"),
        ("source_observation", -2, "is -2 in row 3; give -1 for none"),
        ("label", -5, "is -5 in row 3; labels are -1 for none"),
    ],
)
def test_a_cell_that_is_not_as_documented_is_named(tmp_path, column, value, said):
    path = tmp_path / "map.parquet"
    write_map(path, a_map())
    rows = pd.read_parquet(path)
    rows.loc[3, column] = value
    rows.to_parquet(path)
    with pytest.raises(InputError, match=f"column {column}: {said}"):
        read_map(path)


def test_wrong_arguments_are_named():
    landmarks = a_map()
    for name in ("covariance_m2", "count", "source_observation", "descriptor", "label"):
        with pytest.raises(ValueError, match=name):
            replace(landmarks, **{name: getattr(landmarks, name)[:2]})
    with pytest.raises(ValueError, match="position_m"):
        replace(landmarks, position_m=np.full((5, 3), np.nan))


@pytest.mark.parametrize(
    ("name", "called"),
    [
        ("a", "map a"),
        ("map 1", "map 1"),
        ("map", "map"),
        ("Map_2", "Map_2"),
        ("maple", "map maple"),
    ],
)
def test_no_message_says_map_twice(name: str, called: str) -> None:
    covariance = np.tile(np.eye(3), (2, 1, 1))
    each = LandmarkMap(np.zeros((2, 3)), covariance, np.ones(2, int), np.arange(2), name=name)
    assert each.called == called
    other = replace(each, name="b", descriptor=np.ones((2, 64), np.float32))
    labelled = replace(each, label=np.arange(2, dtype=np.int32))
    shortage = match(labelled, other).shortage
    assert f"{called} only labels" in shortage
    assert "map map " not in shortage
