"""Disparity: against pictures whose disparity is known exactly, and against slow twins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares
from scipy.stats import chi2

from mapfusion.camera import StereoCamera
from mapfusion.vision.harris import HarrisParameters, detect
from mapfusion.vision.plane_fit import disagrees, fit_planes
from mapfusion.vision.row_search import search_rows
from mapfusion.vision.stereo import StereoParameters, match
from mapfusion.vision.verdict import Verdict
from tests.mapfusion.vision.rendered_scene import Plane, render, wall

CAMERA = StereoCamera(width_px=320, height_px=240, focal_px=300.0)
PARAMETERS = StereoParameters(min_depth_m=0.9, max_depth_m=12.0)


class Picture:
    """Brightness as a smooth function of the plane, so that it can be shifted exactly."""

    def __init__(self, seed: int, waves: int = 60) -> None:
        rng = np.random.default_rng(seed)
        self.frequency = rng.normal(0, 0.25, (waves, 2))
        self.phase = rng.uniform(0, 2 * np.pi, waves)

    def __call__(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        total = np.zeros(np.broadcast(u, v).shape)
        for (fu, fv), phase in zip(self.frequency, self.phase, strict=True):
            total += np.sin(fu * u + fv * v + phase)
        return 128 + 40 * total / np.sqrt(len(self.phase) / 2)


def pair(
    d: float, a: float = 0.0, b: float = 0.0, noise: float = 0.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Left and right uint8 images with disparity d + a u + b v at each left pixel."""
    u, v = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    picture, rng = Picture(seed), np.random.default_rng(seed)
    u_left = (u + d + b * v) / (1 - a)  # of what the right image shows at u
    images = (picture(x, v) + noise * rng.standard_normal(u.shape) for x in (u, u_left))
    left, right = (np.clip(np.rint(i), 0, 255).astype(np.uint8) for i in images)
    return left, right


def grid(step: int = 12) -> np.ndarray:
    """Points with fractions, clear of the borders and of the largest disparity."""
    u, v = np.meshgrid(np.arange(70.3, 290, step), np.arange(25.6, 215, step))
    return np.stack([u.ravel(), v.ravel()], -1)


@pytest.mark.parametrize(
    ("d", "a", "b"),
    [(8.0, 0, 0), (8.25, 0, 0), (8.5, 0, 0), (12.8, 0, 0), (5, 0.03, 0), (20, -0.04, 0.02)],
)
def test_disparity_of_a_known_plane(d: float, a: float, b: float) -> None:
    left, right = pair(d, a, b)
    uv = grid()
    matches = match(left, right, uv, CAMERA, PARAMETERS)
    assert np.mean(matches.verdict == Verdict.MATCHED) > 0.95
    matched = matches.verdict == Verdict.MATCHED
    error = (matches.disparity_px - (d + a * uv[:, 0] + b * uv[:, 1]))[matched]
    assert np.median(np.abs(error)) < 0.01
    assert abs(np.median(error)) < 0.004
    assert np.abs(error).max() < 0.15


def test_variance_is_that_of_the_errors() -> None:
    """White noise: sum of squared errors over their variance follows chi-square."""
    noise = 4.0
    parameters = replace(
        PARAMETERS, noise_grey=noise, residual_correlation_px=1.0, sigma_floor_px=0.0
    )
    uv = grid(step=20)  # windows that do not overlap: independent errors
    squares, count = 0.0, 0
    for seed in range(4):
        left, right = pair(9.3, 0.02, -0.01, noise, seed)
        matches = match(left, right, uv, CAMERA, parameters)
        ok = matches.verdict == Verdict.MATCHED
        error = matches.disparity_px - (9.3 + 0.02 * uv[:, 0] - 0.01 * uv[:, 1])
        squares += np.sum((error[ok] / matches.sigma_px[ok]) ** 2)
        count += ok.sum()
    assert count > 400
    # 20 %: interpolation at fractions of a pixel smooths the noise, and the variance is estimated
    assert 0.8 * chi2.ppf(0.001, count) < squares < 1.2 * chi2.ppf(0.999, count)


def test_correlation_length_and_floor_enter_the_sigma() -> None:
    left, right = pair(9.3, noise=4.0)
    uv = grid()
    white = replace(PARAMETERS, residual_correlation_px=1.0, sigma_floor_px=0.0)
    both = replace(PARAMETERS, residual_correlation_px=3.0, sigma_floor_px=0.2)
    plain = match(left, right, uv, CAMERA, white).sigma_px
    np.testing.assert_allclose(
        match(left, right, uv, CAMERA, both).sigma_px, np.sqrt(9 * plain**2 + 0.04), rtol=1e-12
    )


def test_fit_equals_a_general_least_squares_solver() -> None:
    left, right = pair(9.3, 0.02, -0.01, noise=0.0)
    half, slope_sigma = 6, 0.05
    pixel = np.rint(grid(step=40)).astype(np.int64)
    start = np.rint(9.3 + pixel @ [0.02, -0.01])
    plane, _ = fit_planes(left, right, pixel, np.zeros(pixel.shape), start, half, slope_sigma, 1.0)
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


