"""MRCLAM importer on a small synthetic recording with known truth."""

from pathlib import Path

import numpy as np
import pytest

from mapfusion.datasets.formats import import_recording, settings_class
from mapfusion.datasets.mrclam import MrclamSettings, import_mrclam
from mapfusion.errors import InputError
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fastslam.mapping import run_log
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fastslam.proposal import Proposal
from mapfusion.geometry.se2 import between, compose, inverse, transform_points, wrap
from mapfusion.robot_log import read_log, read_truth

START_S = 1_248_446_182.0
LANDMARKS = {6: (1.5, 1.0), 7: (2.0, -0.8), 8: (-0.5, 2.0), 20: (0.5, 3.0)}
BARCODES = {1: 5, 2: 14, 6: 72, 7: 27, 8: 54, 20: 90}
T_WORLD_START = {1: np.array([0.5, -0.2, 0.3]), 2: np.array([-0.4, 0.6, 3.0])}
SPEED_M_S, TURN_RAD_S = 0.2, {1: 0.15, 2: -0.1}
DURATION_S = 40.0


def true_pose(robot: int, time_s: float) -> np.ndarray:
    """Stand for a second, then drive on a circle."""
    drive_s, turn = max(time_s - 1.0, 0.0), TURN_RAD_S[robot]
    angle, radius = turn * drive_s, SPEED_M_S / turn
    arc = np.array([radius * np.sin(angle), radius * (1 - np.cos(angle)), angle])
    return compose(T_WORLD_START[robot], arc)


def write(path: Path, rows: list) -> None:
    lines = ["# a comment", "# columns"] + ["\t ".join(f"{v:.9f}" for v in row) for row in rows]
    path.write_text("\n".join(lines) + "\n\n")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    folder = tmp_path / "MRCLAM"
    folder.mkdir()
    barcodes = [f"{s}\t {b}" for s, b in BARCODES.items()]
    (folder / "Barcodes.dat").write_text("\n".join(["# subject barcode", *barcodes]))
    write(folder / "Landmark_Groundtruth.dat", [(s, *p, 1e-4, 1e-4) for s, p in LANDMARKS.items()])
    for robot in (1, 2):
        name = str(folder / f"Robot{robot}")
        # Velocities come irregularly, and only when they change much; each holds until the next.
        times = np.concatenate([[0.0, 1.0], np.sort(rng.uniform(1.0, DURATION_S, 300))])
        velocities = [(0.0, 0.0) if t < 1.0 else (SPEED_M_S, TURN_RAD_S[robot]) for t in times]
        write(
            Path(f"{name}_Odometry.dat"),
            [(START_S + t, *v) for t, v in zip(times, velocities, strict=True)],
        )
        truth_s = np.arange(-0.5, DURATION_S + 1, 0.05)
        truth_s = truth_s[(truth_s < 10.0) | (truth_s > 12.0)]
        write(
            Path(f"{name}_Groundtruth.dat"), [(START_S + t, *true_pose(robot, t)) for t in truth_s]
        )
        measurements = []
        for time_s in np.sort(rng.uniform(0.0, DURATION_S - 1.0, 150)):
            pose = true_pose(robot, time_s)
            for subject in (*LANDMARKS, 3 - robot):
                point = LANDMARKS.get(subject, (0.0, 0.0))
                local = transform_points(inverse(pose), np.array([point]))[0]
                range_m, bearing = np.hypot(*local), np.arctan2(local[1], local[0])
                measurements.append((START_S + time_s, BARCODES[subject], range_m, bearing))
        measurements.append((START_S + 5.0, 999, 1.0, 0.0))
        write(Path(f"{name}_Measurement.dat"), measurements)
    return folder


