"""Disparity: against pictures whose disparity is known exactly, and against slow twins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from scipy.stats import binom, chi2

from mapfusion.vision.harris import HarrisParameters, detect
from mapfusion.vision.stereo import MatchStatus, StereoParameters, match, search_rows
from tests.mapfusion.vision.rendered_scene import Plane, render, wall
from tests.mapfusion.vision.shifted_pictures import CAMERA, Picture, grid, pair

PARAMETERS = StereoParameters(min_depth_m=0.9, max_depth_m=12.0)


@pytest.mark.parametrize(
    ("d", "a", "b"),
    [(8.0, 0, 0), (8.25, 0, 0), (8.5, 0, 0), (12.8, 0, 0), (5, 0.03, 0), (20, -0.04, 0.02)],
)
def test_disparity_of_a_known_plane(d: float, a: float, b: float) -> None:
    left, right = pair(d, a, b)
    uv = grid()
    matches = match(left, right, uv, CAMERA, PARAMETERS)
    assert np.mean(matches.status == MatchStatus.MATCHED) > 0.95
    matched = matches.status == MatchStatus.MATCHED
    error = (matches.disparity_px - (d + a * uv[:, 0] + b * uv[:, 1]))[matched]
    assert np.median(np.abs(error)) < 0.01
    assert abs(np.median(error)) < 0.004
    assert np.abs(error).max() < 0.15


@pytest.mark.parametrize("noise", [4.0, 9.0, 14.0])
def test_variance_is_that_of_the_errors(noise: float) -> None:
    """White noise: sum of squared errors over their variance follows chi-square.

    Of 9 grey levels it makes up a third of the slopes that are seen, of 14 half, which promise too
    much then.
    """
    alike = {"residual_correlation_px": 1.0, "sigma_floor_px": 0.0, "min_correlation": 0.5}
    parameters = replace(PARAMETERS, noise_grey=noise, **alike)
    uv = grid(step=20)  # windows that do not overlap: independent errors
    squares, count = 0.0, 0
    for seed in range(4):
        left, right = pair(9.3, 0.02, -0.01, noise, seed)
        matches = match(left, right, uv, CAMERA, parameters)
        ok = matches.status == MatchStatus.MATCHED
        error = matches.disparity_px - (9.3 + 0.02 * uv[:, 0] - 0.01 * uv[:, 1])
        squares += np.sum((error[ok] / matches.sigma_px[ok]) ** 2)
        count += ok.sum()
    assert count > 400
    # 10 %: interpolation at fractions of a pixel smooths the noise, and the variance is estimated
    assert 0.9 * chi2.ppf(0.001, count) < squares < 1.1 * chi2.ppf(0.999, count)


def test_what_residuals_hold_beyond_noise_counts_as_often_as_it_is_alike() -> None:
    left, right = pair(9.3, noise=4.0)

    def sigma(noise: float, alike_px: float, floor_px: float = 0.0) -> np.ndarray:
        lengths = {"residual_correlation_px": alike_px, "sigma_floor_px": floor_px}
        stated = replace(PARAMETERS, noise_grey=noise, max_misfit_px=100.0, **lengths)
        return match(left, right, grid(), CAMERA, stated).sigma_px

    excess = sigma(3.0, 1.0) ** 2 - sigma(3.0, 0.0) ** 2
    assert np.nanmedian(excess / sigma(3.0, 0.0) ** 2) == pytest.approx(16 / 9 - 1, rel=0.3)
    np.testing.assert_allclose(
        sigma(3.0, 5.0, 0.2), np.sqrt(sigma(3.0, 0.0) ** 2 + 25 * excess + 0.04), rtol=1e-9
    )
    np.testing.assert_array_equal(sigma(6.0, 5.0), sigma(6.0, 1.0))  # less than noise: all of it is


def test_a_refinement_that_leaves_the_search_is_refused() -> None:
    """The search finds whole pixels: of 8.4 it is 8, and the least squares moves by 0.4."""
    left, right = pair(8.4)
    for most, status in ((0.35, MatchStatus.DIVERGED), (0.45, MatchStatus.MATCHED)):
        matches = match(left, right, grid(), CAMERA, replace(PARAMETERS, max_jump_px=most))
        assert np.mean(matches.status == status) > 0.95


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
    found, status = search_rows(left, right, pixel, 2, 30, 5, -1.0, 1.0, 10**6)
    assert np.all(status == MatchStatus.MATCHED)
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
    assert np.all(matches.status == MatchStatus.AMBIGUOUS)


def test_what_only_the_left_camera_sees_is_one_sided() -> None:
    """If two similar patches on the left match one on the right, the worse match is refused."""
    left, right = pair(10.0)
    rng = np.random.default_rng(5)
    patch = left[90:131, 180:221].copy()
    worse = patch + 12 * rng.standard_normal(patch.shape)
    left[90:131, 120:161] = np.clip(worse, 0, 255).astype(np.uint8)
    right[90:131, 100:221] = 128
    right[90:131, 110:151] = patch
    uv = np.array([[140.0, 110.0]])
    parameters = replace(PARAMETERS, min_depth_m=0.25)  # disparities of both patches, 10 and 70
    assert match(left, right, uv, CAMERA, parameters).status == MatchStatus.ONE_SIDED
    unchecked = replace(parameters, max_round_trip_px=100, plane_probability=1.0)
    assert match(left, right, uv, CAMERA, unchecked).status == MatchStatus.MATCHED


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


# Neither test of what the window shows, and either alone.
UNTESTED = replace(PARAMETERS, max_misfit_px=100.0, plane_probability=1.0)
BY_HALVES = replace(PARAMETERS, plane_probability=1.0)
BY_PLANE = replace(PARAMETERS, max_misfit_px=100.0, plane_misfit_px=0.2)


@pytest.mark.parametrize(
    ("tested", "status"), [(BY_HALVES, MatchStatus.SILHOUETTE), (BY_PLANE, MatchStatus.BENT)]
)
def test_edges_are_rejected_and_slanted_walls_are_not(
    tested: StereoParameters, status: MatchStatus
) -> None:
    rng = np.random.default_rng(2)
    corners_of = HarrisParameters(max_corners=400, min_distance_px=5)
    rejected, passed_unchecked, on_edge = 0, 0, 0
    for x in (0.0, 0.1, 0.2):
        left, right, depth = render(box_scene(rng), CAMERA, (x, 0.0, 0.05), 2.0, rng)
        uv = detect(left, corners_of)
        edge = step_px(depth, uv, 3) > 2
        with_test, without = (match(left, right, uv, CAMERA, p).status for p in (tested, UNTESTED))
        on_edge += np.sum(edge)
        passed_unchecked += np.sum(edge & (without == MatchStatus.MATCHED))
        rejected += np.sum(edge & (without == MatchStatus.MATCHED) & (with_test == status))
    assert on_edge > 30
    assert passed_unchecked > 10
    assert rejected >= 0.9 * passed_unchecked

    slanted = [wall(rng, (2.0, 1.5), (6.0, -2.5), 4.0)]
    left, right, depth = render(slanted, CAMERA, noise=2.0, rng=rng)
    uv = detect(left, corners_of)
    u, v = np.rint(uv).astype(int).T
    if tested is BY_PLANE:  # at the wall's ends there are two surfaces in a window
        uv = uv[np.isfinite(maximum_filter(depth, 2 * tested.plane_half_px + 1)[v, u])]
    found = match(left, right, uv, CAMERA, tested).status
    assert np.mean(found == status) < 0.02
    assert np.mean(found == MatchStatus.MATCHED) > 0.8


def test_a_narrow_strip_of_another_surface_is_told() -> None:
    """Two columns of the fit's window show another surface, half a pixel nearer."""
    corners = np.stack(np.meshgrid(np.arange(60.0, 280, 50), np.arange(30.0, 215, 25)), -1)
    u, v = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    beside = (u - 60) % 50
    step = 0.5 * ((beside > PARAMETERS.half_px - 2) & (beside < 25))
    tested, status = replace(BY_PLANE, noise_grey=2.0), []
    for seed in range(6):
        picture, rng = Picture(seed), np.random.default_rng(seed)
        images = [picture(u, v), np.roll(picture(u + step, v), -8, 1)]
        left, right = (
            np.clip(np.rint(k + 2 * rng.standard_normal(k.shape)), 0, 255).astype(np.uint8)
            for k in images
        )
        status.append(match(left, right, corners.reshape(-1, 2), CAMERA, tested).status)
    assert np.mean(np.array(status) == MatchStatus.BENT) > 0.9


