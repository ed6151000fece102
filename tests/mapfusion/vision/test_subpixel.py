"""The least squares for a plane, and the test of its halves, against slow twins."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from mapfusion.vision.disparity_tests import fails_silhouette_test, window_statistics
from mapfusion.vision.subpixel import fit_planes
from tests.mapfusion.vision.shifted_pictures import grid, pair


def test_fit_equals_a_general_least_squares_solver() -> None:
    left, right = pair(9.3, 0.02, -0.01, noise=0.0)
    half, slope_sigma = 6, 0.05
    pixel = np.rint(grid(step=40)).astype(np.int64)
    start = np.rint(9.3 + pixel @ [0.02, -0.01])
    plane, _ = fit_planes(
        left, right, pixel, np.zeros(pixel.shape), start, half, slope_sigma, 1.0, 1.0, 0.0
    )
    y, x = (k.ravel() for k in np.mgrid[-half : half + 1, -half : half + 1])
    for n, (u, v) in enumerate(pixel):
        grey = left[v + y, u + x].astype(float)

        def residuals(p: np.ndarray, u: int = u, v: int = v, grey: np.ndarray = grey) -> np.ndarray:
            at = u + x - p[1] - p[2] * x - p[3] * y
            seen = map_coordinates(right.astype(float), [v + y, at], order=3)
            return np.append(seen - grey - p[0], np.sqrt(2) * p[2:] / slope_sigma)

        best = least_squares(residuals, [0, start[n], 0, 0]).x
        assert abs(plane[n, 0] - best[1]) < 0.01
        np.testing.assert_allclose(plane[n, 1:], best[2:], atol=0.002)


def normal_matrix(left: np.ndarray, u: int, v: int, half: int) -> np.ndarray:
    """J^T J of brightness, d, a and b over a window, by the left image's slopes."""
    y, x = (k.ravel() for k in np.mgrid[-half : half + 1, -half : half + 1])
    grey = left.astype(float)
    slope = (grey[v + y, u + x + 1] - grey[v + y, u + x - 1]) / 2
    J = np.stack([np.ones(len(x)), slope, slope * x, slope * y], -1)
    return J.T @ J


def test_slopes_settle_where_noise_is_half_of_the_texture() -> None:
    """Steps are too short by half then: d stands still long before the slopes do."""
    left, right = pair(9.0, 0.0, 0.1, noise=14.0)
    pixel = np.rint(grid(step=20)).astype(np.int64)
    start = np.rint(9.0 + 0.1 * pixel[:, 1])
    plane, _ = fit_planes(left, right, pixel, np.zeros(pixel.shape), start, 8, 1.0, 14.0, 1.0, 0.0)
    assert np.nanmedian(plane[:, 2]) == pytest.approx(0.1, rel=0.03)


def test_variance_is_that_of_the_disparity_at_the_corner() -> None:
    """d + a x + b y is less certain than d, by what the window's texture says of a and b."""
    noise = 4.0
    left, right = pair(9.3, 0.02, -0.01, noise)
    pixel = np.rint(grid(step=60)).astype(np.int64)
    start, half = np.rint(9.3 + pixel @ [0.02, -0.01]), 6
    offset = np.random.default_rng(0).uniform(-6, 6, pixel.shape)
    fits = (
        fit_planes(left, right, pixel, o, start, half, 1e6, noise, 1.0, 0.0)
        for o in (offset, 0 * offset)
    )
    (_, there), (_, here) = fits
    x = np.arange(-half, half + 1)
    squares = np.array([0, len(x) ** 2, len(x) * np.sum(x**2), len(x) * np.sum(x**2)])
    for n, (u, v) in enumerate(pixel):
        seen = normal_matrix(left, u, v, half)
        added = np.diag(squares) * noise**2 / 2
        inverse = np.linalg.inv(seen - added)
        covariance = inverse @ (seen - added / 2) @ inverse
        row = np.array([0, 1, *offset[n]])
        told = row @ covariance @ row / covariance[1, 1]
        assert there[n] / here[n] == pytest.approx(told, rel=1e-6)


