"""Rows by which a pair is off, against pairs that are off by known rows."""

import cv2
import numpy as np
import pytest

from mapfusion.geometry.camera import StereoCamera
from mapfusion.vision.harris import HarrisParameters
from mapfusion.vision.stereo_noise import rectification_offsets
from tests.mapfusion.vision.rendered_scene import render, wall

CAMERA = StereoCamera(width_px=320, height_px=240, focal_px=290.0)


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    planes = [wall(rng, (4, 3), (3, -3), 8.0, -3.0)]
    return render(planes, CAMERA, noise=2.0, rng=rng)[:2]


@pytest.mark.parametrize("rows", [-6.0, 0.0, 2.5])
def test_a_shift_is_found(pair: tuple[np.ndarray, np.ndarray], rows: float) -> None:
    moved = np.array([[1, 0, 0], [0, 1, rows]])
    right = cv2.warpAffine(pair[1], moved, (320, 240), borderMode=cv2.BORDER_REPLICATE)
    errors = rectification_offsets(pair[0], right, HarrisParameters())[:, 1]
    assert len(errors) > 30
    assert np.median(errors) == pytest.approx(rows, abs=0.15)


def test_pictures_without_corners_say_nothing() -> None:
    flat = np.full((240, 320), 90, np.uint8)
    assert len(rectification_offsets(flat, flat, HarrisParameters())) == 0
