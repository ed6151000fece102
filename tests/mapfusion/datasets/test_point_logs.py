"""Importers of points and of ranges against an analytic drive on a circle."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mapfusion.datasets.formats import import_recording
from mapfusion.datasets.point_logs import PointsSettings, RangesSettings
from mapfusion.errors import InputError, TellingWarning
from mapfusion.robot_log import read_log, read_true_poses

RADIUS_M, TURN_RAD_S = 2.0, 0.25
POINTS = np.array([[3.0, 0.5], [0.0, 4.0], [-3.0, 1.0], [-1.0, -4.0]])
SENSOR = {"sensor_x_m": 0.3, "sensor_y_m": -0.1, "sensor_theta_rad": 0.2}


def pose(time_s: np.ndarray) -> np.ndarray:
    """Return analytic poses (T, 3) on the circle."""
    angle = TURN_RAD_S * time_s
    x, y = RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle)
    return np.column_stack([x, y, angle + np.pi / 2])


def complex_of(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return poses as positions and headings in the complex plane, an independent algebra."""
    return poses[:, 0] + 1j * poses[:, 1], np.exp(1j * poses[:, 2])


def sightings(time_s: np.ndarray, sensor: dict[str, float]) -> pd.DataFrame:
    """Return all points in the frame of the sensor at all times."""
    at, ahead = complex_of(pose(time_s))
    mount = sensor.get("sensor_x_m", 0.0) + 1j * sensor.get("sensor_y_m", 0.0)
    turn = np.exp(1j * sensor.get("sensor_theta_rad", 0.0))
    rows = []
    for k, when in enumerate(time_s):
        for label, (x, y) in enumerate(POINTS):
            seen = ((x + 1j * y - at[k]) / ahead[k] - mount) / turn
            rows.append((when, seen.real, seen.imag, label))
    return pd.DataFrame(rows, columns=["time_s", "x_m", "y_m", "label"])


def write_recording(folder: Path, sensor: dict[str, float], kind: str, labels: bool = True) -> None:
    folder.mkdir(parents=True)
    dense = np.arange(0.0, 20.001, 0.05)
    poses = pd.DataFrame(pose(dense), columns=["x_m", "y_m", "theta_rad"])
    poses.insert(0, "time_s", dense)
    poses.to_csv(folder / "truth_poses.csv", index=False)
    if kind == "points":
        poses.assign(x_m=poses["x_m"] + 7.0).to_csv(folder / "odometry.csv", index=False)
    else:
        velocity = {"speed_m_s": RADIUS_M * TURN_RAD_S, "turn_rate_rad_s": TURN_RAD_S}
        pd.DataFrame({"time_s": [0.0, 3.3, 20.0]}).assign(**velocity).to_csv(
            folder / "odometry.csv", index=False
        )
    seen = sightings(np.arange(0.0, 20.0, 0.5), sensor)
    if kind == "ranges":
        seen["range_m"] = np.hypot(seen["x_m"], seen["y_m"])
        seen["bearing_rad"] = np.arctan2(seen["y_m"], seen["x_m"])
        seen = seen.drop(columns=["x_m", "y_m"])
    seen = seen if labels else seen.drop(columns="label")
    seen.to_csv(folder / f"{kind}.csv", index=False)
    survey = pd.DataFrame(POINTS, columns=["x_m", "y_m"]).assign(label=range(len(POINTS)))
    if labels:
        survey.to_csv(folder.parent / "landmarks.csv", index=False)


NOISE = {
    "points": PointsSettings(sigma_m=0.05, **SENSOR),
    "ranges": RangesSettings(range_sigma_m=0.05, bearing_sigma_rad=0.01, **SENSOR),
}


