import numpy as np
import pytest
from scipy.stats import kstest, norm

from mapfusion.errors import InputError
from sim.stereo_head import VALUES, RadiometricNoise, draw_bits, expose, normal_values


def test_the_table_is_the_normal_law() -> None:
    values = normal_values().astype(float)
    assert values.mean() == pytest.approx(0, abs=1e-7)
    assert values.std() == pytest.approx(1, abs=1e-6)
    # the share below each value, half of its own included
    np.testing.assert_allclose(norm.cdf(values), (np.arange(VALUES) + 0.5) / VALUES, atol=1e-4)


@pytest.mark.parametrize("n", [1, 3, 4, 100_001])
def test_bits_are_equally_likely_and_independent(n: int) -> None:
    bits = draw_bits(n, np.random.default_rng(5))
    assert bits.shape == (n,)
    if n > 100_000:
        for digit in range(16):  # binary
            ones = bits >> digit & 1
            assert abs(ones.mean() - 0.5) < 4 * 0.5 / np.sqrt(n)
            assert abs(np.corrcoef(ones[1:], ones[:-1])[0, 1]) < 4 / np.sqrt(n)


def test_noise_follows_the_normal_law_with_its_sigma() -> None:
    noise = RadiometricNoise(sigma_gray=20.0, sigma_gain=0, sigma_offset_gray=0)
    flat = np.full((300, 400), 128, dtype=np.uint8)
    rng = np.random.default_rng(3)
    seen = expose(flat, noise, rng) + rng.uniform(-0.5, 0.5, flat.shape)  # rounding taken back
    assert kstest((seen.ravel() - 128) / 20, "norm").pvalue > 0.001
    off = seen - 128
    for aside in (off[:, 1:] * off[:, :-1], off[1:] * off[:-1]):  # neighbours know nothing
        assert abs(aside.mean() / 400) < 4 / np.sqrt(aside.size)


def test_each_pixel_is_its_level_and_its_deviation_rounded_and_kept_in_a_byte() -> None:
    noise = RadiometricNoise(sigma_gray=9.0, sigma_gain=0.2, sigma_offset_gray=10.0, gain=1.1)
    gray = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)
    seen = expose(gray, noise, np.random.default_rng(7))
    rng = np.random.default_rng(7)
    gain, offset = 1.1 * (1 + 0.2 * rng.standard_normal()), 10.0 * rng.standard_normal()
    bits = draw_bits(gray.size, rng).reshape(gray.shape)
    level = gain * gray + offset + 9.0 * normal_values().astype(float)[bits]
    clear = np.abs(level % 1 - 0.5) > 1e-3  # single precision rounds no differently
    np.testing.assert_array_equal(seen[clear], np.rint(level.clip(0, 255))[clear])
    assert clear.mean() > 0.99
    assert {0, 255} <= set(seen.ravel().tolist())


def test_gamma_is_a_power_of_the_light_over_the_full_range() -> None:
    ramp = np.arange(256, dtype=np.uint8)[None]
    for gamma, gain in ((1.0, 1.0), (2.0, 1.0), (0.5, 0.8)):
        noise = RadiometricNoise(0, sigma_gain=0, sigma_offset_gray=0, gain=gain, gamma=gamma)
        seen = expose(ramp, noise, np.random.default_rng(0))[0].astype(float)
        np.testing.assert_allclose(seen, 255 * gain * (ramp[0] / 255) ** gamma, atol=0.501)


def test_gain_and_offset_are_those_of_a_whole_image() -> None:
    noise = RadiometricNoise(sigma_gray=0, sigma_gain=0.05, sigma_offset_gray=4)
    ramp = np.tile(np.arange(60, 200, dtype=np.uint8), (4, 1))
    fits = [
        np.polyfit(ramp[0], expose(ramp, noise, np.random.default_rng(seed))[0], 1)
        for seed in range(400)
    ]
    gain, offset = np.transpose(fits)
    assert gain.mean() == pytest.approx(1, abs=0.01)
    assert gain.std() == pytest.approx(0.05, rel=0.15)
    assert offset.std() == pytest.approx(4, rel=0.15)


def test_a_dark_camera_scales_the_light_and_not_the_noise() -> None:
    dark = RadiometricNoise(sigma_gray=3.0, sigma_gain=0, sigma_offset_gray=0, gain=0.25)
    flat = np.full((200, 300), 160, dtype=np.uint8)
    seen = expose(flat, dark, np.random.default_rng(2)).astype(float)
    assert seen.mean() == pytest.approx(40, abs=0.05)
    assert seen.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)


def test_negative_noise_is_refused() -> None:
    with pytest.raises(InputError, match="gain: is -1"):
        RadiometricNoise(gain=-1)
