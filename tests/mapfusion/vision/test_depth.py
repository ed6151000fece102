"""Disparities of depth images: exact planes, edges, missing depths, and the law of the noise."""

import numpy as np
import pytest
import scipy

from mapfusion.camera import StereoCamera
from mapfusion.vision.depth import DepthParameters, add_noise, match_depth
from mapfusion.vision.stereo import MatchStatus

DEPTH = DepthParameters()
CAMERA = StereoCamera(width_px=320, height_px=240, focal_px=288.0, baseline_m=DEPTH.baseline_m)
FOCAL_BASELINE = CAMERA.focal_px * CAMERA.baseline_m


def depths_of_plane(normal, offset_m):
    """Depths Z of the plane normal . (x, y, Z) = offset_m, x to the right and y down."""
    v, u = np.indices((CAMERA.height_px, CAMERA.width_px))
    (cu, cv), f = CAMERA.center_px, CAMERA.focal_px
    ray = np.stack([(u - cu) / f, (v - cv) / f, np.ones(u.shape)], -1)
    return (offset_m / (ray @ normal)).astype(np.float32)


def corners(rng, n=200):
    return rng.uniform(10, [CAMERA.width_px - 10, CAMERA.height_px - 10], (n, 2))


def test_the_disparity_of_a_plane_is_exact_between_pixels():
    """On a plane the disparity f B n . ray / offset is linear in the image."""
    normal, offset_m = np.array([0.3, -0.2, 1.0]), 2.5
    uv = corners(np.random.default_rng(0))
    found = match_depth(depths_of_plane(normal, offset_m), uv, CAMERA, DEPTH)
    assert np.all(found.status == MatchStatus.MATCHED)
    (cu, cv), f = CAMERA.center_px, CAMERA.focal_px
    rays = np.column_stack([(uv - [cu, cv]) / f, np.ones(len(uv))])
    np.testing.assert_allclose(found.disparity_px, FOCAL_BASELINE * rays @ normal / offset_m, 1e-6)
    slope = FOCAL_BASELINE * normal[:2] / (f * offset_m)
    np.testing.assert_allclose(found.slope, np.tile(slope, (len(uv), 1)), atol=1e-6)


def test_the_noise_grows_with_the_square_of_the_depth():
    """Khoshelham and Elberink (2012): 36 mm at 5 m; the stated disparities have the same noise."""
    rng, sigmas = np.random.default_rng(1), []
    for depth_m in (1.0, 2.0, 4.0):
        true_m = np.full((CAMERA.height_px, CAMERA.width_px), depth_m, np.float32)
        noisy = [add_noise(true_m, DEPTH.sigma_per_m, rng) for _ in range(40)]
        sigmas.append(np.std(noisy) / depth_m**2)
        uv = corners(rng, 100)
        found = [match_depth(each, uv, CAMERA, DEPTH) for each in noisy]
        matched = np.array([each.status == MatchStatus.MATCHED for each in found])
        assert matched.mean() > 0.99
        off_px = np.array([each.disparity_px for each in found]) - FOCAL_BASELINE / depth_m
        # a plane through a window of the size of the sensor's own windows averages little
        ratio = np.nanstd(off_px) / np.nanmedian([each.sigma_px for each in found])
        assert 0.5 < ratio < 1.0
    np.testing.assert_allclose(sigmas, DEPTH.sigma_per_m, rtol=0.05)
    assert DEPTH.sigma_per_m * 5.0**2 == pytest.approx(0.036, abs=0.001)


@pytest.mark.parametrize("step_m", [0.15, 0.5, 3.0])
def test_corners_at_the_edge_of_an_object_are_rejected(step_m):
    rng, half = np.random.default_rng(2), DEPTH.half_px
    depth_m = np.full((CAMERA.height_px, CAMERA.width_px), 2.0, np.float32)
    depth_m[:, 160:] += step_m
    depth_m = add_noise(depth_m, DEPTH.sigma_per_m, rng)
    u = np.arange(20, 300.0)
    status = match_depth(
        depth_m, np.column_stack([u, np.full(len(u), 120.0)]), CAMERA, DEPTH
    ).status
    near = (u - half < 160) & (u + half >= 160)
    assert np.all(status[near & (np.abs(u - 159.5) < half - 1)] == MatchStatus.SILHOUETTE)
    assert np.mean(status[~near] == MatchStatus.MATCHED) > 0.98


@pytest.mark.parametrize("unknown", [0.0, np.nan])
def test_windows_without_depths_and_beyond_the_image_have_no_disparity(unknown):
    depth_m = np.full((CAMERA.height_px, CAMERA.width_px), 2.0, np.float32)
    depth_m[100:140, 100:140] = unknown
    depth_m[50, 50] = unknown
    uv = np.array([[120.0, 120.0], [101.0, 120.0], [2.0, 120.0], [50.0, 51.0], [60.0, 200.0]])
    found = match_depth(depth_m, uv, CAMERA, DEPTH)
    missing, outside, matched = MatchStatus.MISSING, MatchStatus.OUTSIDE, MatchStatus.MATCHED
    assert found.status.tolist() == [missing, missing, outside, matched, matched]
    assert np.isnan(found.disparity_px[:3]).all()
    np.testing.assert_allclose(found.disparity_px[3:], FOCAL_BASELINE / 2.0)


def test_the_test_of_edges_keeps_the_stated_share_of_planes():
    rng = np.random.default_rng(3)
    white = rng.standard_normal((CAMERA.height_px, CAMERA.width_px))
    depth_m = (2.0 / (1 + DEPTH.sigma_per_m * 2.0 * white)).astype(np.float32)  # independent pixels
    v, u = np.mgrid[5:235:9, 5:315:9]
    uv = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    lost = np.count_nonzero(match_depth(depth_m, uv, CAMERA, DEPTH).status != MatchStatus.MATCHED)
    assert lost <= scipy.stats.binom.ppf(0.999, len(uv), 1 - DEPTH.probability)
    strict = DepthParameters(probability=0.5)
    lost = np.count_nonzero(match_depth(depth_m, uv, CAMERA, strict).status != MatchStatus.MATCHED)
    assert 0.3 < lost / len(uv) < 0.55  # the plane takes up a part of the noise


def test_wrong_depths_are_named():
    with pytest.raises(ValueError, match="depth_m: shape"):
        match_depth(np.ones((3, 4), np.float32), np.zeros((0, 2)), CAMERA, DEPTH)
    none = match_depth(np.ones((240, 320), np.float32), np.zeros((0, 2)), CAMERA, DEPTH)
    assert len(none.status) == 0
