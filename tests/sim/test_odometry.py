import numpy as np
import pytest

from mapfusion.errors import InputError
from sim.odometry import OdometryNoise, add_noise, calibrated_track_m, encoder_increments
from sim.p3at import SKID_TRACK_M, TRACK_M, WHEEL_RADIUS_M, P3at
from sim.world import World

QUIET = OdometryNoise(0, 0, 0, 0, 0)


def test_calibration_finds_the_track_of_coulomb_friction() -> None:
    assert calibrated_track_m() > TRACK_M
    assert calibrated_track_m() == pytest.approx(SKID_TRACK_M, rel=0.125)


def test_calibration_is_deterministic() -> None:
    first = calibrated_track_m()
    calibrated_track_m.cache_clear()
    assert calibrated_track_m() == first


@pytest.mark.parametrize(("left", "right"), [(-1.5, 1.5), (3.0, 5.0), (4.5, 3.5)])
def test_calibrated_encoders_tell_how_the_body_moves(left: float, right: float) -> None:
    """Spins and arcs of other radii, other speeds and the other sense than the calibration's."""
    with World() as world:
        world.start_physics()
        robot = P3at(world, np.zeros(3))
        robot.drive(left, right)
        world.step(120)
        poses, wheels = [robot.pose()], [robot.wheel_angles()]
        for _ in range(160):
            world.step(12)
            poses.append(robot.pose())
            wheels.append(robot.wheel_angles())
    increments = encoder_increments(np.array(wheels), calibrated_track_m())
    true_yaw = np.diff(np.unwrap(np.array(poses)[:, 2])).sum()
    assert abs(true_yaw) > 1.5
    assert increments[:, 2].sum() == pytest.approx(true_yaw, rel=0.06)
    path = np.hypot(*np.diff(np.array(poses)[:, :2], axis=0).T).sum()
    assert np.hypot(*increments[:, :2].T).sum() == pytest.approx(path, rel=0.03, abs=0.02)


def test_increments_are_those_of_a_finely_integrated_arc() -> None:
    wheel = np.array([[0, 0], [3.0, 5.0], [2.0, 9.0], [2.0, 9.0]])
    track = 0.6
    increments = encoder_increments(wheel, track)
    np.testing.assert_array_equal(increments[0], 0)
    np.testing.assert_array_equal(increments[3], 0)
    for (left, right), increment in zip(np.diff(wheel[:3], axis=0), increments[1:3], strict=True):
        n = 100_000
        x = y = theta = 0.0
        ds = (left + right) / 2 * WHEEL_RADIUS_M / n
        dtheta = (right - left) * WHEEL_RADIUS_M / track / n
        heading = theta + dtheta * (np.arange(n) + 0.5)
        x, y, theta = np.sum(ds * np.cos(heading)), np.sum(ds * np.sin(heading)), dtheta * n
        np.testing.assert_allclose(increment, [x, y, theta], atol=1e-9)


def test_no_noise_changes_nothing() -> None:
    increments = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(
        add_noise(increments, QUIET, np.random.default_rng(0)), increments, atol=1e-12
    )


def test_a_standing_robot_drifts_nowhere() -> None:
    noisy = add_noise(np.zeros((10, 3)), OdometryNoise(), np.random.default_rng(0))
    np.testing.assert_array_equal(noisy, 0)


@pytest.mark.parametrize("steps", [10, 160])
def test_random_walk_follows_its_law_at_any_frame_rate(steps: int) -> None:
    """4 m straight: 0.02 sqrt(4) m along and 0.01 sqrt(4) rad, however finely it is cut."""
    increments = np.tile([4.0 / steps, 0, 0], (steps, 1))
    noise = OdometryNoise(scale_sigma=0, track_sigma=0)
    rng = np.random.default_rng(1)
    runs = np.array([add_noise(increments, noise, rng) for _ in range(3000)])
    along, yaw = np.hypot(runs[..., 0], runs[..., 1]).sum(axis=1), runs[..., 2].sum(axis=1)
    assert along.mean() == pytest.approx(4, abs=0.004)
    assert along.std() == pytest.approx(0.04, rel=0.05)
    assert yaw.mean() == pytest.approx(0, abs=0.002)
    assert yaw.std() == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize("steps", [10, 160])