def test_variance_is_that_of_the_disparity_at_the_corner() -> None:
    """d + a x + b y is less certain than d, by what the window's texture says of a and b."""
    left, right = pair(9.3, 0.02, -0.01, noise=4.0)
    pixel = np.rint(grid(step=60)).astype(np.int64)
    start, half = np.rint(9.3 + pixel @ [0.02, -0.01]), 6
    offset = np.random.default_rng(0).uniform(-6, 6, pixel.shape)
    fits = (fit_planes(left, right, pixel, o, start, half, 1e6, 4.0) for o in (offset, 0 * offset))
    (_, there), (_, here) = fits
    for n, (u, v) in enumerate(pixel):
        inverse = np.linalg.inv(normal_matrix(left, u, v, half))
        row = np.array([0, 1, *offset[n]])
        assert there[n] / here[n] == pytest.approx(row @ inverse @ row / inverse[1, 1], rel=1e-6)


def test_the_prior_pulls_the_slopes_towards_zero() -> None:
    """Surer than the texture it keeps most of a slope back; step by step it must not let go."""
    left, right = pair(9.0, 0.03, 0.0, noise=3.0)
    pixel = np.rint(grid(step=30)).astype(np.int64)
    start, half = np.rint(9.0 + 0.03 * pixel[:, 0]), 6
    offset = np.zeros(pixel.shape)
    free, _ = fit_planes(left, right, pixel, offset, start, half, 1e6, 3.0)
    texture = np.median([normal_matrix(left, u, v, half)[2, 2] for u, v in pixel])
    as_sure = np.sqrt(2 * 3.0**2 / texture)
    held, _ = fit_planes(left, right, pixel, offset, start, half, as_sure, 3.0)
    assert np.nanmedian(free[:, 1]) == pytest.approx(0.03, rel=0.05)
    # a half where the noise is all there is to the residuals; the slope that is kept back is, too
    assert 0.008 < np.nanmedian(held[:, 1]) < 0.015


def test_a_refinement_that_leaves_the_search_is_refused() -> None:
    """The search finds whole pixels: of 8.4 it is 8, and the least squares moves by 0.4."""
    left, right = pair(8.4)
    for most, verdict in ((0.35, Verdict.DIVERGED), (0.45, Verdict.MATCHED)):
        matches = match(left, right, grid(), CAMERA, replace(PARAMETERS, max_jump_px=most))
        assert np.mean(matches.verdict == verdict) > 0.95


def search_twin(
    left: np.ndarray, right: np.ndarray, u: int, v: int, low: int, high: int, half: int
) -> int:
    """Disparity of the best correlation coefficient."""

    def window(image: np.ndarray, column: int) -> np.ndarray:
        return image[v - half : v + half + 1, column - half : column + half + 1].ravel()

    scores = {
        d: np.corrcoef(window(left, u), window(right, u - d))[0, 1]
        for d in range(low, high + 1)
        if u - d - half >= 0
    }
    return max(scores, key=lambda d: scores[d])


def test_search_equals_correlation_by_definition() -> None:
    left, right = pair(9.3, 0.02, -0.01, noise=20.0)
    pixel = np.rint(grid(step=25)).astype(np.int64)
    # no condition but the best score, so that unlikely matches are compared too
    found, verdict = search_rows(left, right, pixel, 2, 30, 5, -1.0, 1.0, 10**6)
    assert np.all(verdict == Verdict.MATCHED)
    expected = [search_twin(left, right, u, v, 2, 30, 5) for u, v in pixel]
    assert found.tolist() == expected


def test_repetition_is_ambiguous() -> None:
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    stripes = 128 + 60 * np.sin(2 * np.pi * u / 8) * np.cos(v / 5)
    rng = np.random.default_rng(0)
    left, right = (
        np.rint(image + 2 * rng.standard_normal(image.shape)).astype(np.uint8)
        for image in (stripes, np.roll(stripes, -9, 1))
    )
    matches = match(left, right, grid(), CAMERA, PARAMETERS)
    assert np.all(matches.verdict == Verdict.AMBIGUOUS)


def test_what_only_the_left_camera_sees_is_one_sided() -> None:
    """Of two like patches on the left, one is on the right: the worse one is not believed."""
    left, right = pair(10.0)
    rng = np.random.default_rng(5)
    patch = left[90:131, 180:221].copy()
    worse = patch + 12 * rng.standard_normal(patch.shape)
    left[90:131, 120:161] = np.clip(worse, 0, 255).astype(np.uint8)
    right[90:131, 100:221] = 128
    right[90:131, 110:151] = patch
    uv = np.array([[140.0, 110.0]])
    parameters = replace(PARAMETERS, min_depth_m=0.25)  # disparities of both patches, 10 and 70
    assert match(left, right, uv, CAMERA, parameters).verdict == Verdict.ONE_SIDED
    unchecked = replace(parameters, max_round_trip_px=1000)
    assert match(left, right, uv, CAMERA, unchecked).verdict == Verdict.MATCHED