@pytest.mark.parametrize("kind", ["points", "ranges"])
@pytest.mark.parametrize("frame_s", [0.0, 0.75])
def test_logs_are_those_of_the_circle(kind: str, frame_s: float, tmp_path: Path) -> None:
    write_recording(tmp_path / "team" / "R1", SENSOR, kind)
    write_recording(tmp_path / "team" / "R2", SENSOR, kind)
    noise = NOISE[kind]
    settings = type(noise)(**{**vars(noise), "frame_s": frame_s})
    paths = import_recording(kind, tmp_path / "team", tmp_path / "logs", settings)
    assert [path.name for path in paths] == ["R1", "R2"]
    log, truth = read_log(paths[0]), read_true_poses(paths[0])
    assert log.planar
    assert truth is not None
    assert np.allclose(np.diff(log.time_s), frame_s or 0.5)
    # Linear interpolation over 0.05 s of this circle is off by less than 0.1 mm.
    known = log.time_s <= 19.5
    np.testing.assert_allclose(truth[known, :2], pose(log.time_s)[known, :2], atol=1e-4)
    at, ahead = complex_of(pose(log.time_s))
    moved = (at[1:] - at[:-1]) / ahead[:-1]
    np.testing.assert_allclose(log.odometry[1:, 0][known[1:]], moved.real[known[1:]], atol=2e-4)
    np.testing.assert_allclose(log.odometry[1:, 2][known[1:]], TURN_RAD_S * (frame_s or 0.5))
    seen, frame = log.observations, log.iteration
    local = seen.position_m[:, 0] + 1j * seen.position_m[:, 1]
    world = at[frame] + ahead[frame] * local
    assert seen.label is not None
    inside = known[frame]
    expected = POINTS[seen.label, 0] + 1j * POINTS[seen.label, 1]
    np.testing.assert_allclose(world[inside], expected[inside], atol=5e-4)
    surveyed = pd.read_parquet(paths[0] / "truth_points.parquet")
    np.testing.assert_array_equal(surveyed["x_m"], POINTS[seen.label, 0])


def test_the_covariance_of_a_range_and_bearing_is_the_spread_of_the_noise(tmp_path: Path) -> None:
    write_recording(tmp_path / "R1", {}, "ranges", labels=False)
    settings = RangesSettings(range_sigma_m=0.02, range_sigma_ratio=0.01, bearing_sigma_rad=0.01)
    (path,) = import_recording("ranges", tmp_path / "R1", tmp_path / "logs", settings)
    seen, rng = read_log(path).observations, np.random.default_rng(0)
    assert seen.label is None
    for k in range(4):
        x, y, _ = seen.position_m[k]
        r = np.hypot(x, y)
        ranges = r + np.hypot(0.02, 0.01 * r) * rng.standard_normal(200_000)
        bearings = np.arctan2(y, x) + 0.01 * rng.standard_normal(200_000)
        cloud = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
        # The standard error of a covariance of n samples is about its variance times sqrt(2 / n).
        spread = np.cov(cloud)
        tolerance = 5 * np.sqrt(2 / 200_000) * np.trace(spread)
        np.testing.assert_allclose(seen.covariance_m2[k, :2, :2], spread, atol=tolerance)


def test_covariances_of_the_table_are_turned_with_the_sensor(tmp_path: Path) -> None:
    write_recording(tmp_path / "R1", {}, "points")
    path = tmp_path / "R1" / "points.csv"
    stated = {"cov_xx_m2": 0.04, "cov_xy_m2": 0.0, "cov_yy_m2": 0.01}
    pd.read_csv(path).assign(**stated).to_csv(path, index=False)
    settings = PointsSettings(sensor_theta_rad=np.pi / 2)
    (written,) = import_recording("points", tmp_path / "R1", tmp_path / "logs", settings)
    found = read_log(written).observations.covariance_m2
    np.testing.assert_allclose(
        found[:, :2, :2], np.tile(np.diag([0.01, 0.04]), (160, 1, 1)), atol=1e-12
    )


