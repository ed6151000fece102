"""The covariance of a log's odometry, on disk."""

from pathlib import Path

import numpy as np
import pytest

from mapfusion.errors import InputError
from mapfusion.robot_log import FILE, read_odometry_covariance, write_odometry_covariance


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