def test_planes_are_bent_at_the_stated_rate() -> None:
    """Noisy plane patches are BENT at the stated rate; larger tolerances give fewer."""
    noise, share = 3.0, 0.1
    stated = replace(
        PARAMETERS,
        noise_grey=np.sqrt(noise**2 + 1 / 12),
        plane_probability=1 - share,
        plane_misfit_px=0.0,
    )
    uv, bent = grid(step=2 * stated.plane_half_px + 1), []  # windows that do not overlap
    for seed in range(8):
        images = pair(9.0, noise=noise, seed=seed)
        status = match(*images, uv, CAMERA, stated).status
        bent += (status[status != MatchStatus.WEAK] == MatchStatus.BENT).tolist()
    low, high = binom.interval(0.999, len(bent), share)
    assert low <= np.sum(bent) <= high
    for more in ({"plane_misfit_px": 0.5}, {"max_rows_px": 0.5}):
        status = match(*images, uv, CAMERA, replace(stated, **more)).status
        assert np.sum(status == MatchStatus.BENT) <= 1


@pytest.mark.parametrize("shape", [(5, 5), (30, 30), (240, 320)])
def test_flat_and_tiny_images_have_no_matches(shape: tuple[int, int]) -> None:
    uv = np.array([[2.0, 2.0], [15.0, 15.0], [200.0, 100.0], [1e6, -3.0]])
    for level in (0, 100, 255):
        image = np.full(shape, level, np.uint8)
        matches = match(image, image, uv, CAMERA, PARAMETERS)
        assert not np.any(matches.status == MatchStatus.MATCHED)
        assert np.isnan(matches.disparity_px).all()
        assert np.isnan(matches.sigma_px).all()


def test_every_pixel_of_the_image_may_be_asked_for() -> None:
    """Windows near the borders are refused, not read beyond them."""
    left, right = pair(9.3)
    u, v = np.meshgrid(np.arange(-3, 323, 2.0), np.arange(-3, 243, 7.0))
    uv = np.stack([u.ravel(), v.ravel()], -1)
    for half in (8, 15):
        parameters = replace(PARAMETERS, half_px=half, silhouette_half_px=half, plane_half_px=half)
        matches = match(left, right, uv, CAMERA, parameters)
        margin = np.minimum(uv, [319, 239] - uv).min(1)
        assert not np.any(matches.status[margin < half - 1] == MatchStatus.MATCHED)
        ok = matches.status == MatchStatus.MATCHED
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
        ("plane_half_px", 3),
        ("sigma_floor_px", -0.1),
        ("plane_probability", 1.1),
        ("plane_misfit_px", -0.1),
    ],
)
def test_wrong_parameters_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name}:"):
        StereoParameters(**{name: value})