@pytest.mark.parametrize(
    ("table", "change", "words"),
    [
        ("odometry", lambda t: t.drop(columns="x_m"), "has no column x_m; odometry needs x_m, y_m"),
        ("odometry", lambda t: t[["time_s"]], "no poses or velocities"),
        ("odometry", lambda t: t.assign(time_s=t["time_s"] + 1e6), "another recording's"),
        ("odometry", lambda t: t.assign(time_s=0.0), "column time_s: repeats in row 1"),
        ("points", lambda t: t[::-1], "column time_s: runs back in row"),
        ("points", lambda t: t[:0], "holds no row"),
        ("truth_poses", lambda t: t.assign(time_s=t["time_s"] + 1e6), "no time is in both"),
        ("landmarks", lambda t: pd.concat([t, t]), "label 0 twice"),
    ],
)
def test_damaged_tables_are_refused(table: str, change, words: str, tmp_path: Path) -> None:
    robot = tmp_path / "team" / "R1"
    write_recording(robot, {}, "points")
    path = (robot.parent if table == "landmarks" else robot) / f"{table}.csv"
    change(pd.read_csv(path)).to_csv(path, index=False)
    with pytest.raises(InputError, match=words) as refused:
        import_recording("points", robot.parent, tmp_path / "logs", PointsSettings(sigma_m=0.1))
    assert str(path) in str(refused.value)
    assert not (tmp_path / "logs").exists()


def test_noise_must_be_stated_and_bearings_are_radians(tmp_path: Path) -> None:
    write_recording(tmp_path / "P", {}, "points")
    with pytest.raises(InputError, match=r"has no covariances .* --param sigma_m="):
        import_recording("points", tmp_path / "P", tmp_path / "logs")
    write_recording(tmp_path / "R", {}, "ranges")
    with pytest.raises(InputError, match=r"range_sigma_m=.* bearing_sigma_rad="):
        import_recording("ranges", tmp_path / "R", tmp_path / "logs")
    path = tmp_path / "R" / "ranges.csv"
    table = pd.read_csv(path)
    table.assign(bearing_rad=np.degrees(table["bearing_rad"])).to_csv(path, index=False)
    with pytest.raises(InputError, match="are they degrees"):
        import_recording("ranges", tmp_path / "R", tmp_path / "logs", NOISE["ranges"])
    for cell, said in (
        (np.nan, "column bearing_rad: is nan in row 3; give a finite number, or remove the row"),
        (np.inf, "column bearing_rad: is inf in row 3; give a finite number, or remove the row"),
        (9.0, "column bearing_rad: is 9 in row 3; bearings are in radians, -pi to pi or 0 to 2 pi"),
    ):
        table.loc[3, "bearing_rad"] = cell
        table.to_csv(path, index=False, na_rep="nan")
        with pytest.raises(InputError, match=f"{said}; see"):
            import_recording("ranges", tmp_path / "R", tmp_path / "logs", NOISE["ranges"])


@pytest.mark.parametrize(
    ("kind", "name", "unit", "frame_s", "labels"),
    [
        ("points", "theta_rad", "degrees", 0.0, True),
        ("points", "theta_rad", "degrees", 2.0, True),
        ("points", "theta_rad", "degrees", 0.0, False),
        ("ranges", "turn_rate_rad_s", "degrees/s", 0.0, True),
        ("ranges", "turn_rate_rad_s", "degrees/s", 2.0, True),
    ],
)
def test_odometry_in_degrees_is_refused(
    kind: str, name: str, unit: str, frame_s: float, labels: bool, tmp_path: Path
) -> None:
    """In a frame of 2 s the heading changes by 29 degrees, 29 radians if it is taken so."""
    write_recording(tmp_path / "R1", {}, kind, labels)
    path = tmp_path / "R1" / "odometry.csv"
    table = pd.read_csv(path)
    table.assign(**{name: np.degrees(table[name])}).to_csv(path, index=False)
    settings = {"points": PointsSettings, "ranges": RangesSettings}[kind]
    noise = {"points": {"sigma_m": 0.05}, "ranges": {"range_sigma_m": 0.05}}[kind]
    noise |= {"bearing_sigma_rad": 0.01} if kind == "ranges" else {}
    said = f"column {name}: .*holds {unit}.*multiply it by pi/180; see `mapfusion docs point_logs`"
    with pytest.raises(InputError, match=said) as refused:
        import_recording(
            kind, tmp_path / "R1", tmp_path / "logs", settings(frame_s=frame_s, **noise)
        )
    assert str(path) in str(refused.value)
    assert not (tmp_path / "logs").exists()


