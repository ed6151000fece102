"""The factor of the odometry's noise against logs of known noise, and the law of its error."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.datasets.log_consistency import check_log, estimate_odometry_noise
from mapfusion.datasets.relative_motion import PLANAR, Motions
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose
from mapfusion.robot_log import Observations, RobotLog
from tests.mapfusion.contradicting_logs import JUMPS, MISTAKES
from tests.mapfusion.noisy_odometry import N_FRAMES, NOISE, STEP, circling, path_of, seen_log


def motions_of(path: Float, lag: int, rng: np.random.Generator, sigma: float = 1e-4) -> Motions:
    """Return the motions over spans of frames, observed with independent errors."""
    start = np.arange(0, len(path) - lag, lag)
    motion, covariance = np.zeros((len(start), 6)), np.zeros((len(start), 6, 6))
    moved = between(path[start], path[start + lag])
    motion[:, PLANAR] = moved + sigma * rng.standard_normal(moved.shape)
    covariance[:, PLANAR, PLANAR] = sigma**2
    none = np.zeros(len(start), dtype=np.int64)
    return Motions(start, start + lag, motion, covariance, none, none)


def log_of(odometry: Float) -> RobotLog:
    nothing = Observations(np.empty((0, 3)), np.empty((0, 3, 3)))
    frames = np.empty(0, dtype=np.int64)
    return RobotLog(
        "R1",
        True,
        np.linspace(0, 0.2 * (len(odometry) - 1), len(odometry)),
        odometry,
        frames,
        nothing,
    )


@pytest.mark.parametrize("turn_rad", [0.04, 0.4])
@pytest.mark.parametrize("factor", [0.5, 1, 2, 3, 5])
@pytest.mark.parametrize("lag", [1, 4])
def test_factor_has_the_law_of_the_larger_of_two_quantiles(
    factor: float, lag: int, turn_rad: float
) -> None:
    """Mean and spread of the larger of two normal variables (Clark 1961).

    The logarithm of the factor by the quantile p of n squared distances, which are exponential,
    has the standard error sqrt(p / (1 - p) / n) / (-2 ln(1 - p)): 0.72 / sqrt(n) for the median,
    0.73 / sqrt(n) for p = 0.95. The correlation of both is sqrt(0.05 / 0.95).
    """
    odometry, ratios, n_logs = circling(np.array([0.1, 0, turn_rad])), [], 60
    for seed in range(n_logs):
        rng = np.random.default_rng(seed)
        spans = [motions_of(path_of(odometry, factor, rng), lag, rng)]
        ratios.append(estimate_odometry_noise(log_of(odometry), spans, NOISE).factor / factor)
    error = 0.725 / np.sqrt((N_FRAMES - 1) // lag)
    correlation = np.sqrt(0.05 / 0.95)
    mean = error * np.sqrt((1 - correlation) / np.pi)
    spread = error * np.sqrt(1 - (1 - correlation) / np.pi)
    assert np.mean(np.log(ratios)) == pytest.approx(mean, abs=4 * spread / np.sqrt(n_logs))
    assert np.std(np.log(ratios)) == pytest.approx(spread, rel=4 / np.sqrt(2 * n_logs))


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_no_noise(name: str) -> None:
    log = seen_log(1.0, 3)
    (finding,) = check_log(replace(log, odometry=MISTAKES[name][0](log.odometry)), NOISE).findings
    assert finding.kind == "odometry"


def test_odometry_of_another_run_is_no_noise() -> None:
    log = seen_log(1.0, 3)
    turns = 0.15 * np.sign(np.sin(np.arange(len(log)) / 3))
    other = np.column_stack([np.full(len(log), 0.1), np.zeros(len(log)), turns])
    (finding,) = check_log(replace(log, odometry=other), NOISE).findings
    assert finding.kind == "odometry"


def test_slip_in_some_frames_counts_if_the_noise_is_larger() -> None:
    """The errors of every tenth frame are 12 times those stated, of the others twice."""
    odometry, rng = circling(), np.random.default_rng(0)
    path = np.zeros_like(odometry)
    for k in range(1, len(path)):
        sigma = (12 if k % 10 == 0 else 2) * NOISE.standard_deviations(odometry[k])
        path[k] = compose(path[k - 1], odometry[k] + sigma * rng.standard_normal(3))
    found = estimate_odometry_noise(log_of(odometry), [motions_of(path, 1, rng)], NOISE)
    assert found.is_larger
    assert 3 < found.factor < 8


@pytest.mark.parametrize("tracks", [False, True])
@pytest.mark.parametrize("factor", [0.5, 1, 2, 3, 5])
def test_factor_of_a_log(factor: float, tracks: bool) -> None:
    found = check_log(seen_log(factor, 3, tracks), NOISE)
    assert not found.findings
    assert found.noise.factor == pytest.approx(factor, rel=0.25)
    assert found.noise.is_larger == (factor > 1)


@pytest.mark.parametrize("noise", [NOISE, MotionNoise()])
def test_noise_as_stated_is_never_larger(noise: MotionNoise) -> None:
    """The stated noise may be that of random walks, or of systematic errors, too."""
    odometry = circling()[:90]
    for seed in range(100):
        rng = np.random.default_rng(seed)
        spans = [motions_of(path_of(odometry, 1.0, rng, noise), 1, rng)]
        assert not estimate_odometry_noise(log_of(odometry), spans, noise).is_larger


def test_systematic_errors_do_not_change_the_factor() -> None:
    """They are stated, but do not show over a few frames."""
    odometry, rng = circling(), np.random.default_rng(0)
    spans = [motions_of(path_of(odometry, 2.0, rng), 1, rng)]
    alone, both = (
        estimate_odometry_noise(log_of(odometry), spans, noise) for noise in (NOISE, MotionNoise())
    )
    assert both.factor == pytest.approx(alone.factor)
    assert both.is_larger


def test_noise_without_random_walk() -> None:
    none = replace(NOISE, translation_m_per_sqrt_m=0.0, scale_error=0.02)
    odometry, rng = circling(), np.random.default_rng(0)
    spans = [motions_of(path_of(odometry, 3.0, rng, none), 1, rng, sigma=0.0)]
    found = estimate_odometry_noise(log_of(odometry), spans, none)
    assert 3 < found.factor <= 6.5


def test_errors_that_do_not_accumulate_count_least_over_the_longest_spans() -> None:
    """Headings with twice the noise of an increment: the factor is sqrt(1 + 8 / lag) for them."""
    odometry, rng = circling(), np.random.default_rng(0)
    path = path_of(odometry, 1.0, rng)
    path += NOISE.standard_deviations(STEP) * [0, 0, 2] * rng.standard_normal(path.shape)
    log, spans = log_of(odometry), [motions_of(path, lag, rng) for lag in (1, 2, 4)]
    found = [estimate_odometry_noise(log, [span], NOISE) for span in spans]
    assert found[0].is_larger
    least = min(each.factor for each in found)
    assert least == found[-1].factor < found[0].factor
    together = estimate_odometry_noise(log, spans, NOISE)
    assert together.factor == least
    assert not together.is_larger


def test_jumps_and_false_links_do_not_change_the_factor() -> None:
    odometry, rng = circling(), np.random.default_rng(0)
    path = path_of(odometry, 1.0, rng)
    spans = [motions_of(path, lag, rng) for lag in (1, 2)]
    sound = estimate_odometry_noise(log_of(odometry), spans, NOISE).factor
    for change, _ in JUMPS.values():
        found = estimate_odometry_noise(log_of(change(odometry)), spans, NOISE)
        assert found.factor == pytest.approx(sound, rel=0.05)
    spans[0].motion[::10, 0] += 5.0
    assert not estimate_odometry_noise(log_of(odometry), spans, NOISE).is_larger


@pytest.mark.parametrize("name", JUMPS)
def test_logs_with_jumps(name: str) -> None:
    log = seen_log(1.0, 3)
    found = check_log(replace(log, odometry=JUMPS[name][0](log.odometry)), NOISE)
    assert [finding.kind for finding in found.findings] == ["jump"] * len(JUMPS[name][1])
    assert not found.noise.is_larger


def test_logs_that_show_no_motion() -> None:
    """No point is seen twice; or the observations are less accurate than the odometry."""
    log = seen_log(3.0, 3)
    own = np.arange(len(log.observations), dtype=np.int32)
    found = check_log(replace(log, observations=replace(log.observations, label=own)), NOISE).noise
    assert np.isnan(found.factor)
    assert (found.is_larger, found.n_observed) == (False, 0)
    odometry, rng = circling(), np.random.default_rng(0)
    spans = [motions_of(path_of(odometry, 3.0, rng), 1, rng, sigma=0.1)]
    found = estimate_odometry_noise(log_of(odometry), spans, NOISE)
    assert np.isnan(found.factor)
    assert (found.is_larger, found.n_observed) == (False, len(log) - 1)


def test_observations_without_errors() -> None:
    odometry, rng = circling(), np.random.default_rng(0)
    for factor in (0.0, 2.0):
        spans = [motions_of(path_of(odometry, factor, rng), 1, rng, sigma=0.0)]
        found = estimate_odometry_noise(log_of(odometry), spans, NOISE)
        assert found.factor == pytest.approx(factor, rel=0.2, abs=1e-6)


def test_text_has_both_figures() -> None:
    noise = check_log(seen_log(3.0, 3), NOISE).noise
    stated_m, _, stated_rad = NOISE.standard_deviations(STEP)
    assert f"{noise.factor:.1f} times as noisy as stated" in noise.text
    assert f"stated: {stated_m:.2g} m and {stated_rad:.2g} rad" in noise.text
    assert f"({noise.factor * stated_m:.2g} m and {noise.factor * stated_rad:.2g} rad" in noise.text
