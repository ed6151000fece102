"""A body's sway has the law that it is told to have."""

import numpy as np
import pytest

from sim.sway import AttitudeNoise, BodySway


def test_spread_and_correlation_are_as_set() -> None:
    time_s = 0.2 * np.arange(40_000)
    tilt = BodySway(0.05, 0.5).tilts(time_s, np.random.default_rng(0))
    assert tilt.std(axis=0) == pytest.approx([0.05, 0.05], rel=0.03)
    for lag in (1, 3):
        product = np.mean(tilt[lag:] * tilt[:-lag], axis=0) / 0.05**2
        assert product == pytest.approx([np.exp(-0.4 * lag)] * 2, abs=0.03)
    assert abs(np.corrcoef(tilt.T)[0, 1]) < 0.03


def test_after_a_pause_nothing_is_left() -> None:
    time_s = np.array([0.0, 1e-9, 1e6])
    drawn = [BodySway(0.05).tilts(time_s, np.random.default_rng(k)) for k in range(4000)]
    first, soon, late = np.array(drawn)[..., 0].T
    np.testing.assert_allclose(soon, first, atol=1e-4)
    assert abs(np.corrcoef(first, late)[0, 1]) < 0.05
    assert late.std() == pytest.approx(0.05, rel=0.05)


def test_what_is_measured_errs_anew_in_each_frame() -> None:
    tilt = np.full((20_000, 2), 0.02)
    error = AttitudeNoise(sigma_rad=0.005).applied(tilt, np.random.default_rng(1)) - tilt
    assert error.std(axis=0) == pytest.approx([0.005, 0.005], rel=0.03)
    assert abs(np.mean(error[1:] * error[:-1])) < 0.03 * 0.005**2
