"""The affine fit of a patch: pictures warped exactly, a general solver, the law of noise."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from mapfusion.vision.patch_alignment import Templates, fit_patches
from mapfusion.vision.tracking import PATCH_SIDE_PX, cut_patches
from tests.mapfusion.vision.shifted_pictures import Picture

HALF = PATCH_SIDE_PX // 2
POINT = np.array([0.3, -0.2])
LINEAR = np.array([[1.15, 0.06], [-0.04, 0.9]])
PLACE = np.array([1.1, -0.7])
STRAIGHT = np.zeros(2)
START = np.array([[1.1, 0.0, 0.0], [0.0, 1.0, 0.0]])  # the place a pixel off, and the map near


def grey(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def before_and_after(
    seed: int,
    noise: float = 0.0,
    gain: float = 1.0,
    offset: float = 0.0,
    bend: np.ndarray = STRAIGHT,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw two images: POINT + x of the first is PLACE + LINEAR x / (1 + h'x) in the second."""
    v, u = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(float)
    picture, rng = Picture(seed), np.random.default_rng(seed)
    back = np.linalg.inv(LINEAR) @ (np.stack([u.ravel(), v.ravel()]) - PLACE[:, None])
    back = back / (1 - bend @ back)  # of y = x / (1 + h'x)
    u_there, v_there = back.reshape(2, *u.shape) + POINT[:, None, None]
    later = gain * picture(u_there, v_there) + offset
    images = (picture(u, v), later)
    first, second = (grey(i + noise * rng.standard_normal(u.shape)) for i in images)
    return first, second


def fitted(
    before: np.ndarray,
    after: np.ndarray,
    start: np.ndarray = START,
    noise: float = 2.0,
    max_misfit: float = 0.5,
    bend: np.ndarray = STRAIGHT,
) -> tuple[bool, np.ndarray]:
    warp, template = start[None].copy(), Templates.of(before[None], POINT[None], noise, max_misfit)
    found = fit_patches(template, np.zeros(1, int), after[None], warp, bend[None])
    return bool(found[0]), warp[0]


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.8, 15.0), (0.7, 60.0)])
def test_place_and_map_are_those_of_the_picture(gain: float, offset: float) -> None:
    for seed in range(10):
        found, warp = fitted(*before_and_after(seed, gain=gain, offset=offset))
        assert found
        np.testing.assert_allclose(warp[:, 2], PLACE, atol=0.02)
        np.testing.assert_allclose(warp[:, :2], LINEAR, atol=0.01)


def test_what_bends_is_found_where_it_is() -> None:
    """And with the bend left out always to the same side of it."""
    bend, off, off_straight = np.array([0.008, -0.004]), [], []
    for seed in range(10):
        pair = before_and_after(seed, bend=bend)
        for h, errors in ((bend, off), (STRAIGHT, off_straight)):
            found, warp = fitted(*pair, max_misfit=2.0, bend=h)
            assert found
            errors.append(warp[:, 2] - PLACE)
    np.testing.assert_allclose(off, 0, atol=0.03)
    straight = np.mean(off_straight, axis=0)
    assert np.linalg.norm(straight) > 0.1
    assert np.linalg.norm(np.mean(off, axis=0)) < 0.05 * np.linalg.norm(straight)


def test_equals_a_general_least_squares_solver() -> None:
    """On the weighted differences under a bilinear picture, which the fit stops changing at."""
    before, after = before_and_after(3, noise=1.0)
    found, warp = fitted(before, after)
    assert found
    v, u = (k.ravel() for k in np.mgrid[-10:11, -10:11].astype(float))
    weight = np.exp(-(u**2 + v**2) / (4 * 6.0**2))  # the root
    level = map_coordinates(
        before.astype(float), [HALF + POINT[1] + v, HALF + POINT[0] + u], order=1
    )

    def residuals(p: np.ndarray) -> np.ndarray:
        at_u, at_v = p[0] + p[2] * u + p[3] * v, p[1] + p[4] * u + p[5] * v
        seen = map_coordinates(after.astype(float), [HALF + at_v, HALF + at_u], order=1)
        return weight * (seen - p[6] * level - p[7])

    best = least_squares(residuals, [*PLACE, *LINEAR.ravel(), 1, 0], x_scale="jac").x
    np.testing.assert_allclose(warp[:, 2], best[:2], atol=0.02)
    np.testing.assert_allclose(warp[:, :2].ravel(), best[2:6], atol=0.004)


