from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from mapfusion.errors import InputError
from mapfusion.landmark_map import LandmarkMap, read_map, write_map


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
def test_round_trip(tmp_path, optional, planar, n):
    written = a_map(optional, optional, n, planar)
    write_map(tmp_path / "map.parquet", written)
    read = read_map(tmp_path / "map.parquet")
    for name in LandmarkMap.__dataclass_fields__:
        np.testing.assert_equal(getattr(read, name), getattr(written, name))


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
    with pytest.raises(InputError, match=r"map\.parquet: column x_m is inf in row 2"):
        read_map(path)


def test_wrong_arguments_are_named():
    landmarks = a_map()
    for name in ("covariance_m2", "count", "source_observation", "descriptor", "label"):
        with pytest.raises(ValueError, match=name):
            replace(landmarks, **{name: getattr(landmarks, name)[:2]})
    with pytest.raises(ValueError, match="position_m"):
        replace(landmarks, position_m=np.full((5, 3), np.nan))