def test_turn_rates_in_degrees_are_refused_without_labels(tmp_path: Path) -> None:
    write_recording(tmp_path / "R1", {}, "ranges", labels=False)
    path = tmp_path / "R1" / "odometry.csv"
    table = pd.read_csv(path)
    import_recording("ranges", tmp_path / "R1", tmp_path / "right", NOISE["ranges"])
    table.assign(turn_rate_rad_s=np.degrees(table["turn_rate_rad_s"])).to_csv(path, index=False)
    with pytest.raises(InputError, match=r"turn_rate_rad_s: the robot turns by 7\.16 rad between"):
        import_recording("ranges", tmp_path / "R1", tmp_path / "logs", NOISE["ranges"])


def test_all_times_in_milliseconds_are_told(tmp_path: Path) -> None:
    write_recording(tmp_path / "R1", {}, "ranges", labels=False)
    for name in ("odometry", "ranges"):
        path = tmp_path / "R1" / f"{name}.csv"
        table = pd.read_csv(path)
        table.assign(time_s=1000 * table["time_s"]).to_csv(path, index=False)
    with pytest.raises(InputError, match="are all times in seconds"):
        import_recording("ranges", tmp_path / "R1", tmp_path / "logs", NOISE["ranges"])


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_odometry_with_times_in_another_unit_is_refused(factor: float, tmp_path: Path) -> None:
    write_recording(tmp_path / "R1", {}, "ranges")
    path, time_s = tmp_path / "R1" / "odometry.csv", np.arange(0.0, 20.5, 0.5)
    velocity = {"speed_m_s": RADIUS_M * TURN_RAD_S, "turn_rate_rad_s": TURN_RAD_S}
    table = pd.DataFrame({"time_s": time_s * factor}).assign(**velocity)
    table.to_csv(path, index=False)
    said = r"column time_s: rows are \S+ s apart, and measurements 0.5 s; are its times in seconds"
    with pytest.raises(InputError, match=said):
        import_recording("ranges", tmp_path / "R1", tmp_path / "logs", NOISE["ranges"])


def test_a_refused_table_names_the_page(tmp_path: Path) -> None:
    write_recording(tmp_path / "R", {}, "ranges")
    for folder in (tmp_path / "R", tmp_path):
        with pytest.raises(InputError, match=r"see `mapfusion docs point_logs`$"):
            import_recording("ranges", folder, tmp_path / "logs")
        (tmp_path / "R" / "odometry.csv").unlink(missing_ok=True)


@pytest.mark.parametrize(("repeats", "said"), [(1, "label 2"), (4, "labels 0, 1, 2, ...")])
def test_rows_that_repeat_a_label_in_their_frame_are_told(
    repeats: int, said: str, tmp_path: Path
) -> None:
    write_recording(tmp_path / "R1", {}, "points")
    path = tmp_path / "R1" / "points.csv"
    table = pd.read_csv(path)
    chosen = table[4:8] if repeats == 4 else table[6:7]
    pd.concat([table[:8], chosen, table[8:]]).to_csv(path, index=False)
    first = 6 if repeats == 1 else 4
    counted = f"{repeats} of {160 + repeats} rows are left out"
    with pytest.warns(TellingWarning, match=rf"s.csv: {counted} \({said}; first: row {first}\)"):
        (log,) = import_recording("points", tmp_path / "R1", tmp_path / "logs", NOISE["points"])
    assert len(read_log(log).observations) == 160