def test_noise_moves_the_place_as_the_normal_matrix_says() -> None:
    """Errors of 300 draws against the sandwich of weighted least squares, both pictures noisy."""
    v, u = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(float)
    clean, rng, noise = Picture(1)(u, v), np.random.default_rng(0), 3.0
    inner = slice(HALF - 10, HALF + 11)
    gv, gu = (slope[inner, inner].ravel() for slope in np.gradient(clean))
    x, y, level = (k[inner, inner].ravel() for k in (u, v, clean))
    J = np.stack([gu, gv, gu * x, gu * y, gv * x, gv * y, np.ones(len(x)), level], 1)
    w = np.exp(-(x**2 + y**2) / (2 * 6.0**2))
    inverse = np.linalg.inv(J.T @ (w[:, None] * J))
    expected = inverse @ (J.T @ (2 * noise**2 * w[:, None] ** 2 * J)) @ inverse
    errors = []
    start = np.eye(2, 3)
    for _ in range(300):
        pair = [grey(clean + noise * rng.standard_normal(clean.shape))[None] for _ in range(2)]
        warp, template = start[None].copy(), Templates.of(pair[0], np.zeros((1, 2)), noise, 0.5)
        assert fit_patches(template, np.zeros(1, int), pair[1], warp, np.zeros((1, 2)))[0]
        errors.append(warp[0, :, 2])
    ratio = np.std(errors, axis=0) / np.sqrt(np.diag(expected)[:2])
    # bilinear values between two pixels have less noise than a pixel; 300 draws know 4 %
    assert np.all((ratio > 0.75) & (ratio < 1.15)), ratio


def test_each_is_fitted_to_its_own_template() -> None:
    """In any order, some twice, among one without texture."""
    pairs = np.stack([before_and_after(seed) for seed in range(4)])
    before, after = pairs[:, 0], pairs[:, 1]
    before[2] = 128
    templates = Templates.of(before, np.tile(POINT, (4, 1)), 2.0, 0.5)
    rows = np.array([3, 0, 2, 1, 0])
    warp = np.tile(START, (5, 1, 1))
    found = fit_patches(templates, rows, after[rows], warp, np.zeros((5, 2)))
    assert found.tolist() == [True, True, False, True, True]
    for row, own in zip(rows[found], warp[found], strict=True):
        np.testing.assert_array_equal(own, fitted(before[row], after[row])[1])


def test_templates_have_room_beside_those_in_use() -> None:
    before, _ = before_and_after(0)
    templates = Templates.of(np.stack([before] * 3), np.tile(POINT, (3, 1)), 2.0, 0.5)
    window = templates.window.copy()
    assert templates.unused(np.array([0, 2]), 1).tolist() == [1]
    more = templates.unused(np.arange(3), 4)
    assert len(set(more.tolist()) - {0, 1, 2}) == 4
    assert more.max() < len(templates.window) == len(templates.factor) == len(templates.tolerated)
    np.testing.assert_array_equal(templates.window[:3], window)


def test_what_does_not_fit_is_told() -> None:
    before, after = before_and_after(5)
    other, _ = before_and_after(6)
    flat = np.full_like(before, 128)
    assert not fitted(before, other)[0]
    assert not fitted(flat, after)[0]
    assert not fitted(before, after, np.array([[1.8, 0, 0], [0, 1.8, 0]]))[0]  # leaves the patch
    hidden = after.copy()
    hidden[:, HALF:] = 128 + np.uint8(20)  # another surface before one half
    assert not fitted(before, hidden)[0]


def test_differences_beyond_noise_and_misfit_are_no_fit() -> None:
    """Between two pixels some of the noise averages out, so no more than stated is there."""
    for seed in range(10):
        pair = before_and_after(seed, noise=6.0)
        assert fitted(*pair, noise=6.0, max_misfit=0.001)[0]
        assert not fitted(*pair, noise=3.0, max_misfit=0.001)[0]
        assert fitted(*pair, noise=3.0, max_misfit=1.0)[0]


def test_patches_are_cut_around_the_nearest_pixel_and_repeat_the_border() -> None:
    image = np.arange(60 * 50, dtype=np.uint16).reshape(60, 50).astype(np.uint8)
    padded = np.pad(image, HALF, mode="edge")
    uv = np.array([[25.4, 30.6], [0.0, 0.0], [49.0, 59.0]])
    for patch, (u, v) in zip(cut_patches(image, uv), np.rint(uv).astype(int), strict=True):
        side = slice(v, v + PATCH_SIDE_PX), slice(u, u + PATCH_SIDE_PX)
        np.testing.assert_array_equal(patch, padded[side])
    assert cut_patches(image, np.zeros((0, 2))).shape == (0, PATCH_SIDE_PX, PATCH_SIDE_PX)