def test_turning_adds_to_the_heading_walk_only(steps: int) -> None:
    increments = np.tile([0, 0, -2.0 / steps], (steps, 1))
    noise = OdometryNoise(scale_sigma=0, track_sigma=0)
    rng = np.random.default_rng(2)
    runs = np.array([add_noise(increments, noise, rng) for _ in range(3000)])
    np.testing.assert_array_equal(runs[..., :2], 0)
    assert runs[..., 2].sum(axis=1).std() == pytest.approx(0.03 * np.sqrt(2), rel=0.05)


def test_scale_and_track_are_drawn_once_a_robot() -> None:
    increments = np.tile([0.1, 0, 0.05], (40, 1))
    noise = OdometryNoise(0, 0, 0)
    rng = np.random.default_rng(3)
    runs = np.array([add_noise(increments, noise, rng) for _ in range(4000)])
    np.testing.assert_allclose(runs, runs[:, :1] * np.ones((1, 40, 1)))  # the same in every step
    scale = np.hypot(runs[:, 0, 0], runs[:, 0, 1]) / 0.1
    yaw = runs[:, 0, 2] / 0.05
    assert scale.std() == pytest.approx(0.01, rel=0.05)
    assert yaw.std() == pytest.approx(np.hypot(0.01, 0.02), rel=0.05)
    assert (yaw / scale).std() == pytest.approx(0.02, rel=0.05)


def test_a_wrong_radius_is_encoders_that_count_too_much() -> None:
    wheel = np.cumsum(np.random.default_rng(4).uniform([0.5, 1.5], [1.0, 2.5], (60, 2)), axis=0)
    wheel -= wheel[0]
    increments = encoder_increments(wheel, 0.5)
    noise = OdometryNoise(0, 0, 0, scale_sigma=0.05, track_sigma=0)
    noisy = add_noise(increments, noise, np.random.default_rng(5))
    scale = noisy[1, 2] / increments[1, 2]
    assert abs(scale - 1) > 0.03
    np.testing.assert_allclose(noisy, encoder_increments(scale * wheel, 0.5), atol=2e-4)


def test_backwards_stays_backwards() -> None:
    noisy = add_noise(np.tile([-0.1, 0, 0], (20, 1)), OdometryNoise(), np.random.default_rng(0))
    assert np.all(noisy[:, 0] < 0)


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="wheel_rad: shape"):
        encoder_increments(np.zeros((4, 3)), 0.5)
    with pytest.raises(ValueError, match="increments: contains NaN"):
        add_noise(np.full((4, 3), np.nan), OdometryNoise(), np.random.default_rng(0))
    with pytest.raises(InputError, match=r"scale_sigma: is -0\.1"):
        OdometryNoise(scale_sigma=-0.1)


def test_the_walks_of_way_and_heading_are_independent() -> None:
    noise = OdometryNoise(0.1, 0.1, 0.0, scale_sigma=0.0, track_sigma=0.0)
    straight = np.tile([0.25, 0.0, 0.0], (20_000, 1))
    measured = add_noise(straight, noise, np.random.default_rng(7))
    along = np.hypot(measured[:, 0], measured[:, 1]) - 0.25
    assert along.std() == pytest.approx(0.1 * np.sqrt(0.25), rel=0.03)
    assert measured[:, 2].std() == pytest.approx(0.1 * np.sqrt(0.25), rel=0.03)
    assert abs(np.corrcoef(along, measured[:, 2])[0, 1]) < 4 / np.sqrt(20_000)
