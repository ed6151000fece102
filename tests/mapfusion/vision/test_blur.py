"""Smoothed pictures against OpenCV's, to the last bit."""

import cv2
import numpy as np
import pytest

from mapfusion.vision.blur import REACH_PX, smoothed, weights

OURS_PX = 1.5


@pytest.mark.parametrize("sigma_px", [0.5, 1.45, OURS_PX, 1.55, 3.0])
@pytest.mark.parametrize("shape", [(4, 40), (6, 6), (7, 33), (100, 6), (121, 163)])
def test_values_are_opencv_s(shape: tuple[int, int], sigma_px: float) -> None:
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 256, shape, dtype=np.uint8)
    for image in (noise, np.where(noise > 127, 255, 0).astype(np.uint8), np.full_like(noise, 255)):
        expected = cv2.GaussianBlur(image, (0, 0), sigma_px)
        np.testing.assert_array_equal(smoothed(image, sigma_px), expected)


def test_part_of_a_picture_is_a_picture() -> None:
    image = np.random.default_rng(2).integers(0, 256, (60, 80), dtype=np.uint8)[::2, 7:40]
    expected = cv2.GaussianBlur(image.copy(), (0, 0), OURS_PX)
    np.testing.assert_array_equal(smoothed(image, OURS_PX), expected)


@pytest.mark.parametrize("sigma_px", [1.42, OURS_PX, 1.6])
def test_weights_keep_brightness_and_fall_outwards(sigma_px: float) -> None:
    found = weights(2 * REACH_PX + 1, sigma_px)
    assert 2 * found[:-1].sum() + found[-1] == 256
    assert np.all(np.diff(found) > 0)
