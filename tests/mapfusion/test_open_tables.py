"""Maps and logs by numpy and pandas alone, in every shape that these give to a table."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mapfusion import robot_log
from mapfusion.errors import InputError
from mapfusion.landmark_map import read_map
from mapfusion.robot_log import read_log, read_truth

N = 30


def plain_map(rng, **more):
    frame = pd.DataFrame(rng.uniform(-5, 5, (N, 3)), columns=["x_m", "y_m", "z_m"])
    for name in ("cov_xx_m2", "cov_yy_m2", "cov_zz_m2"):
        frame[name] = 0.01
    return frame.assign(cov_xy_m2=0.0, cov_xz_m2=0.0, cov_yz_m2=0.0, **more)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def write(frame, path):
    if path.suffix == ".csv":
        frame.to_csv(path, index=False)
    else:
        frame.to_parquet(path)
    return path


@pytest.mark.parametrize("name", ["m.parquet", "m.csv"])
def test_a_map_without_anything_optional(tmp_path, rng, name):
    frame = plain_map(rng)
    landmarks = read_map(write(frame, tmp_path / name))
    np.testing.assert_allclose(landmarks.position_m, frame[["x_m", "y_m", "z_m"]], rtol=1e-15)
    assert (landmarks.name, landmarks.planar) == ("m", False)
    assert landmarks.descriptor is None
    assert landmarks.label is None
    assert (landmarks.count == 1).all()
    assert (landmarks.source_observation == -1).all()


def test_without_heights_a_map_is_planar(tmp_path, rng):
    frame = plain_map(rng).drop(columns=["z_m", "cov_xz_m2", "cov_yz_m2", "cov_zz_m2"])
    landmarks = read_map(write(frame, tmp_path / "m.parquet"))
    assert landmarks.planar
    assert not landmarks.position_m[:, 2].any()
    write(frame.assign(z_m=0.0), tmp_path / "m.parquet")
    with pytest.raises(InputError, match=r"no column cov_xz_m2, .*, cov_zz_m2; .*formats\.md"):
        read_map(tmp_path / "m.parquet")


@pytest.mark.parametrize(
    "kind",
    [pa.list_(pa.float64()), pa.large_list(pa.float32()), pa.list_(pa.float64(), 64)],
    ids=["list", "large list", "fixed list of doubles"],
)
def test_lists_and_numbers_of_any_type(tmp_path, rng, kind):
    look = rng.normal(size=(N, 64)).astype(np.float32)
    label = pd.array([1, None, *range(2, N)], dtype="Int64")
    frame = plain_map(rng, label=label, count=np.float32(3)).astype({"x_m": np.float32})
    rows = [None if i == 4 else row for i, row in enumerate(look.tolist())]
    table = pa.Table.from_pandas(frame).append_column("descriptor", pa.array(rows, kind))
    pq.write_table(table, tmp_path / "m.parquet")
    landmarks = read_map(tmp_path / "m.parquet")
    assert landmarks.label[:3].tolist() == [1, -1, 2]
    assert set(landmarks.count.tolist()) == {3}
    assert np.isnan(landmarks.descriptor[4]).all()
    np.testing.assert_array_equal(landmarks.descriptor[5:], look[5:])


def test_descriptors_in_csv(tmp_path, rng):
    look = pd.DataFrame(rng.normal(size=(N, 64)), columns=[f"descriptor_{i}" for i in range(64)])
    landmarks = read_map(write(plain_map(rng).join(look), tmp_path / "m.csv"))
    np.testing.assert_allclose(landmarks.descriptor, look, rtol=1e-6)


def spoilt(frame, column, value, row=7):
    frame = frame.copy()
    frame[column] = frame[column].astype(object)
    frame.loc[row, column] = value
    return frame.infer_objects()


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("x_m", np.nan, "column x_m: is nan in row 7"),
        ("x_m", None, "column x_m: is nan in row 7"),
        ("x_m", 1e30, "position_m: above 1e[+]07 m in row 7"),
        ("cov_xx_m2", 1e30, "covariance_m2: above 100000 m squared in row 7"),
        ("cov_xx_m2", -1.0, "covariance_m2: not positive definite in row 7"),
        ("cov_xy_m2", 0.011, "covariance_m2: not positive definite in row 7"),
        ("cov_zz_m2", 0.0, "covariance_m2: not positive definite in row 7"),
        ("count", 2.5, "column count: .*truncated"),
        ("count", 2**40, "column count: .*not in range"),
    ],
)
def test_values_nothing_can_be_computed_with(tmp_path, rng, column, value, message):
    frame = spoilt(plain_map(rng, count=3), column, value)
    with pytest.raises(InputError, match=message) as caught:
        read_map(write(frame, tmp_path / "m.parquet"))
    assert str(tmp_path / "m.parquet") in str(caught.value)


def test_tables_that_are_wrong_as_a_whole(tmp_path, rng):
    frame, path = plain_map(rng), tmp_path / "m.parquet"
    cases = {
        "row 30 repeats row 3": pd.concat([frame, frame[3:4]]),
        "no column x_m, y_m;": frame.drop(columns=["x_m", "y_m"]),
        "column x_m holds .*string, not numbers": frame.assign(x_m="near"),
        "descriptor: lists of .3. numbers": frame.assign(descriptor=[[1.0, 2.0, 3.0]] * N),
        "descriptor": frame.assign(descriptor="like a door"),
    }
    for message, spoilt_frame in cases.items():
        with pytest.raises(InputError, match=message):
            read_map(write(spoilt_frame, path))
    pq.write_table(pa.table([[1.0], [2.0]], names=["x_m", "x_m"]), path)
    with pytest.raises(InputError, match="two columns x_m"):
        read_map(path)
    table = pa.Table.from_pandas(frame).replace_schema_metadata({b"mapfusion.kind": b"\xff"})
    pq.write_table(table, path)
    with pytest.raises(InputError, match="no UTF-8"):
        read_map(path)
    for data in (b"a,b\n1,2,3\n", b"a,\xff\n1,2\n"):
        (tmp_path / "m.csv").write_bytes(data)
        with pytest.raises(InputError, match="not readable as CSV"):
            read_map(tmp_path / "m.csv")


def plain_log(folder: Path, rng, kind):
    frames = {"iteration": np.arange(4), "time_s": np.arange(4) * 0.1}
    frames |= dict.fromkeys(("odometry_x_m", "odometry_y_m", "odometry_theta_rad"), 0.0)
    poses = {"iteration": np.arange(4), "x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0}
    seen = plain_map(rng, iteration=np.sort(rng.integers(0, 4, N)))
    tables = {"frames": frames, "observations": seen, "truth_poses": poses}
    tables["truth_points"] = seen[["x_m", "y_m", "z_m"]]
    folder.mkdir(exist_ok=True)
    for name, columns in tables.items():
        write(pd.DataFrame(columns), folder / f"{name}.{kind}")
    return tables


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_a_log_and_its_truth(tmp_path, rng, kind):
    plain_log(tmp_path / "north", rng, kind)
    log = read_log(tmp_path / "north")
    assert (log.robot, log.planar, len(log), len(log.observations)) == ("north", False, 4, N)
    truth = read_truth(tmp_path / "north")
    np.testing.assert_array_equal(truth.point_world_m, log.observations.position_m)


@pytest.mark.parametrize(
    ("table", "column", "value", "message"),
    [
        ("frames", "iteration", 1, r"frames.parquet: iteration is 1 in row 2"),
        ("frames", "time_s", np.inf, "column time_s: is inf in row 2"),
        ("observations", "iteration", None, "observations.parquet: column iteration is empty"),
        ("observations", "cov_xx_m2", 0.0, "observations.parquet: covariance_m2: not positive"),
        ("truth_poses", "iteration", 3, "truth_poses.parquet: iteration is 3 in row 2"),
        ("truth_poses", "theta_rad", np.nan, "truth_poses.parquet: the truth is known in part"),
        ("truth_points", "x_m", np.inf, "truth_points.parquet: the truth is infinite"),
    ],
)
def test_logs_nothing_can_be_computed_with(tmp_path, rng, table, column, value, message):
    tables = plain_log(tmp_path, rng, "parquet")
    frame = pd.DataFrame(tables[table])
    write(spoilt(frame, column, value, 2), tmp_path / f"{table}.parquet")
    read = read_truth if table.startswith("truth") else read_log
    with pytest.raises(InputError, match=message):
        read(tmp_path)


def test_an_observation_that_is_there_twice(tmp_path, rng):
    seen = plain_log(tmp_path, rng, "parquet")["observations"]
    write(pd.concat([seen[:6], seen[5:]]), tmp_path / "observations.parquet")
    with pytest.raises(InputError, match="observations: row 6 repeats row 5"):
        read_log(tmp_path)


def test_what_is_told_of_columns_is_not_written_into_files(tmp_path, rng):
    plain_log(tmp_path / "a", rng, "parquet")
    robot_log.write_log(tmp_path / "b", read_log(tmp_path / "a"))
    stored = pq.read_schema(tmp_path / "b" / "observations.parquet")
    assert not any(field.metadata and b"about" in field.metadata for field in stored)
