"""Tests of `mapfusion.attitude`."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from mapfusion.attitude import (
    FILE,
    Attitude,
    attitude_height_errors,
    level_observations,
    read_attitude,
    transform_observations,
    write_attitude,
)
from mapfusion.errors import InputError
from mapfusion.geometry import se2, se3
from mapfusion.robot_log import Observations


def seen(rng: np.random.Generator, n: int = 20) -> Observations:
    root = 0.05 * rng.normal(size=(n, 3, 3))
    return Observations(rng.uniform([1, -2, 0], [5, 2, 2], (n, 3)), root @ root.swapaxes(1, 2))


def test_rotations_are_scipy_s() -> None:
    rng = np.random.default_rng(0)
    roll, pitch, yaw = rng.uniform(-1, 1, (3, 50))
    R = se3.tilt(roll, pitch)
    expected = Rotation.from_euler("ZYX", np.stack([0 * roll, pitch, roll], -1)).as_matrix()
    np.testing.assert_allclose(R, expected, atol=1e-15)
    turned = Rotation.from_euler("z", yaw[:, None]).as_matrix() @ R
    np.testing.assert_allclose(se3.roll_pitch(turned), np.stack([roll, pitch], -1), atol=1e-12)
    x_y_yaw = np.stack([roll, pitch, yaw], -1)
    T = se3.in_space(x_y_yaw, np.stack([roll, pitch], -1))
    np.testing.assert_allclose(T[:, :3, :3], turned, atol=1e-12)
    np.testing.assert_allclose(se3.planar(T), x_y_yaw, atol=1e-12)


def test_signs_are_those_of_a_body() -> None:
    """Looking down, what is ahead is lower; the right side down, what is to the left is higher."""
    ahead, left = np.eye(3)[:2]
    assert (se3.tilt(0.0, 0.1) @ ahead)[2] < 0
    assert (se3.tilt(0.1, 0.0) @ left)[2] > 0


def test_levelled_points_are_where_the_body_s_pose_has_them() -> None:
    rng = np.random.default_rng(1)
    body = seen(rng)
    value = np.array([0.05, -0.08, 0.3])
    made = level_observations(body, value, np.zeros(3))
    T = se3.in_space(np.zeros(3), value[:2])
    T[2, 3] = value[2]
    expected = (np.c_[body.position_m, np.ones(len(body))] @ T.T)[:, :3]
    np.testing.assert_allclose(made.position_m, expected, atol=1e-13)
    turned = T[:3, :3] @ body.covariance_m2 @ T[:3, :3].T
    np.testing.assert_allclose(made.covariance_m2, turned, atol=1e-15)


def test_the_covariance_holds_what_the_attitude_errs_by() -> None:
    """Against the spread over attitudes drawn from their error."""
    rng = np.random.default_rng(2)
    exact = Observations(seen(rng, 3).position_m, np.zeros((3, 3, 3)))
    value, sigma = np.array([0.06, -0.05, 0.1]), np.array([0.01, 0.02, 0.03])
    drawn = value + sigma * rng.standard_normal((20_000, 3))
    R = se3.tilt(drawn[:, 0], drawn[:, 1])
    points = np.einsum("kij,nj->nki", R, exact.position_m)
    points[..., 2] += drawn[:, 2]
    made = level_observations(exact, value, sigma)
    for own, spread in zip(made.covariance_m2, map(np.cov, points.swapaxes(1, 2)), strict=True):
        scale = np.sqrt(np.diag(spread))
        np.testing.assert_allclose(own / scale / scale[:, None], spread / scale / scale[:, None],
                                   atol=0.04)  # fmt: skip


def test_moved_there_and_back_they_are_the_same() -> None:
    rng = np.random.default_rng(3)
    first, T = seen(rng), se3.pose(se3.tilt(0.3, -0.2), [0.1, 0.2, 0.3])
    back = se3.inverse(T)
    made = transform_observations(
        transform_observations(first, T[:3, :3], T[:3, 3]), back[:3, :3], back[:3, 3]
    )
    np.testing.assert_allclose(made.position_m, first.position_m, atol=1e-14)
    np.testing.assert_allclose(made.covariance_m2, first.covariance_m2, atol=1e-15)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    assert read_attitude(tmp_path) is None
    rng = np.random.default_rng(4)
    value, sigma, carried = rng.uniform(0, 0.1, (3, 5, 3))
    attitude = Attitude(value, sigma, carried[:, :2])
    write_attitude(tmp_path, attitude)
    found = read_attitude(tmp_path)
    assert found is not None
    assert len(found) == 5
    np.testing.assert_array_equal(found.value, attitude.value)
    np.testing.assert_array_equal(found.sigma, attitude.sigma)
    np.testing.assert_array_equal(found.carried, attitude.carried)
    write_attitude(tmp_path, None)
    assert not (tmp_path / FILE).exists()


def test_of_the_version_before_each_frame_errs_for_itself(tmp_path: Path) -> None:
    tenth = np.full((3, 3), 0.1)
    write_attitude(tmp_path, Attitude(tenth, tenth, np.ones((3, 2))))
    path = tmp_path / FILE
    table = pq.read_table(path)
    metadata = {**table.schema.metadata, b"mapfusion.schema_version": b"1"}
    table = table.drop_columns(["carried_tilt", "carried_height"])
    pq.write_table(table.replace_schema_metadata(metadata), path)
    found = read_attitude(tmp_path)
    assert found is not None
    np.testing.assert_array_equal(found.value, tenth)
    assert not found.carried.any()


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    write_attitude(tmp_path, Attitude(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 2))))
    path = tmp_path / FILE
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match=FILE):
        read_attitude(tmp_path)


@pytest.mark.parametrize(
    ("value", "sigma", "message"),
    [
        ([[0, 1.6, 0]], [[0, 0, 0]], "roll and pitch"),
        ([[0, 0, 0]], [[0, -1, 0]], "sigma: is below 0"),
        ([[0, np.nan, 0]], [[0, 0, 0]], "value: contains NaN"),
        ([[0, 0, 0]], [[0, 0]], "sigma: shape"),
    ],
)
def test_what_no_body_has_is_refused(value: list, sigma: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Attitude(np.array(value, dtype=float), np.array(sigma, dtype=float), np.zeros((1, 2)))


@pytest.mark.parametrize("carried", [-0.1, 1.1])
def test_no_more_is_carried_than_there_is(carried: float) -> None:
    with pytest.raises(ValueError, match="carried: is not between"):
        Attitude(np.zeros((1, 3)), np.zeros((1, 3)), np.array([[carried, 1.0]]))


@pytest.mark.parametrize("n_frames", [3, 5])
def test_one_row_belongs_to_each_frame_of_the_log(tmp_path, n_frames):
    write_attitude(tmp_path, Attitude(np.zeros((4, 3)), np.ones((4, 3)), np.zeros((4, 2))))
    assert read_attitude(tmp_path, 4) is not None
    with pytest.raises(InputError, match=f"has 4 rows, the log {n_frames} frames"):
        read_attitude(tmp_path, n_frames)


N_FRAMES, N_LANDMARKS = 40, 5
FIRST, STEP = np.array([0.01, 0.0]), np.array([2e-4, 1e-3])  # sigma of tilts (rad), heights (m)


def a_drive(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A path, frames and landmarks of sightings, and the landmarks."""
    path = np.zeros((N_FRAMES, 3))
    for k in range(1, N_FRAMES):
        path[k] = se2.compose(path[k - 1], np.array([0.2, 0.0, 0.05]))
    landmark = np.repeat(np.arange(N_LANDMARKS), 4)
    frame = rng.integers(2, N_FRAMES, len(landmark))
    return path, frame, landmark, rng.uniform(-5, 5, (N_LANDMARKS, 3))