def test_the_prior_pulls_the_slopes_towards_zero() -> None:
    """Surer than the texture it keeps most of a slope back; step by step it must not let go."""
    left, right = pair(9.0, 0.03, 0.0, noise=3.0)
    pixel = np.rint(grid(step=30)).astype(np.int64)
    start, half = np.rint(9.0 + 0.03 * pixel[:, 0]), 6
    offset = np.zeros(pixel.shape)
    free, _ = fit_planes(left, right, pixel, offset, start, half, 1e6, 3.0, 1.0, 0.0)
    texture = np.median([normal_matrix(left, u, v, half)[2, 2] for u, v in pixel])
    as_sure = np.sqrt(2 * 3.0**2 / texture)
    held, _ = fit_planes(left, right, pixel, offset, start, half, as_sure, 3.0, 1.0, 0.0)
    assert np.nanmedian(free[:, 1]) == pytest.approx(0.03, rel=0.05)
    # a half where the noise is all there is to the residuals; the slope that is kept back is, too
    assert 0.008 < np.nanmedian(held[:, 1]) < 0.015


def misfits_px(left: np.ndarray, right: np.ndarray, d: int, u: int, v: int) -> np.ndarray:
    """Error in disparity that explains what each half (left, right, upper, lower) differs by."""
    half, noise = 12, 1.0
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    grey = left.astype(float)
    residual = right[v + y, u + x - d].astype(float) - grey[v + y, u + x]
    slope = (grey[v + y, u + x + 1] - grey[v + y, u + x - 1]) / 2
    residual -= residual[y != 0].mean()
    halves = (x < 0, x > 0, y < 0, y > 0)
    left_over = [np.sum(residual[h] ** 2 - 2 * noise**2) / np.sum(slope[h] ** 2) for h in halves]
    return np.sqrt(np.maximum(left_over, 0))


def test_the_worst_half_of_the_window_decides() -> None:
    """All four of them: another picture begins beside, above or below each of these corners."""
    left, right = pair(8.0, noise=1.0)
    other = pair(8.0, noise=1.0, seed=7)[1]
    corners = np.array([(u, v) for v in range(30, 220, 45) for u in range(60, 290, 45)])
    sides = np.resize([(-10, 0), (10, 0), (0, -10), (0, 10)], corners.shape)
    for (u, v), (du, dv) in zip(corners, sides, strict=True):
        rows, at = slice(v + dv - 5, v + dv + 6), slice(u + du - 13, u + du - 2)
        right[rows, at] = other[rows, at]
    worst = []
    for u, v in corners:
        misfit, plane = misfits_px(left, right, 8, u, v), np.array([[8.0, 0, 0]])
        worst.append(int(np.argmax(misfit)))
        for share, expected in ((0.999, True), (1.001, False)):
            most = share * misfit.max()
            squares, _ = window_statistics(left, right, np.array([[u, v]]), plane, 12, 8)
            found = fails_silhouette_test(squares, 1.0, most, 0.0)
            assert found.tolist() == [expected]
    assert min(worst.count(side) for side in range(4)) >= 3


def test_rows_that_are_off_add_what_they_shift_the_disparity_by() -> None:
    """Against the shift itself: pictures a tenth of a row apart, and the same that fit."""
    pixel = np.rint(grid(step=25)).astype(np.int64)
    start, half = np.full(len(pixel), 9.0), 6
    offset = np.random.default_rng(0).uniform(-1, 1, pixel.shape)
    own = (pixel, offset, start, half, 0.1, 1.0, 1.0)
    off_rows, found = 0.5, []
    for rows in (0.0, off_rows):
        plane, _ = fit_planes(*pair(9.3, rows=rows), *own, 0.0)
        found.append(plane[:, 0] + np.sum(plane[:, 1:] * offset, -1))
    shifted = np.abs(found[1] - found[0]) / off_rows
    images = pair(9.3)
    stated, alone = (fit_planes(*images, *own, rows)[1] for rows in (1.0, 0.0))
    predicted = np.sqrt(stated - alone)
    assert np.median(predicted) > 0.02
    assert np.corrcoef(predicted, shifted)[0, 1] > 0.97
    assert np.median(predicted / np.maximum(shifted, 0.02)) == pytest.approx(1, abs=0.15)


def test_rows_that_are_off_are_tolerated_where_asked() -> None:
    left, right = pair(8.0, rows=0.6)
    pixel = np.rint(grid(step=25)).astype(np.int64)
    plane = np.tile([8.0, 0.0, 0.0], (len(pixel), 1))
    squares, _ = window_statistics(left, right, pixel, plane, 12, 12)
    refused = [fails_silhouette_test(squares, 1.0, 0.05, rows).mean() for rows in (0, 0.4, 0.8)]
    assert refused[0] == refused[1] == 1
    assert refused[2] == 0
