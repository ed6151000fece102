"""Depths between pixels, against the same in plain NumPy."""

import numpy as np

from sim.stereo_head import SAME_SURFACE, depth_at


def in_numpy(depth_m: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
    """Inverse depths weighed by the shares of four pixels, the nearest's where they differ."""
    height, width = depth_m.shape
    uv = np.clip(uv_px, 0, [width - 1, height - 1])
    low = np.minimum(uv.astype(int), [width - 2, height - 2])
    (u, v), (a, b) = low.T, (uv - low).T
    corners = np.stack([depth_m[v + j, u + i] for j in (0, 1) for i in (0, 1)], -1)
    corners = corners.astype(np.float64)
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], -1)
    nearest = corners[np.arange(len(uv)), np.argmax(weights, axis=-1)]
    one_surface = np.ptp(corners, axis=-1) <= SAME_SURFACE * nearest
    return np.where(one_surface, 1 / np.sum(weights / corners, axis=-1), nearest)


def test_depths_equal_those_of_numpy_bit_for_bit() -> None:
    """On surfaces and their edges, beside the background, on pixels and beside the image."""
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(1, 1.04, (30, 40)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.1] = np.nan
    uv_px = rng.uniform(-3, 45, (3000, 2))
    uv_px[:500] = np.rint(uv_px[:500])
    uv_px[500:1000] = np.rint(2 * uv_px[500:1000]) / 2  # as near to several
    expected = in_numpy(depth_m, uv_px)
    assert 0.1 < np.mean(np.isnan(expected)) < 0.3
    assert np.mean(np.isin(expected, depth_m)) > 0.05
    np.testing.assert_array_equal(depth_at(depth_m, uv_px), expected)
