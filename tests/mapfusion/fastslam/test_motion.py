from dataclasses import replace

import numpy as np
import pytest

from mapfusion.fastslam.motion import MotionNoise, sample_motion
from mapfusion.geometry.se2 import between, compose

NOISE = MotionNoise(
    0.02,
    0.01,
    0.03,
    0.05,
    0.04,
    horizon_m=4.0,
    horizon_rad=2.0,
    lateral_m_per_sqrt_m=0.007,
    lateral_slip_m_per_rad=0.0,
)
EXACT = MotionNoise(0, 0, 0, 0, 0, lateral_m_per_sqrt_m=0, lateral_slip_m_per_rad=0)


def test_spread_is_the_stated_one():
    n = 40_000
    start = np.tile([3.0, -1.0, 3.0], (n, 1))  # the heading is near pi: samples wrap
    odometry = np.array([0.3, 0.4, -0.6])
    poses = sample_motion(
        start, odometry, NOISE.standard_deviations(odometry), np.random.default_rng(0)
    )
    moved = between(start, poses) - odometry
    along = 0.02**2 * 0.5 + 0.05**2 * 4.0 * 0.5
    heading = 0.01**2 * 0.5 + (0.03**2 + 0.04**2 * 2.0) * 0.6
    expected = np.sqrt([along, 0.007**2 * 0.5, heading])
    # A standard deviation from n samples scatters by 1 / sqrt(2 n); five of these.
    np.testing.assert_allclose(moved.std(axis=0), expected, rtol=5 / np.sqrt(2 * n))
    assert np.all(np.abs(moved.mean(axis=0)) < 5 * expected / np.sqrt(n))
    assert np.all(np.abs(poses[:, 2]) <= np.pi)


def test_turning_slips_sideways():
    slipping = replace(EXACT, lateral_slip_m_per_rad=0.1)
    sigma = slipping.standard_deviations(np.array([0.3, 0.0, -0.5]))
    np.testing.assert_allclose(sigma, [0, 0.05, 0])


def test_many_short_steps_spread_as_one_long():
    long = NOISE.standard_deviations(np.array([0.6, 0.0, 0.9]))
    short = NOISE.standard_deviations(np.array([0.06, 0.0, 0.09]))
    np.testing.assert_allclose(long, np.sqrt(10) * short)


@pytest.mark.parametrize("relative_error", [0.02, 0.1])
def test_covers_a_systematic_error_at_the_horizon(relative_error):
    noise = replace(
        EXACT, scale_error=relative_error, track_error=relative_error, horizon_m=5, horizon_rad=3
    )
    sigma = noise.standard_deviations(np.array([5.0, 0.0, 3.0]))
    np.testing.assert_allclose(sigma, [5 * relative_error, 0, 3 * relative_error])


def test_standing_still_adds_only_the_floor():
    start = np.tile([1.0, 2.0, 0.5], (10, 1))
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(
        sample_motion(start, np.zeros(3), NOISE.standard_deviations(np.zeros(3)), rng),
        start,
        atol=1e-15,
    )
    pushed = MotionNoise(floor_m=0.1, floor_rad=0.2)
    np.testing.assert_array_equal(pushed.standard_deviations(np.zeros(3)), [0.1, 0.1, 0.2])


def test_without_noise_it_is_the_odometry():
    rng = np.random.default_rng(1)
    start, odometry = rng.normal(size=(20, 3)), rng.normal(size=3)
    np.testing.assert_allclose(
        sample_motion(start, odometry, EXACT.standard_deviations(odometry), rng),
        compose(start, odometry),
        atol=1e-15,
    )


@pytest.mark.parametrize("name", ["scale_error", "floor_m", "horizon_rad"])
def test_wrong_values_are_named(name):
    for value in (-1.0, np.nan):
        with pytest.raises(ValueError, match=name):
            MotionNoise(**{name: value})


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_scaled_noise_has_scaled_standard_deviations(factor: float) -> None:
    noise = replace(NOISE, lateral_slip_m_per_rad=0.02, floor_m=0.001, floor_rad=0.002)
    for odometry in np.random.default_rng(0).normal(0, 0.3, (20, 3)):
        np.testing.assert_allclose(
            noise.scaled(factor).standard_deviations(odometry),
            factor * noise.standard_deviations(odometry),
            rtol=1e-12,
        )
    assert noise.scaled(1.0) is noise


def test_noise_is_scaled_by_any_factor() -> None:
    """Parameters have ranges, which large factors would exceed."""
    step = np.array([0.1, 0, 0.1])
    small = MotionNoise(1e-6, 1e-6, 1e-6, 1e-6, 1e-6)
    expected = 1e4 * small.standard_deviations(step)
    np.testing.assert_allclose(small.scaled(1e4).standard_deviations(step), expected)
    assert np.isfinite(NOISE.scaled(1e6).standard_deviations(step)).all()
