"""The joint covariance beside a map's file: there, absent, damaged, of another map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

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
    """What is a landmark's own keeps every bit; no shared variable is one that moves nothing."""
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
