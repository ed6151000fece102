"""Covered shares of pixels, against areas and against many small squares."""

import numpy as np
import pytest

from sim.raycast.outline import clip, coverage, hull


@pytest.mark.parametrize("seed", range(8))
def test_shares_are_those_of_many_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    outline = hull(rng.uniform(-3, [14, 11], (6, 2)))
    height, width, fine = 8, 11, 40
    polygon = clip(outline, float(width), float(height))
    covered = coverage(polygon, height, width)
    at = (np.mgrid[: height * fine, : width * fine] + 0.5) / fine
    inside = np.ones(at.shape[1:], dtype=bool)
    for p, q in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        inside &= (q[0] - p[0]) * (at[0] - p[1]) - (q[1] - p[1]) * (at[1] - p[0]) >= 0
    points = inside.reshape(height, fine, width, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(covered, points, atol=0.03)
    x, y = polygon.T
    area = 0.5 * np.abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert covered.sum() == pytest.approx(area, rel=1e-12)


def test_an_outline_beside_the_picture_covers_nothing() -> None:
    polygon = clip(np.array([[20.0, 1], [24, 1], [22, 5]]), 8.0, 8.0)
    assert coverage(polygon, 8, 8).sum() == 0
    assert len(polygon) == 0


def test_corners_above_each_other_stay() -> None:
    """A box seen face on: three and more corners share a column."""
    box = np.array([[0, 1], [0, 0], [0, 3], [0, 2], [4, 2], [4, 3], [4, 0], [4, 1.0]])
    assert coverage(hull(box), 4, 5).sum() == pytest.approx(12)
