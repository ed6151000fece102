"""The noise model found from pictures alone, where the noise that was put in is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.camera import StereoCamera
from mapfusion.vision.harris import HarrisParameters
from mapfusion.vision.stereo import MatchStatus, StereoParameters, match
from mapfusion.vision.stereo_noise import (
    NoiseModel,
    estimate_noise,
    parameters_for_noise,
    rectification_offsets,
)
from tests.mapfusion.vision.rendered_scene import render, wall
from tests.mapfusion.vision.shifted_pictures import CAMERA, grid, pair

HARRIS = HarrisParameters(max_corners=400)
STEREO = StereoParameters(min_depth_m=1.0, max_depth_m=9.0, half_px=5, silhouette_half_px=8)


@pytest.mark.parametrize(("noise", "rows"), [(1.5, 0.0), (4.0, 0.0), (2.0, 0.3), (2.0, 0.6)])
def test_noise_and_rows_are_told_apart(noise: float, rows: float) -> None:
    pairs = [pair(12.3, 0.02, 0.0, noise, seed, rows) for seed in (1, 2, 3)]
    found = estimate_noise(pairs, CAMERA, HARRIS, STEREO)
    assert found is not None
    assert found.noise_grey == pytest.approx(noise, rel=0.1 + 0.2 * rows)
    assert found.rows_px == pytest.approx(rows, abs=0.12)
    assert found.misfit_px < 0.25


def test_other_surfaces_in_a_tenth_of_the_picture_do_not_count() -> None:
    left, right = pair(12.3, noise=2.0)
    other = pair(12.3, noise=2.0, seed=9)[1]
    right[40:70, 100:180] = other[40:70, 100:180]
    found = estimate_noise([(left, right)], CAMERA, HARRIS, STEREO)
    assert found is not None
    assert found.noise_grey == pytest.approx(2.0, rel=0.35)


def test_pictures_without_corners_tell_nothing() -> None:
    flat = np.full((240, 320), 90, np.uint8)
    assert estimate_noise([(flat, flat)], CAMERA, HARRIS, STEREO) is None


@pytest.mark.parametrize("probability", [0.5, 0.95])
def test_true_surfaces_keep_the_limits_at_the_stated_rate(probability: float) -> None:
    """The limits keep the stated share of true matches, with noise and row offsets."""
    rng, kept = np.random.default_rng(0), []
    uv = grid(step=14)
    noise = NoiseModel(2.0, 0.0, 0.3, np.ones((50, 3)) * [1600.0, 100.0, 100.0])
    limits = parameters_for_noise(replace(STEREO, residual_correlation_px=6.0), noise, probability)
    for seed in range(4):
        left, right = pair(12.3, noise=2.0, seed=seed, rows=rng.normal(0, 0.3))
        status = match(left, right, uv, CAMERA, limits).status
        kept.append(np.mean(status != MatchStatus.SILHOUETTE))
    # more pass where noise, which is tolerated on top, hides what rows do
    assert np.mean(kept) >= probability - 0.1


def test_a_surer_limit_is_a_wider_one() -> None:
    noise = NoiseModel(2.0, 0.5, 0.4, np.random.default_rng(0).uniform(20, 400, (50, 3)))
    narrow, wide = (parameters_for_noise(STEREO, noise, p) for p in (0.6, 0.99))
    assert wide.max_misfit_px > narrow.max_misfit_px > noise.misfit_px
    assert wide.plane_misfit_px > narrow.plane_misfit_px > noise.misfit_px
    assert wide.max_rows_px > narrow.max_rows_px > noise.rows_px
    assert wide.plane_half_px == STEREO.half_px
    assert wide.min_correlation < narrow.min_correlation <= STEREO.min_correlation
    assert narrow.row_sigma_px == noise.rows_px


def test_limits_are_those_of_a_mean_of_so_many_squares() -> None:
    """A half of 17 by 8 pixels has 136 pixels, which are 34 independent squares of side 2.

    Each half may fail with a quarter of the probability 0.1 that the four together may.
    """
    noise = NoiseModel(2.0, 0.5, 0.4, np.ones((50, 3)))
    limits = parameters_for_noise(replace(STEREO, residual_correlation_px=2.0), noise, 0.9)
    rms = np.sqrt(chi2.ppf(1 - 0.1 / 4, 34) / 34)
    assert limits.max_rows_px == pytest.approx(0.4 * rms)
    assert limits.plane_misfit_px == limits.max_misfit_px == pytest.approx(0.5 * rms)


ROW_CAMERA = StereoCamera(width_px=320, height_px=240, focal_px=290.0)


@pytest.fixture(scope="module")
def rendered_pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    planes = [wall(rng, (4, 3), (3, -3), 8.0, -3.0)]
    return render(planes, ROW_CAMERA, noise=2.0, rng=rng)[:2]


@pytest.mark.parametrize("rows", [-6.0, 0.0, 2.5])
def test_a_row_error_is_found(rendered_pair: tuple[np.ndarray, np.ndarray], rows: float) -> None:
    moved = np.array([[1, 0, 0], [0, 1, rows]])
    right = cv2.warpAffine(rendered_pair[1], moved, (320, 240), borderMode=cv2.BORDER_REPLICATE)
    errors = rectification_offsets(rendered_pair[0], right, HarrisParameters())[:, 1]
    assert len(errors) > 30
    assert np.median(errors) == pytest.approx(rows, abs=0.15)


def test_pictures_without_corners_have_no_row_error() -> None:
    flat = np.full((240, 320), 90, np.uint8)
    assert len(rectification_offsets(flat, flat, HarrisParameters())) == 0