def test_logs_agree_with_the_truth(recording: Path, tmp_path: Path):
    settings = MrclamSettings(frame_s=0.25)
    paths = import_mrclam(recording, tmp_path / "logs", settings)
    assert [path.name for path in paths] == ["robot1", "robot2"]
    for robot, path in enumerate(paths, start=1):
        log, truth = read_log(path), read_truth(path)
        expected = np.array([true_pose(robot, t) for t in log.time_s])
        assert log.planar
        assert log.robot == f"robot{robot}"
        np.testing.assert_allclose(np.diff(log.time_s), 0.25)
        assert np.all(log.odometry[0] == 0)
        driven = between(expected[:-1], expected[1:])[: int(DURATION_S / 0.25) - 4]
        np.testing.assert_allclose(log.odometry[1 : 1 + len(driven)], driven, atol=1e-6)

        known = np.isfinite(truth.T_world_robot[:, 0])
        in_gap = (log.time_s > 10.0) & (log.time_s < 12.0)
        assert not np.any(known[in_gap])
        assert np.mean(known) > 0.9
        difference = truth.T_world_robot[known] - expected[known]
        np.testing.assert_allclose(difference[:, :2], 0, atol=1e-4)
        np.testing.assert_allclose(wrap(difference[:, 2]), 0, atol=1e-6)

        assert set(np.unique(log.observations.label)) == set(LANDMARKS)
        times = np.loadtxt(recording / f"Robot{robot}_Measurement.dat")[:-1, 0] - START_S
        frames = np.unique(np.ceil(times / 0.25))
        assert log.iteration.tolist() == np.repeat(frames, len(LANDMARKS)).tolist()
        world = np.array(
            [
                transform_points(expected[frame], p[None])[0]
                for frame, p in zip(log.iteration, log.observations.position_m, strict=True)
            ]
        )
        np.testing.assert_allclose(world, truth.point_world_m, atol=1e-5)
        assert np.all(log.observations.position_m[:, 2] == 0)


def test_a_frame_keeps_the_last_sighting_of_a_landmark(recording: Path, tmp_path: Path):
    rows = [(0.1, 72, 1.0, 0.0), (0.2, 27, 3.0, 0.0), (0.3, 72, 2.0, 0.0), (0.7, 72, 4.0, 0.0)]
    write(recording / "Robot1_Measurement.dat", [(START_S + t, *rest) for t, *rest in rows])
    log = read_log(import_mrclam(recording, tmp_path / "logs", MrclamSettings(frame_s=0.5))[0])
    assert log.iteration.tolist() == [1, 1, 2]
    assert log.observations.label.tolist() == [7, 6, 6]
    assert log.observations.position_m[:, 0].tolist() == [3.0, 2.0, 4.0]


def test_covariance_is_the_spread_of_the_noise(recording: Path, tmp_path: Path):
    settings = MrclamSettings(frame_s=0.25, range_sigma_m=0.02, bearing_sigma_rad=0.01)
    log = read_log(import_mrclam(recording, tmp_path / "logs", settings)[0])
    rng = np.random.default_rng(0)
    # Frame 0 stands at the start, so nothing is moved there: the bare Jacobian is seen.
    for position, covariance in list(
        zip(log.observations.position_m, log.observations.covariance_m2, strict=True)
    )[:4]:
        range_m, bearing = np.hypot(*position[:2]), np.arctan2(position[1], position[0])
        ranges = range_m + settings.range_sigma(range_m) * rng.standard_normal(200_000)
        bearings = bearing + 0.01 * rng.standard_normal(200_000)
        cloud = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
        np.testing.assert_allclose(covariance[:2, :2], np.cov(cloud), rtol=0.03, atol=1e-6)
        assert np.all(covariance[2] == 0)


def test_all_ranges_of_all_robots_may_be_off_alike(recording: Path, tmp_path: Path):
    logs = import_mrclam(recording, tmp_path / "usual")
    first, second = (read_log(path).calibration for path in logs[:2])
    assert first.scale == MrclamSettings().range_scale_sigma > 0
    assert first.is_of_one_camera(second)
    known = import_mrclam(recording, tmp_path / "known", MrclamSettings(range_scale_sigma=0))
    assert read_log(known[0]).calibration.is_none


def test_truth_does_not_reach_the_log(recording: Path, tmp_path: Path):
    first = read_log(import_mrclam(recording, tmp_path / "a")[0])
    truth = recording / "Robot1_Groundtruth.dat"
    rows = [line.split() for line in truth.read_text().splitlines() if line and line[0] != "#"]
    write(truth, [(float(t), 9.0, -9.0, 1.0) for t, *_ in rows])
    write(recording / "Landmark_Groundtruth.dat", [(s, 4, 4, 1, 1) for s in LANDMARKS])
    second = read_log(import_mrclam(recording, tmp_path / "b")[0])
    np.testing.assert_array_equal(first.odometry, second.odometry)
    np.testing.assert_array_equal(first.observations.position_m, second.observations.position_m)


