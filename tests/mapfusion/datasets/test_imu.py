"""Tilts from an accelerometer, rotations from gyroscopes, and IMU data of EuRoC."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from mapfusion.datasets.formats import read_recording
from mapfusion.datasets.imu import SHARED_RAD, ImuData
from mapfusion.datasets.stereo_import import RecordingPart, StereoImport
from mapfusion.errors import InputError
from mapfusion.geometry import se3
from mapfusion.vision.attitude_filter import AttitudeEstimator, AttitudeMeasurement
from tests.mapfusion.datasets.written_layouts import START_NS, TIMES_S, drive, read_yaml
from tests.mapfusion.datasets.written_layouts import write_euroc as write_pictures
from tests.mapfusion.vision.test_attitude_filter import measured_motion

GRAVITY, RATE_HZ, A_FRAME = 9.81, 200, 20  # so ten frames a second
TURNING = (0.01, -0.02, 0.03)  # what the gyroscopes of `imu0` say, in their own axes
T_BODY_IMU = se3.pose(se3.tilt(0.4, -0.2), [0.1, 0.0, 0.2])


def correlated(rng: np.random.Generator, n: int, rms: float, over: float) -> np.ndarray:
    """Return a first-order autoregressive process, shape (n, 2), with a correlation length."""
    keep = np.exp(-1 / over)
    drawn = rng.standard_normal((n + 2000, 2)) * rms * np.sqrt(1 - keep**2)
    return lfilter([1.0], [1.0, -keep], drawn, axis=0)[2000:]


def at_rest(tilt_rad: np.ndarray) -> np.ndarray:
    """Return gravity in the axes of a body, shape (n, 3)."""
    return GRAVITY * se3.tilt(*tilt_rad.T)[:, 2]


def test_at_rest_it_is_the_body_s_tilt() -> None:
    frames = np.arange(8) * 10**8
    tilt_rad = np.random.default_rng(0).uniform(-0.3, 0.3, (8, 2))
    found, sigma = ImuData(frames, at_rest(tilt_rad)).tilts(frames)
    np.testing.assert_allclose(found, tilt_rad, atol=1e-12)
    assert np.all(sigma > 0)


def test_each_frame_averages_the_whole_time_halfway_to_its_neighbours() -> None:
    """The mean over a window is the tilt at its centre for a constant roll rate."""
    frames = 10**9 + np.arange(5) * 10**8
    sample_ns = np.arange(0, 2 * 10**9, 10**6) + 5 * 10**5  # none on an edge of a window
    roll = 0.3 * (sample_ns / 1e9 - 1.2)
    felt = at_rest(np.column_stack([roll, np.zeros_like(roll)]))
    found, _ = ImuData(sample_ns, felt).tilts(frames)
    np.testing.assert_allclose(found[:, 0], 0.3 * (frames / 1e9 - 1.2), atol=1e-12)


def test_frames_without_it_are_unknown() -> None:
    frames = np.arange(8) * 10**8
    found, _ = ImuData(frames[:4], at_rest(np.zeros((4, 2)))).tilts(frames)
    assert np.isnan(found[4:]).all()
    assert np.all(found[:4] == 0)
    with pytest.raises(InputError, match="no measurement while"):
        ImuData(frames, at_rest(np.zeros((8, 2)))).tilts(frames + 10**10)


def swayed(rng: np.random.Generator, n_frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors, stated deviations (T, 2) and errors of the accelerometer alone.

    Of a body that sways by 3 degrees over half a second, speeds up and slows down by 0.4 m/s² over
    a second, and feels 0.03 m/s² too much.
    """
    n = n_frames * A_FRAME
    true = correlated(rng, n, 0.05, 0.5 * RATE_HZ)
    felt = at_rest(true) + rng.normal(0, 0.1, (n, 3))
    felt[:, :2] += correlated(rng, n, 0.4, RATE_HZ) + rng.normal(0, 0.03, 2)
    sample_ns = np.arange(n) * (10**9 // RATE_HZ)
    at = np.arange(n_frames) * A_FRAME + A_FRAME // 2
    measured, sigma = ImuData(sample_ns, felt).tilts(sample_ns[at])
    way = np.stack([0.05 * np.arange(n_frames), np.zeros(n_frames), 0.03 * np.arange(n_frames)], -1)
    bodies = se3.in_space(way, true[at])
    levelling = AttitudeEstimator(shared_rad=SHARED_RAD)
    for k in range(n_frames):
        motion = measured_motion(rng, bodies[k - 1], bodies[k]) if k else None
        levelling.add(
            motion, AttitudeMeasurement(np.array([*measured[k], 0.0]), np.array([*sigma, 0.0]))
        )
    made = levelling.attitude
    return made.value[:, :2] - true[at], made.sigma[:, :2], measured - true[at]


def test_of_a_body_that_sways_it_is_as_sure_as_stated() -> None:
    runs = [swayed(np.random.default_rng(seed), 300) for seed in range(12)]
    errors, sigmas, alone = (np.array(each)[:, 60:] for each in zip(*runs, strict=True))
    assert 0.2 < np.mean((errors / sigmas) ** 2) < 1.5
    rms = np.sqrt(np.mean(errors**2))
    assert rms < 0.01
    assert rms < 0.3 * np.sqrt(np.mean(alone**2))


@pytest.mark.parametrize("rate_hz", [50, 200])
def test_turns_of_gyroscopes_are_the_body_s(rate_hz: int) -> None:
    """The rotation about a rotating axis equals the integral of the angular velocity."""
    frames = 10**9 + np.arange(11) * 10**8
    sample_ns = np.arange(0, 21 * 10**8, 10**9 // rate_hz)
    t = sample_ns / 1e9
    R = Rotation.from_euler("ZX", np.column_stack([0.8 * t, 0.3 * np.sin(2 * t)]))
    rate = np.column_stack([0.6 * np.cos(2 * t), np.zeros_like(t), np.full_like(t, 0.0)])
    rate += 0.8 * R.as_matrix()[:, 2]  # the world's z, in the body's axes
    felt = ImuData(sample_ns, at_rest(np.zeros((len(t), 2))), rate)
    turns = felt.turns(frames)
    assert turns is not None
    assert np.isnan(turns[0]).all()
    own = Rotation.from_matrix(R.as_matrix()[np.searchsorted(sample_ns, frames)])
    true = (own[:-1].inv() * own[1:]).as_rotvec()
    np.testing.assert_allclose(turns[1:], true, atol=30 / rate_hz**2 * 1e-2)


def test_turns_are_unknown_where_gyroscopes_are_silent() -> None:
    frames = np.arange(5) * 10**8
    sample_ns = np.arange(0, 5 * 10**8, 5 * 10**6)
    sample_ns = np.delete(sample_ns, slice(22, 36))  # 110 to 180 ms
    felt = at_rest(np.zeros((len(sample_ns), 2)))
    turns = ImuData(sample_ns, felt, np.zeros_like(felt)).turns(frames)
    assert turns is not None
    assert np.isnan(turns[:, 0]).tolist() == [True, False, True, False, False]
    assert ImuData(sample_ns, felt).turns(frames) is None


def test_gyroscopes_hold_a_tilt_where_pictures_show_nothing() -> None:
    """Gyroscopes bridge 30 frames without pictures when strong accelerations hide gravity."""
    off, stated = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        n, bias = 90, rng.normal(0, 0.03, 3)
        true = correlated(rng, n, 0.05, 5)
        way = np.stack([0.05 * np.arange(n), np.zeros(n), 0.03 * np.arange(n)], -1)
        bodies = se3.in_space(way, true)
        levelling = AttitudeEstimator()
        for k in range(n):
            motion, counted = None, None
            if k:
                turn = Rotation.from_matrix(se3.between(bodies[k - 1], bodies[k])[:3, :3])
                counted = turn.as_rotvec() + 0.1 * bias + rng.normal(0, 3e-4, 3), 0.1
                if k < 60:
                    motion = measured_motion(rng, bodies[k - 1], bodies[k])
            told = true[k] + rng.normal(0, 0.05, 2)
            measured = AttitudeMeasurement(np.array([*told, 0.0]), np.array([0.05, 0.05, 0.0]))
            levelling.add(motion, measured, counted)
        made = levelling.attitude
        off.append(made.value[60:, :2] - true[60:])
        stated.append(made.sigma[60:, :2])
    assert 0.4 < np.mean((np.array(off) / np.array(stated)) ** 2) < 2
    assert np.sqrt(np.mean(np.square(off))) < 0.012


def write_felt(root: Path, acceleration: np.ndarray) -> None:
    """Write `imu0` in EuRoC's layout for the body of `written_layouts`."""
    imu = root / "mav0" / "imu0"
    imu.mkdir()
    (imu / "sensor.yaml").write_text(
        f"%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: {T_BODY_IMU.ravel().tolist()}\n"
    )
    stamps = START_NS + np.rint(np.linspace(-0.1, TIMES_S[-1] + 0.1, len(acceleration)) * 1e9)
    rows = [
        ",".join([str(int(stamp)), *map(repr, TURNING), *map(repr, values)])
        for stamp, values in zip(stamps, acceleration.tolist(), strict=True)
    ]
    (imu / "data.csv").write_text("\n".join(["#timestamp [ns],w_x,...", *rows, ""]))


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    root = write_pictures(tmp_path, drive())
    (root / "mav0" / "odometry.tum").unlink()
    return root


def test_what_euroc_s_imu_felt_levels_its_pictures(euroc: Path) -> None:
    """The body's x axis points up; body and IMU are rotated against each other."""
    robot = at_rest(np.tile([[0.02, 0.03]], (400, 1)))
    T_body_robot = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]])
    shaken = robot + np.random.default_rng(0).normal(0, 0.05, robot.shape)
    write_felt(euroc, shaken @ T_body_robot.T @ T_BODY_IMU[:3, :3])
    recording = read_recording("euroc", euroc, None, read_yaml)
    assert recording.inertial is not None
    np.testing.assert_allclose(recording.inertial.acceleration, shaken, atol=1e-9)
    turning = T_body_robot.T @ T_BODY_IMU[:3, :3] @ TURNING
    np.testing.assert_allclose(recording.inertial.rate, np.tile(turning, (400, 1)), atol=1e-12)
    one = StereoImport(recording).log_of(RecordingPart("R", slice(None)))
    assert one.attitude is not None
    np.testing.assert_allclose(one.attitude.value[0, :2], [0.02, 0.03], atol=0.004)
    assert np.all(one.attitude.sigma[:, :2] >= SHARED_RAD)


def test_what_cannot_tell_up_is_one_line(euroc: Path) -> None:
    recording = read_recording("euroc", euroc, None, read_yaml)
    with pytest.raises(InputError, match=r"--level imu: .* has no accelerations"):
        StereoImport(recording).log_of(RecordingPart("R", slice(None)), level="imu")
    write_felt(euroc, np.full((9, 3), 0.1))
    with pytest.raises(InputError, match=r"imu0.data\.csv: mean acceleration is 0\.17"):
        read_recording("euroc", euroc, None, read_yaml)
    (euroc / "mav0" / "imu0" / "data.csv").write_text("#t\n5,0,0,0,0,0\n")
    with pytest.raises(InputError, match=r"data\.csv, line 2"):
        read_recording("euroc", euroc, None, read_yaml)
