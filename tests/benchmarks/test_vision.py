"""Speed of the front end on a 640x480 pair; run with `pytest tests/benchmarks --benchmark-only`.

Bars: U-SURF 4 microseconds a keypoint, the whole front end 15 ms.
"""

import cv2
import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.vision.front_end import FrontEnd
from mapfusion.vision.harris import HarrisParameters, detect
from mapfusion.vision.stereo import StereoParameters, match
from mapfusion.vision.surf import describe
from mapfusion.vision.tracking import TrackParameters, link

KEYPOINTS = 1000
CAMERA = StereoCamera()


@pytest.fixture(autouse=True)
def single_thread():
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A textured wall at 3.5 m, with sensor noise."""
    rng = np.random.default_rng(0)
    disparity = round(CAMERA.focal_px * CAMERA.baseline_m / 3.5)
    shape = (CAMERA.height_px, CAMERA.width_px + disparity)
    texture = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 2.5)
    texture = 128 + 40 * texture / texture.std()
    images = (texture[:, :-disparity], texture[:, disparity:])
    left, right = (
        np.clip(np.rint(i + 2 * rng.standard_normal(i.shape)), 0, 255).astype(np.uint8)
        for i in images
    )
    return left, right


def test_harris(benchmark, pair: tuple[np.ndarray, np.ndarray]) -> None:
    corners = benchmark(detect, pair[0], HarrisParameters())
    benchmark.extra_info["corners"] = len(corners)


def test_usurf(benchmark, pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Integral image included; divide by the keypoints."""
    rng = np.random.default_rng(1)
    uv = rng.uniform([30, 30], [610, 450], (KEYPOINTS, 2))
    scale = np.full(KEYPOINTS, 2.0)
    describe(pair[0], uv, scale)
    benchmark(describe, pair[0], uv, scale)
    benchmark.extra_info["microseconds_a_keypoint"] = benchmark.stats.stats.median / KEYPOINTS * 1e6


def test_stereo(benchmark, pair: tuple[np.ndarray, np.ndarray]) -> None:
    uv = detect(pair[0], HarrisParameters())
    match(*pair, uv, CAMERA, StereoParameters())
    benchmark(match, *pair, uv, CAMERA, StereoParameters())
    benchmark.extra_info["corners"] = len(uv)


def test_link(benchmark, pair: tuple[np.ndarray, np.ndarray]) -> None:
    features = FrontEnd(CAMERA).extract(*pair)
    link(features, features, TrackParameters())
    benchmark(link, features, features, TrackParameters())


def test_front_end(benchmark, pair: tuple[np.ndarray, np.ndarray]) -> None:
    front_end = FrontEnd(CAMERA)
    assert len(front_end.extract(*pair)) >= 60
    features = benchmark(front_end.extract, *pair)
    benchmark.extra_info["features"] = len(features)
