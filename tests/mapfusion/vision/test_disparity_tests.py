"""Tests of `mapfusion.vision.disparity_tests`."""

import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest, ncx2

from mapfusion.vision.disparity_tests import FURTHER_TERMS, window_statistics
from mapfusion.vision.subpixel import fit_planes
from tests.mapfusion.vision.shifted_pictures import Picture, pair

HALF, NOISE, D = 8, 2.0, 8
VARIANCE = 2 * (NOISE**2 + 1 / 12)  # of residuals: two pictures, in whole grey levels


def plane_scores(
    left: np.ndarray, right: np.ndarray, pixel: np.ndarray, plane: np.ndarray
) -> np.ndarray:
    """Scores and mean squared slopes (N, 3) of windows; halves are of larger ones."""
    return window_statistics(left, right, pixel, plane, HALF + 3, HALF)[1]


def apart(half: int = HALF) -> np.ndarray:
    """Centres of windows that do not overlap, inside both pictures."""
    side = 2 * half + 1
    u, v = np.meshgrid(np.arange(40, 305, side), np.arange(12, 228, side))
    return np.stack([u.ravel(), v.ravel()], -1)


def columns(left: np.ndarray, u: int, v: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns of the plane (n, 5), of further terms (n, 7), and x, y, u, v (n, 4)."""
    x, y = (k.ravel() for k in np.meshgrid(*[np.arange(-HALF, HALF + 1)] * 2))
    inside = (u + x >= 1) & (u + x <= left.shape[1] - 2) & (v + y >= 0) & (v + y < len(left))
    x, y = x[inside], y[inside]
    grey = left.astype(float)
    g = (grey[v + y, u + x + 1] - grey[v + y, u + x - 1]) / 2
    known = np.stack([np.ones(len(x)), grey[v + y, u + x], g, g * x, g * y], -1)
    beyond = np.stack([np.sign(x), np.sign(y), abs(x), abs(y), x * x, x * y, y * y], -1)
    return known, g[:, None] * beyond, np.stack([x, y, u + x, v + y], -1)


def explained(known: np.ndarray, beyond: np.ndarray, residual: np.ndarray) -> float:
    """By how much the square of what is left falls when further columns are fitted too."""
    squares = []
    for terms in (known, np.hstack([known, beyond])):
        terms = terms / np.linalg.norm(terms, axis=0)
        best = np.linalg.lstsq(terms, residual, rcond=None)[0]
        squares.append(np.sum((residual - terms @ best) ** 2))
    return squares[0] - squares[1]


@pytest.mark.parametrize("pictures", ["of one surface", "of two"])
def test_the_score_is_what_further_terms_explain(pictures: str) -> None:
    left, right = pair(D, noise=NOISE)
    if pictures == "of two":
        right = np.where(np.arange(320) % 50 < 25, right, np.roll(right, 1, 1))
    inner = np.random.default_rng(0).integers((20, 10), (305, 230), (60, 2))
    pixel = np.vstack([inner, [(100, 3), (317, 100), (150, 238), (12, 80)]])
    scores = plane_scores(left, right, pixel, np.tile([D, 0.0, 0.0], (len(pixel), 1)))
    expected = []
    for u, v in pixel.tolist():
        known, beyond, (_, _, x, y) = (k.T for k in columns(left, u, v))
        seen = (x - D >= 1) & (x - D < 318)
        residual = right[y[seen], x[seen] - D].astype(float) - left[y[seen], x[seen]]
        expected.append(explained(known.T[seen], beyond.T[seen], residual))
    np.testing.assert_allclose(scores[:, 0], expected, rtol=2e-3)


def test_slopes_are_those_of_the_grey_levels() -> None:
    left, right = pair(D)
    u, v = 100, 100
    found = plane_scores(left, right, np.array([[u, v]]), np.array([[D, 0.0, 0.0]]))[0]
    down, along = np.gradient(left.astype(float))
    window = (slice(v - HALF, v + HALF + 1), slice(u - HALF, u + HALF + 1))
    expected = [np.mean(slope[window] ** 2) for slope in (along, down)]
    np.testing.assert_allclose(found[1:], expected, rtol=1e-9)


def test_planes_are_refused_at_the_stated_rate() -> None:
    pixel, found = apart(), []
    nothing, start = np.zeros(pixel.shape), np.full(len(pixel), float(D))
    for seed in range(6):
        images = pair(D, noise=NOISE, seed=seed)
        plane, _ = fit_planes(*images, pixel, nothing, start, HALF, 0.3, NOISE, 1.0, 0.0)
        found.append(plane_scores(*images, pixel, plane)[:, 0])
    score = np.concatenate(found) / VARIANCE
    assert kstest(score, chi2(FURTHER_TERMS).cdf).pvalue > 0.01
    for share in (0.1, 0.001):
        refused = np.sum(score > chi2.isf(share, FURTHER_TERMS))
        low, high = binom.interval(0.999, len(score), share)
        assert low <= refused <= high


def test_how_bright_a_picture_is_does_not_count() -> None:
    """Half the contrast: a quarter of the square, whatever the window shows."""
    left, right = pair(D, noise=NOISE)
    pixel, right = apart(), right // 2 * 2
    plane = np.tile([D + 0.3, 0.01, 0.0], (len(pixel), 1))
    scores, half = (plane_scores(left, k, pixel, plane) for k in (right, right // 2 + 30))
    np.testing.assert_allclose(half[:, 0], scores[:, 0] / 4, rtol=2e-3)
    np.testing.assert_array_equal(half[:, 1:], scores[:, 1:])


@pytest.mark.parametrize("step_px", [0.2, 0.5, 1.0])
def test_steps_are_found_as_often_as_their_size_says(step_px: float) -> None:
    """The score is a non-central chi-square variable: of what the step changes in grey levels."""
    period = 2 * (2 * HALF + 1)
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    pixel = apart()
    pixel = pixel[(pixel[:, 0] - 40) % period == 0]
    nearer = (u - 40) % period
    further = step_px * ((nearer >= 1) & (nearer <= HALF))
    score, central = [], []
    for seed in range(4):
        picture, rng = Picture(seed), np.random.default_rng(seed)
        clean = picture(u, v), np.roll(picture(u + further, v), -D, 1)
        left, right = (
            np.clip(np.rint(k + NOISE * rng.standard_normal(k.shape)), 0, 255).astype(np.uint8)
            for k in clean
        )
        plane = np.tile([D, 0.0, 0.0], (len(pixel), 1))
        score.append(plane_scores(left, right, pixel, plane)[:, 0] / VARIANCE)
        for a, b in pixel.tolist():
            known, beyond, (_, _, x, y) = (k.T for k in columns(clean[0], a, b))
            change = clean[1][y, x - D] - clean[0][y, x]
            central.append(explained(known.T, beyond.T, change) / VARIANCE)
    bound = chi2.isf(0.001, FURTHER_TERMS)
    powers = ncx2.sf(bound, FURTHER_TERMS, central)
    sure = 3.3 * np.sqrt(np.sum(powers * (1 - powers))) / len(powers) + 0.01
    assert np.mean(np.concatenate(score) > bound) == pytest.approx(np.mean(powers), abs=sure)
    assert step_px < 1 or np.mean(powers) > 0.9


def test_windows_without_texture_hold_nothing_against_a_plane() -> None:
    flat = np.full((40, 60), 90, np.uint8)
    stripes = np.tile((np.arange(60) % 7 * 30).astype(np.uint8), (40, 1))
    pixel, plane = np.array([[30, 20]]), np.zeros((1, 3))
    assert plane_scores(flat, flat, pixel, plane)[0].tolist() == [0, 0, 0]
    assert plane_scores(stripes, stripes, pixel, plane)[0, 0] == 0
    brighter = flat + np.random.default_rng(0).integers(0, 9, flat.shape).astype(np.uint8)
    assert plane_scores(flat, brighter, pixel, plane)[0, 0] == 0


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
    """Return x, y, r, g and h of a window's pixels in both images, shape (n, 5)."""
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
        squares, scores = window_statistics(
            left, right, pixel, np.tile(plane, (len(pixel), 1)), *halves
        )
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
