"""The test for more than one plane: against plain NumPy, and the laws of chi-square variables."""

import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest, ncx2

from mapfusion.vision.disparity_tests import FURTHER_TERMS, window_sums
from mapfusion.vision.subpixel import fit_planes
from tests.mapfusion.vision.shifted_pictures import Picture, pair

HALF, NOISE, D = 8, 2.0, 8
VARIANCE = 2 * (NOISE**2 + 1 / 12)  # of residuals: two pictures, in whole grey levels


def plane_scores(
    left: np.ndarray, right: np.ndarray, pixel: np.ndarray, plane: np.ndarray
) -> np.ndarray:
    """Scores and mean squared slopes (N, 3) of windows; halves are of larger ones."""
    return window_sums(left, right, pixel, plane, HALF + 3, HALF)[1]


def apart(half: int = HALF) -> np.ndarray:
    """Centres of windows that do not overlap, inside both pictures."""
    side = 2 * half + 1
    u, v = np.meshgrid(np.arange(40, 305, side), np.arange(12, 228, side))
    return np.stack([u.ravel(), v.ravel()], -1)


def columns(left: np.ndarray, u: int, v: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is known of a window (n, 5), what may be there beyond (n, 7), places (n, 4) x y u v."""
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