def drawn_errors(
    rng: np.random.Generator, path: np.ndarray, carried: np.ndarray, n: int
) -> np.ndarray:
    """(T, n, 3) tilts about the map's axes, and heights, as one follows from the other."""
    errors = np.zeros((N_FRAMES, n, 3))
    errors[0] = rng.standard_normal((n, 3)) * FIRST[[0, 0, 1]]
    for k in range(1, N_FRAMES):
        dx, dy = path[k, :2] - path[k - 1, :2]
        before = errors[k - 1]
        climbed = before[:, 2] + before[:, 0] * dy - before[:, 1] * dx
        kept = np.column_stack([before[:, :2] * carried[0], climbed * carried[1]])
        errors[k] = kept + rng.standard_normal((n, 3)) * STEP[[0, 0, 1]]
    return errors


@pytest.mark.parametrize("carried", [(1.0, 1.0), (0.9, 1.0), (0.8, 0.7)])
def test_they_spread_as_stated(carried: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    path, frame, landmark, point = a_drive(rng)
    errors = drawn_errors(rng, path, np.array(carried), 20_000)
    sigma = errors.std(axis=1)
    sigma[:, :2] = sigma[:, :2].mean(axis=1, keepdims=True)
    told = Attitude(np.zeros_like(sigma), sigma, np.tile(carried, (N_FRAMES, 1)))
    arm = point[landmark, :2] - path[frame, :2]
    own = errors[frame]
    lifted = own[:, :, 0] * arm[:, 1:] - own[:, :, 1] * arm[:, :1] + own[:, :, 2]
    spread = np.cov(lifted.reshape(N_LANDMARKS, 4, -1).mean(axis=1))
    shared = attitude_height_errors(told, path, frame, landmark, point)
    scale = np.sqrt(np.diag(spread))
    found = shared.T @ shared / np.outer(scale, scale)
    np.testing.assert_allclose(found, spread / np.outer(scale, scale), atol=0.05)


def test_a_tilt_at_first_tilts_the_whole_map() -> None:
    path, frame, landmark, point = a_drive(np.random.default_rng(1))
    sigma = np.tile([0.01, 0.01, 0.0], (N_FRAMES, 1))
    sigma[:, 2] = 0.01 * np.hypot(*path[:, :2].T)  # a tilted robot climbs, and does nothing else
    told = Attitude(np.zeros_like(sigma), sigma, np.ones((N_FRAMES, 2)))
    shared = attitude_height_errors(told, path, frame, landmark, point)
    expected = 1e-4 * point[:, :2] @ point[:, :2].T
    np.testing.assert_allclose(shared.T @ shared, expected, atol=1e-12)


def test_long_logs_have_no_more_of_them() -> None:
    """Frames that share a source err a little more together than they would alone."""
    n = 500
    path = np.column_stack([np.linspace(0, 1, n), np.zeros((n, 2))])
    sigma = 1e-3 * np.sqrt(np.arange(1, n + 1))[:, None] * [1.0, 1.0, 5.0]
    told = Attitude(np.zeros((n, 3)), sigma, np.ones((n, 2)))
    point = path[[100, 499]] + [0.0, 3.0, 0.0]
    shared = attitude_height_errors(told, path, np.array([100, 499]), np.array([0, 1]), point)
    assert len(shared) <= 3 * 65
    stated = 9 * sigma[[100, 499], 0] ** 2 + sigma[[100, 499], 2] ** 2
    assert np.sum(shared**2, axis=0) == pytest.approx(stated, rel=0.1)


def test_a_frame_measured_for_itself_shares_nothing_with_those_before() -> None:
    """Frame 3 carries nothing, so its error is independent of the errors before it."""
    path = np.column_stack([0.3 * np.arange(6.0), np.zeros((6, 2))])
    carried = np.ones((6, 2))
    carried[3] = 0.0
    told = Attitude(np.zeros((6, 3)), np.tile([0.01, 0.01, 0.005], (6, 1)), carried)
    frame, point = np.arange(6), path + np.array([1.0, 2.0, 0.0])
    shared = attitude_height_errors(told, path, frame, np.arange(6), point)
    both = shared.T @ shared
    assert not both[:3, 3:].any()
    assert np.all(both[:3, :3] > 0)
    assert np.all(both[3:, 3:] > 0)


def test_a_tilt_of_any_heading_is_the_mean_of_the_variances_of_roll_and_pitch() -> None:
    """Roll lifts what is beside the robot, pitch what is ahead; the test averages over headings."""
    roll_rad, pitch_rad, heading = 0.01, 0.03, np.linspace(-np.pi, np.pi, 8, endpoint=False)
    sigma = np.tile([roll_rad, pitch_rad, 0.0], (1, 1))
    told = Attitude(np.zeros((1, 3)), sigma, np.zeros((1, 2)))
    arm = np.array([2.0, 1.0, 0.0])
    shared = attitude_height_errors(told, np.zeros((1, 3)), np.array([0]), np.array([0]), arm[None])
    ahead = arm[0] * np.cos(heading) + arm[1] * np.sin(heading)
    beside = arm[1] * np.cos(heading) - arm[0] * np.sin(heading)
    expected = np.mean((beside * roll_rad) ** 2 + (ahead * pitch_rad) ** 2)
    assert np.sum(shared**2) == pytest.approx(expected)
