"""What windows hold against their planes, against plain NumPy, inside the pictures and beyond."""

import numpy as np
import pytest

from mapfusion.vision.disparity_tests import window_sums
from tests.mapfusion.vision.shifted_pictures import pair

# none of them meets a border of the pictures at a pixel, where rounding decides
PLANES = np.array([[9.337, 0.0213, -0.0117], [0.437, -0.213, 0.117], [31.037, 0.0, 0.313]])
CENTRES = ((160, 120), (5, 120), (316, 100), (200, 2), (200, 238), (40, 60), (1, 0), (319, 239))


def catmull_rom(row: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Grey levels between columns: the cubic through the inner two of four, Hermite's form."""
    k = np.floor(at).astype(int)
    t = at - k
    before, here, after, beyond = (row[k + i] for i in (-1, 0, 1, 2))
    enter, leave = (after - before) / 2, (beyond - here) / 2
    weight = t * t * (3 - 2 * t)
    bent = t * (1 - t) ** 2 * enter - t * t * (1 - t) * leave
    return (1 - weight) * here + weight * after + bent


def looked_at(
    left: np.ndarray, right: np.ndarray, u: int, v: int, plane: np.ndarray, half: int
) -> np.ndarray:
    """Of a window's pixels that lie in both pictures (n, 5): x, y, r, g and h."""
    found = []
    for y in range(max(-half, -v), min(half, len(left) - 1 - v) + 1):
        x = np.arange(max(-half, 1 - u), min(half, left.shape[1] - 2 - u) + 1)
        at = u + x - plane[0] - plane[1] * x - plane[2] * y
        seen = (at >= 1) & (at < left.shape[1] - 2)
        x, at, row = x[seen], at[seen], left[v + y].astype(float)
        residual = catmull_rom(right[v + y].astype(float), at) - row[u + x]
        below, above = min(v + y + 1, len(left) - 1), max(v + y - 1, 0)
        down = (left[below, u + x].astype(float) - left[above, u + x]) / (below - above)
        slope = (row[u + x + 1] - row[u + x - 1]) / 2
        found.append(np.stack([x, np.full(len(x), y), residual, slope, down], -1))
    return np.concatenate(found)


@pytest.mark.parametrize("halves", [(12, 12), (9, 12), (12, 5)])
def test_halves_and_slopes_equal_plain_sums(halves: tuple[int, int]) -> None:
    left, right = pair(9.3, 0.02, -0.01, noise=3.0)
    for plane in PLANES:
        pixel = np.array(CENTRES)
        squares, scores = window_sums(left, right, pixel, np.tile(plane, (len(pixel), 1)), *halves)
        for n, (u, v) in enumerate(CENTRES):
            x, y, r, g, h = looked_at(left, right, u, v, plane, halves[0]).T
            offset = r[y != 0].mean() if np.any(y != 0) else 0.0
            expected = [
                [len(r[i]), *(np.sum(k[i] ** 2) for k in (r - offset, g, h))]
                for i in (x < 0, x > 0, y < 0, y > 0)
            ]
            np.testing.assert_allclose(squares[n], expected, rtol=1e-9, atol=1e-6)
            *_, g, h = looked_at(left, right, u, v, plane, halves[1]).T
            expected = [np.sum(k**2) / max(len(k), 1) for k in (g, h)]
            np.testing.assert_allclose(scores[n, 1:], expected, rtol=1e-12)