def test_the_filter_finds_the_landmarks(recording: Path, tmp_path: Path):
    path = import_mrclam(recording, tmp_path / "logs")[1]
    log, truth = read_log(path), read_truth(path)
    settings = FastSlamParameters(
        n_particles=20,
        proposal=Proposal.MOTION,
        association="label",
        motion=MotionNoise(
            0.005, 0, 0.005, 0, 0, lateral_m_per_sqrt_m=0.005, lateral_slip_m_per_rad=0
        ),
    )
    frames = list(run_log(log, settings, np.random.default_rng(0), snapshots=[len(log) - 1]))
    landmarks = frames[-1].landmarks
    assert [frame.iteration for frame in frames] == list(range(len(log)))
    assert landmarks is not None
    assert landmarks.planar
    assert landmarks.name == "robot2"
    expected = transform_points(
        inverse(T_WORLD_START[2]), truth.point_world_m[landmarks.source_observation]
    )
    np.testing.assert_allclose(landmarks.position_m, expected, atol=0.03)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("Barcodes.dat", None, "Barcodes.dat: no such file"),
        ("Robot2_Measurement.dat", None, "Robot2_Measurement.dat: no such file"),
        ("Robot1_Odometry.dat", "1.0 2.0 3.0\n4.0 5.0", "line 2: has 2 columns, expected 3"),
        ("Robot1_Odometry.dat", "1.0 2.0 3.0\n4.0 fast 0", "line 2: not a number in '4.0 fast 0'"),
        ("Robot1_Odometry.dat", "1.0 2.0 3.0\n4.0 nan 0", "line 2: not finite, or above 1e+12"),
        ("Robot1_Odometry.dat", "1.0 2.0 3.0\n4.0 1e300 0", "line 2: not finite, or above 1e+12"),
        ("Robot1_Measurement.dat", "1 72 1e200 0", "line 1: not finite, or above 1e+12"),
        ("Robot1_Odometry.dat", "# nothing", "has 0 rows, expected at least 2"),
        ("Robot1_Groundtruth.dat", b"PAR1\xff\xfe\x00", "not a readable text file"),
        ("Barcodes.dat", "1 5\n6 72\n7 72", "line 3: barcode 72 is subject 6's"),
        ("Barcodes.dat", "1.5 5", "line 1: not whole numbers"),
        ("Robot1_Measurement.dat", "1 5 1 0\n2 72 -3 0", "line 2: range is -3"),
    ],
)
def test_damage_is_one_clear_line(recording: Path, tmp_path: Path, name, change, message):
    path = recording / name
    if change is None:
        path.unlink()
    elif isinstance(change, bytes):
        path.write_bytes(change)
    else:
        path.write_text(change)
    with pytest.raises(InputError) as caught:
        import_mrclam(recording, tmp_path / "logs")
    assert message in str(caught.value)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "logs").exists()


def test_truth_is_optional(recording: Path, tmp_path: Path):
    whole = [read_log(path) for path in import_mrclam(recording, tmp_path / "logs")]
    (recording / "Robot1_Groundtruth.dat").unlink()
    first, second = import_mrclam(recording, tmp_path / "logs")  # over logs that had it
    assert not (first / "truth_poses.parquet").exists()
    assert (first / "truth_points.parquet").exists()
    assert (second / "truth_poses.parquet").exists()
    (recording / "Landmark_Groundtruth.dat").unlink()
    first, second = import_mrclam(recording, tmp_path / "logs")
    assert [path.name for path in sorted(second.iterdir())] == [
        "frames.parquet",
        "observations.parquet",
        "truth_poses.parquet",
    ]
    for path, log in zip((first, second), whole, strict=True):
        read = read_log(path)
        np.testing.assert_array_equal(read.observations.position_m, log.observations.position_m)
        np.testing.assert_array_equal(read.observations.label, log.observations.label)


def test_the_importer_is_found_by_its_name(recording: Path, tmp_path: Path):
    assert import_recording("mrclam", recording, tmp_path) == [
        tmp_path / "robot1",
        tmp_path / "robot2",
    ]
    assert settings_class("mrclam") is MrclamSettings
    with pytest.raises(InputError, match="'nobody': unknown; known: mrclam"):
        import_recording("nobody", recording, tmp_path)


@pytest.mark.parametrize("time_s", ["1e9", "1e12"])
def test_times_that_are_none_do_not_fill_the_memory(recording: Path, tmp_path: Path, time_s: str):
    with (recording / "Robot1_Odometry.dat").open("a") as file:
        file.write(f"-{time_s} 0 0\n{time_s} 0 0\n")
    with pytest.raises(InputError, match=r"MRCLAM: odometry over .* is more than 1000000 frames"):
        import_mrclam(recording, tmp_path / "logs")


def test_another_folder_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no such folder"):
        import_mrclam(tmp_path / "nothing", tmp_path / "logs")
    with pytest.raises(InputError, match="RobotN_Odometry"):
        import_mrclam(tmp_path, tmp_path / "logs")
