"""Maps and logs by numpy and pandas alone, in every shape that these give to a table."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mapfusion import robot_log
from mapfusion.datasets.point_logs import LANDMARKS as SURVEY
from mapfusion.datasets.point_logs import ODOMETRY, RANGES
from mapfusion.errors import InputError, TellingWarning
from mapfusion.landmark_map import read_map
from mapfusion.robot_log import read_log, read_truth
from mapfusion.tables import read_open_table

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
    assert read_map(write(frame.assign(z_score=1.0), tmp_path / "m.parquet")).planar
    write(frame.assign(z_m=0.0), tmp_path / "m.parquet")
    with pytest.raises(InputError, match=r"no column cov_xz_m2, .*, cov_zz_m2; .*docs formats"):
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


def test_a_number_too_large_for_single_precision_is_named(tmp_path, rng):
    look = pd.DataFrame(rng.normal(size=(N, 4)), columns=[f"descriptor_{i}" for i in range(4)])
    look.loc[3, "descriptor_2"] = 1e300
    with pytest.raises(InputError, match="column descriptor: number 2 is inf in row 3"):
        read_map(write(plain_map(rng).join(look), tmp_path / "m.csv"))


def test_descriptors_are_counted_from_0_or_1_without_gaps(tmp_path, rng):
    look = rng.normal(size=(N, 70))
    for first in (0, 1):
        names = [f"descriptor_{i + first}" for i in range(64)]
        frame = plain_map(rng).join(pd.DataFrame(look[:, :64], columns=names)[names[::-1]])
        landmarks = read_map(write(frame, tmp_path / "m.csv"))
        np.testing.assert_allclose(landmarks.descriptor, look[:, :64], rtol=1e-6)
    for kept, said in (
        (range(2, 34), "32 columns descriptor_2 to descriptor_33; expected descriptor_0 to"),
        ([*range(63), 65], "64 columns descriptor_0 to descriptor_65"),
    ):
        columns = pd.DataFrame({f"descriptor_{i}": look[:, i] for i in kept})
        with pytest.raises(InputError, match=said):
            read_map(write(plain_map(rng).join(columns), tmp_path / "m.csv"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace(",", ";"), "m.csv: is separated by ';'; write it with commas"),
        (lambda text: text.replace(",", "\t"), "m.csv: is separated by tabs"),
        (str.upper, "has no column x_m, y_m, .*; rename column X_M to x_m and Y_M to y_m and COV"),
        (lambda text: text.split("\n", 1)[1], "has no header line; put one with .*[(]x_m, y_m"),
        (
            lambda text: text.replace("x_m,", "x,"),
            "has no column x_m; rename column x to x_m .mind the unit",
        ),
    ],
)
@pytest.mark.parametrize("n_columns", [1, 9])
def test_csv_of_another_dialect_is_told_what_it_is(tmp_path, rng, change, said, n_columns):
    frame = plain_map(rng)
    if n_columns == 1:  # of a planar map the names are others
        frame = frame.drop(columns=["z_m", "cov_xz_m2", "cov_yz_m2", "cov_zz_m2"])
    (tmp_path / "m.csv").write_text(change(frame.to_csv(index=False)))
    with pytest.raises(InputError, match=said):
        read_map(tmp_path / "m.csv")


def test_blanks_around_names_and_numbers_change_nothing(tmp_path, rng):
    text = plain_map(rng).to_csv(index=False)
    (tmp_path / "a.csv").write_text(text)
    (tmp_path / "b.csv").write_text(text.replace(",", " , "))
    a, b = (read_map(tmp_path / name) for name in ("a.csv", "b.csv"))
    np.testing.assert_array_equal(a.position_m, b.position_m)
    assert not b.planar


@pytest.mark.parametrize("name", ["z", "Z_M", "height_m", "Height (m)", "z_mm", "altitude"])
def test_heights_of_another_name_make_no_map_planar(tmp_path, rng, name):
    flat = plain_map(rng).drop(columns=["z_m", "cov_xz_m2", "cov_yz_m2", "cov_zz_m2"])
    for kind in ("csv", "parquet"):
        with pytest.raises(
            InputError, match=r"(rename column .* to z_m |z_mm is in millimetres: ).*or remove it"
        ):
            read_map(write(flat.assign(**{name: 1.0}), tmp_path / f"m.{kind}"))
    with pytest.raises(InputError, match="cov_zz to cov_zz_m2"):
        read_map(write(flat.assign(cov_zz=1.0), tmp_path / "m.csv"))
    with pytest.raises(InputError, match="LABEL to label"):
        read_map(write(flat.assign(LABEL=1), tmp_path / "m.csv"))


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("inf", "column x_m: is inf in row 3"),
        ("NA", "column x_m: is nan in row 3"),
        ("near", "column x_m holds 'near' in row 3, expected a number"),
        ("1e400", "column x_m: is inf in row 3"),
        (2**64, "position_m: above 1e[+]07 m in row 3"),
    ],
)
def test_cells_of_csv_that_are_no_numbers_are_named(tmp_path, rng, cell, said):
    frame = plain_map(rng).astype({"x_m": object})
    frame.loc[3, "x_m"] = cell
    with pytest.raises(InputError, match=said):
        read_map(write(frame, tmp_path / "m.csv"))
    look = pd.DataFrame(rng.normal(size=(N, 64)), columns=[f"descriptor_{i}" for i in range(64)])
    spoilt_look = look.astype({"descriptor_5": object})
    spoilt_look.loc[2, "descriptor_5"] = "inf" if cell == "inf" else "x"
    with pytest.raises(InputError, match=r"descriptor(: number 5 is inf|_5 holds 'x') in row 2"):
        read_map(write(plain_map(rng).join(spoilt_look), tmp_path / "m.csv"))
    for huge in (2**64, 10**30):
        with pytest.raises(InputError, match="column count"):
            read_map(write(plain_map(rng).assign(count=str(huge)), tmp_path / "m.csv"))


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
        ("cov_zz_m2", -np.inf, "column cov_zz_m2: is -inf in row 7"),
        ("x_m", 1e30, "position_m: above 1e[+]07 m in row 7"),
        ("cov_xx_m2", 1e30, "covariance_m2: above 100000 m squared in row 7"),
        ("cov_xx_m2", -1.0, "covariance_m2: not positive definite in row 7"),
        ("cov_xy_m2", 0.011, "covariance_m2: not positive definite in row 7"),
        ("cov_zz_m2", 0.0, "covariance_m2: not positive definite in row 7"),
        ("count", 2.5, "column count: is 2.5 in row 7, expected a whole number up to 2147483647$"),
        ("count", 2**40, "column count: is 1099511627776 in row 7, expected a whole number up to"),
        (
            "label",
            3.5,
            "column label: is 3.5 in row 7, expected a whole number .*; number the land",
        ),
    ],
)
def test_values_nothing_can_be_computed_with(tmp_path, rng, column, value, message):
    frame = spoilt(plain_map(rng, count=3, label=range(N)), column, value)
    with pytest.raises(InputError, match=message) as caught:
        read_map(write(frame, tmp_path / "m.parquet"))
    assert str(tmp_path / "m.parquet") in str(caught.value)


def test_tables_that_are_wrong_as_a_whole(tmp_path, rng):
    frame, path = plain_map(rng), tmp_path / "m.parquet"
    cases = {
        "row 30 repeats row 3": pd.concat([frame, frame[3:4]]),
        "no column x_m, y_m;": frame.drop(columns=["x_m", "y_m"]),
        "column x_m holds 'near' in row 0, expected a number": frame.assign(x_m="near"),
        "label holds 'tree2' in row 0, expected a number; number the landmarks": frame.assign(
            label=["tree2", "tree3"] * (N // 2)
        ),
        "column x_m holds bool, not numbers": frame.assign(x_m=True),
        "descriptor: lists of 2 and 3 numbers": frame.assign(
            descriptor=[[1.0, 2.0]] + [[1.0, 2.0, 3.0]] * (N - 1)
        ),
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


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("x_m", "x_mm", "x_mm is in millimetres: multiply by 0.001 and name it x_m"),
        ("x_m", "X [cm]", r"X \[cm\] is in centimetres: multiply by 0.01 and name it x_m"),
        ("x_m", "x (ft)", r"x \(ft\) is in feet: multiply by 0.3048 and name it x_m"),
        ("cov_xx_m2", "cov_xx_cm2", "cov_xx_cm2 is in cm2: multiply by 1e-4 and name it cov_xx_m2"),
        ("cov_xx_m2", "cov_xx_ft", "cov_xx_ft is in feet: convert it and name it cov_xx_m2"),
        ("x_m", "x_metres", r"rename column x_metres to x_m \(mind the unit\)"),
    ],
)
def test_a_column_in_another_unit_must_be_converted(tmp_path, rng, name, given, said):
    frame = plain_map(rng).rename(columns={name: given})
    with pytest.raises(InputError, match=f"m.csv: has no column {name}; {said}$"):
        read_map(write(frame, tmp_path / "m.csv"))


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("bearing_rad", "bearing_deg", "is in degrees: multiply by pi/180"),
        ("time_s", "time_ms", "is in milliseconds: multiply by 0.001"),
        ("time_s", "time_ns", "is in nanoseconds: multiply by 1e-9"),
    ],
)
def test_angles_and_times_in_another_unit_must_be_converted(tmp_path, name, given, said):
    values = {"time_s": [0.0], "range_m": [1.0], "bearing_rad": [0.1]}
    path = write(pd.DataFrame(values).rename(columns={name: given}), tmp_path / "ranges.csv")
    with pytest.raises(InputError, match=f"{given} {said} and name it {name}$"):
        read_open_table(path, RANGES)


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("turn_rate_rad_s", "turn_rate_deg_s", "is in degrees per second: multiply by pi/180"),
        ("theta_rad", "theta [deg]", "is in degrees: multiply by pi/180"),
        ("speed_m_s", "speed_km_h", "is in kilometres per hour: multiply by 1/3.6"),
    ],
)
def test_optional_columns_in_another_unit_are_not_ignored(tmp_path, name, given, said):
    path = write(pd.DataFrame({"time_s": [0.0], given: [1.0]}), tmp_path / "odometry.csv")
    with pytest.raises(
        InputError, match=f"{re.escape(given)} {said} and name it {name}, or remove"
    ):
        read_open_table(path, ODOMETRY)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"id": 1}, "column id is ignored; if it is the same number wherever .* name it label$"),
        ({"Landmark ID": 1}, "column Landmark ID is ignored"),
        (
            {"desc0": 0.1, "desc1": 0.2, "tag": 1},
            "columns desc0 to desc1 are ignored; if they are descriptors, name them descriptor_0 "
            "to descriptor_1; column tag is ignored",
        ),
        ({"label": 1, "feat_1": 0.1, "feat_2": 0.2}, "columns feat_1 to feat_2 are ignored"),
        ({"embedding": [[0.1, 0.2]] * N}, "column embedding is ignored; .* name it descriptor$"),
    ],
)
def test_ignored_columns_that_look_like_labels_or_descriptors_are_told(tmp_path, rng, more, said):
    with pytest.warns(TellingWarning, match=f"m.parquet: {said}"):
        read_map(write(plain_map(rng, **more), tmp_path / "m.parquet"))


@pytest.mark.parametrize(
    "more",
    [
        {"id": 1, "descriptor_0": 0.1, "descriptor_1": 0.2},
        {"id": 1, "label": range(N)},
        {"feature": 1.0, "colour": 3, "weight": 0.1},
    ],
)
def test_other_columns_are_ignored_in_silence(tmp_path, rng, more, recwarn):
    read_map(write(plain_map(rng, **more), tmp_path / "m.csv"))
    assert not [each for each in recwarn if "is ignored" in str(each.message)]


def test_a_survey_without_labels_names_the_column_that_may_hold_them(tmp_path):
    survey = pd.DataFrame({"id": [1], "x_m": [0.0], "y_m": [0.0]})
    said = "no column label; if id is the identity of the landmark, rename it to label$"
    with pytest.raises(InputError, match=said):
        read_open_table(write(survey, tmp_path / "landmarks.csv"), SURVEY)