def box_scene(rng: np.random.Generator) -> list[Plane]:
    """A wall at 5 m that fills the image and, before it, a board that hangs at 2 m."""
    return [wall(rng, (5, 4), (5, -4), 8.0, -3.0), wall(rng, (2, 0.35), (2, -0.35), 0.6, 0.2)]


def step_px(depth: np.ndarray, uv: np.ndarray, reach: int) -> np.ndarray:
    """Largest change of true disparity within `reach` pixels of each point."""
    disparity = CAMERA.focal_px * CAMERA.baseline_m / depth
    change = []
    for u, v in np.rint(uv).astype(int):
        near = disparity[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1]
        change.append(near.max() - near.min())
    return np.array(change)


def test_silhouettes_are_rejected_and_slanted_walls_are_not() -> None:
    rng = np.random.default_rng(2)
    corners_of = HarrisParameters(max_corners=400, min_distance_px=5)
    rejected, passed_unchecked, on_edge = 0, 0, 0
    for x in (0.0, 0.1, 0.2):
        left, right, depth = render(box_scene(rng), CAMERA, (x, 0.0, 0.05), 2.0, rng)
        uv = detect(left, corners_of)
        edge = step_px(depth, uv, 3) > 2
        with_test = match(left, right, uv, CAMERA, PARAMETERS).verdict
        lenient = replace(PARAMETERS, max_misfit_px=100.0)
        without = match(left, right, uv, CAMERA, lenient).verdict
        on_edge += np.sum(edge)
        passed_unchecked += np.sum(edge & (without == Verdict.MATCHED))
        rejected += np.sum(edge & (without == Verdict.MATCHED) & (with_test != Verdict.MATCHED))
    assert on_edge > 30
    assert passed_unchecked > 10
    assert rejected >= 0.9 * passed_unchecked

    slanted = [wall(rng, (2.0, 1.5), (6.0, -2.5), 4.0)]
    left, right, _ = render(slanted, CAMERA, noise=2.0, rng=rng)
    verdict = match(left, right, detect(left, corners_of), CAMERA, PARAMETERS).verdict
    assert np.mean(verdict == Verdict.SILHOUETTE) < 0.02
    assert np.mean(verdict == Verdict.MATCHED) > 0.8


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
            found = disagrees(left, right, np.array([[u, v]]), plane, 12, 1.0, most)
            assert found.tolist() == [expected]
    assert min(worst.count(side) for side in range(4)) >= 3


@pytest.mark.parametrize("shape", [(5, 5), (30, 30), (240, 320)])
def test_flat_and_tiny_images_have_no_matches(shape: tuple[int, int]) -> None:
    uv = np.array([[2.0, 2.0], [15.0, 15.0], [200.0, 100.0], [1e6, -3.0]])
    for level in (0, 100, 255):
        image = np.full(shape, level, np.uint8)
        matches = match(image, image, uv, CAMERA, PARAMETERS)
        assert not np.any(matches.verdict == Verdict.MATCHED)
        assert np.isnan(matches.disparity_px).all()
        assert np.isnan(matches.sigma_px).all()


def test_every_pixel_of_the_image_may_be_asked_for() -> None:
    """Windows near the borders are refused, not read beyond them."""
    left, right = pair(9.3)
    u, v = np.meshgrid(np.arange(-3, 323, 2.0), np.arange(-3, 243, 7.0))
    uv = np.stack([u.ravel(), v.ravel()], -1)
    for half in (8, 15):
        parameters = replace(PARAMETERS, half_px=half, silhouette_half_px=half)
        matches = match(left, right, uv, CAMERA, parameters)
        margin = np.minimum(uv, [319, 239] - uv).min(1)
        assert not np.any(matches.verdict[margin < half - 1] == Verdict.MATCHED)
        ok = matches.verdict == Verdict.MATCHED
        assert np.abs(matches.disparity_px[ok] - 9.3).max() < 0.3


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("left", {"left": np.zeros((240, 320))}),
        ("right", {"right": np.zeros((240, 320, 3), np.uint8)}),
        ("right", {"right": np.zeros((240, 319), np.uint8)}),
        ("uv_px", {"uv_px": np.zeros((4, 3))}),
        ("uv_px", {"uv_px": np.full((4, 2), np.inf)}),
    ],
)
def test_wrong_arguments_are_named(name: str, change: dict) -> None:
    image = np.zeros((240, 320), np.uint8)
    arguments = {"left": image, "right": image, "uv_px": np.zeros((1, 2))} | change
    with pytest.raises(ValueError, match=f"^{name}:"):
        match(**arguments, camera=CAMERA, parameters=PARAMETERS)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("min_depth_m", 0.0),
        ("max_depth_m", 0.1),
        ("half_px", 1),
        ("half_px", 91),
        ("min_correlation", 1.5),
        ("silhouette_half_px", 3),
        ("sigma_floor_px", -0.1),
    ],
)
def test_wrong_parameters_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name}:"):
        StereoParameters(**{name: value})
