"""Covered shares of pixels, against areas and against many small squares."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sim.raycast.robots import fill_coverage, fill_least


def outline(points: np.ndarray) -> np.ndarray:
    """Corners (K, 2) of the convex hull of points (N, 2), in one sense."""
    return points[ConvexHull(points).vertices]


def edges(corners: np.ndarray) -> np.ndarray:
    """Edges (K, 4) from each corner to the next."""
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def covered(corners: np.ndarray, height: int, width: int) -> np.ndarray:
    found = np.zeros((height, width))
    fill_coverage(np.random.default_rng(0).permutation(edges(corners)) - 0.5, found)
    return found


def is_inside(corners: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    inside = np.ones(u.shape, dtype=bool)
    for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        inside &= (q[0] - p[0]) * (v - p[1]) - (q[1] - p[1]) * (u - p[0]) >= 0
    return inside


@pytest.mark.parametrize("seed", range(8))
def test_shares_are_those_of_many_points(seed: int) -> None:
    corners = outline(np.random.default_rng(seed).uniform(-3, [14, 11], (6, 2)))
    height, width, fine = 8, 11, 40
    found = covered(corners, height, width)
    v, u = (np.mgrid[: height * fine, : width * fine] + 0.5) / fine
    points = is_inside(corners, u, v).reshape(height, fine, width, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(found, points, atol=0.03)
    whole = covered(corners + 4, height + 8, width + 8)  # nothing of it beside the window
    assert whole.sum() == pytest.approx(ConvexHull(corners).volume, rel=1e-12)
    np.testing.assert_allclose(found, whole[4:-4, 4:-4], atol=1e-12)


def test_an_outline_beside_the_picture_covers_nothing() -> None:
    triangle = np.array([[20.0, 1], [24, 1], [22, 5]])
    for away in ([0, 0], [-40, 0], [-20, 10], [-20, -10]):
        assert covered(triangle + away, 8, 8).sum() == pytest.approx(0, abs=1e-12)


def test_corners_above_each_other_stay() -> None:
    """A box seen face on: three and more corners share a column."""
    box = np.array([[0, 1], [0, 0], [2, 0], [4, 0], [4, 2], [4, 3], [0, 3], [0, 2.0]])
    assert covered(box, 4, 5).sum() == pytest.approx(12)


@pytest.mark.parametrize("seed", range(4))
def test_the_least_function_is_filled_in_where_pixels_middles_are_inside(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = outline(rng.uniform(-3, [14, 11], (6, 2)))
    in_row, per_column = rng.normal(5.0, 1.0, (8, 3)), rng.normal(0.0, 1.0, 3)
    found = np.zeros((8, 11))
    fill_least(edges(corners), in_row, per_column, found)
    v, u = np.mgrid[:8, :11]
    least = np.min(in_row[:, None] + per_column * np.arange(11)[:, None], axis=2)
    np.testing.assert_allclose(found, np.where(is_inside(corners, u, v), least, 0.0), atol=1e-12)
    assert np.any(found != 0)
