"""Harris corners: where they are, which are kept, and what the threshold means."""

import cv2
import numpy as np
import pytest

from mapfusion.vision.harris import (
    HarrisParameters,
    _window_px,
    descending,
    detect,
    harris_response,
    local_maxima,
    spread,
)


def quadrant(u: float, v: float, shape: tuple[int, int] = (80, 100)) -> np.ndarray:
    """Bright below and to the right of (u, v), pixels averaged over their area."""
    x = np.clip(np.arange(shape[1]) - u + 0.5, 0, 1)
    y = np.clip(np.arange(shape[0]) - v + 0.5, 0, 1)
    return np.rint(60 + 160 * np.outer(y, x)).astype(np.uint8)


def noise_image(shape: tuple[int, int] = (200, 260), sigma: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(3)
    smooth = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma)
    return np.clip(128 + 50 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("u", "v"), [(40.0, 30.0), (47.3, 41.6), (60.5, 29.25)])
def test_finds_a_corner_at_sub_pixel_precision(u: float, v: float) -> None:
    """On its bisector, inside by about the smoothing, wherever between the pixels it lies."""
    corners = detect(quadrant(u, v), HarrisParameters())
    assert len(corners) == 1
    inside = corners[0] - [u, v]
    assert inside[0] == pytest.approx(inside[1], abs=0.05)
    centred = detect(quadrant(40.0, 30.0), HarrisParameters())[0] - [40, 30]
    # whole pixels would do no better than 0.5, the parabola errs by 0.17 at most
    np.testing.assert_allclose(inside, centred, atol=0.2)
    assert 0 < centred[0] < HarrisParameters().smoothing_px


def test_threshold_is_a_slope_in_every_direction() -> None:
    """The kept corners are those whose structure tensor, in grey levels per pixel, says so."""
    image = noise_image(sigma=5.0)
    parameters = HarrisParameters(max_corners=5000, min_distance_px=1, min_slope=4.0)
    smooth = cv2.GaussianBlur(image, (0, 0), parameters.smoothing_px).astype(float)
    slope_u = cv2.Sobel(smooth, cv2.CV_64F, 1, 0) / 8
    slope_v = cv2.Sobel(smooth, cv2.CV_64F, 0, 1) / 8
    m = [
        cv2.blur(a * b, (parameters.block_px,) * 2)
        for a, b in ((slope_u,) * 2, (slope_v,) * 2, (slope_u, slope_v))
    ]
    response = m[0] * m[1] - m[2] ** 2 - 0.04 * (m[0] + m[1]) ** 2
    # both eigenvalues equal to min_slope^2 is the weakest corner
    strong = response > parameters.min_slope**4 * (1 - 4 * 0.04)
    peak = response == cv2.dilate(response, np.ones((3, 3)))
    border = parameters.border_px
    inner = (strong & peak)[border:-border, border:-border]
    assert 0 < inner.sum() < peak[border:-border, border:-border].sum()
    assert len(detect(image, parameters)) == inner.sum()


@pytest.mark.parametrize("sigma_px", [0.1, 0.3, 0.5, 0.8, 1.0, 1.3, 1.5, 2.0, 3.7, 10.0, 50.0])
def test_a_picture_is_smoothed_as_over_all_of_opencvs_window(sigma_px: float) -> None:
    image, side = (
        np.random.default_rng(0).integers(0, 256, (90, 80), np.uint8),
        _window_px(sigma_px),
    )
    np.testing.assert_array_equal(
        cv2.GaussianBlur(image, (side, side), sigma_px), cv2.GaussianBlur(image, (0, 0), sigma_px)
    )
    smaller = cv2.GaussianBlur(image, (max(side - 2, 1),) * 2, sigma_px)
    assert side == 1 or np.any(smaller != cv2.GaussianBlur(image, (0, 0), sigma_px))


def test_corners_keep_their_distance_and_number() -> None:
    parameters = HarrisParameters(max_corners=40, min_distance_px=15)
    corners = detect(noise_image(), parameters)
    assert len(corners) == 40
    distance = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    # the sub-pixel step may move either by half a pixel each way
    assert distance[np.triu_indices(40, 1)].min() > 15 - np.sqrt(2)


def test_one_rich_corner_of_the_image_does_not_take_all() -> None:
    image = noise_image((320, 320)).astype(float)
    image[:, 160:] = 128 + 0.3 * (image[:, 160:] - 128)
    corners = detect(image.astype(np.uint8), HarrisParameters(max_corners=40, cell_px=160))
    share = np.mean(corners[:, 0] > 160)
    assert 0.4 < share < 0.6
    greedy = detect(image.astype(np.uint8), HarrisParameters(max_corners=40, cell_px=1000))
    assert np.mean(greedy[:, 0] > 160) < 0.1


def spread_twin(
    candidates: np.ndarray, min_distance: int, cell: int, per_cell: int, most: int
) -> list[int]:
    kept: list[int] = []
    for share in (per_cell, most):
        for n, point in enumerate(candidates):
            near = [m for m in kept if np.hypot(*(candidates[m] - point)) < min_distance]
            same = [m for m in kept if np.all(candidates[m] // cell == point // cell)]
            if n not in kept and not near and len(same) < share and len(kept) < most:
                kept.append(n)
    return sorted(kept)


@pytest.mark.parametrize("seed", range(5))
def test_choice_equals_its_obvious_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    candidates = rng.permutation(np.argwhere(rng.random((60, 70)) < 0.1))[:, ::-1]
    found = spread(np.ascontiguousarray(candidates), (60, 70), 5, 20, 4, 37)
    assert np.flatnonzero(found).tolist() == spread_twin(candidates, 5, 20, 4, 37)


def test_equal_responses_keep_their_order() -> None:
    """Against NumPy's stable sort, of numbers of all sizes, many of them twice or more."""
    rng = np.random.default_rng(8)
    values = np.exp(rng.uniform(-80, 80, 4000)).astype(np.float32)
    values = values[rng.integers(0, 1500, 4000)]
    values[:2] = np.finfo(np.float32).tiny, np.finfo(np.float32).max
    np.testing.assert_array_equal(descending(values), np.argsort(-values, kind="stable"))
    assert len(descending(values[:0])) == 0


def test_strongest_come_first_and_follow_the_image() -> None:
    image = noise_image((100, 120), sigma=4.0).astype(float)
    image[:, 60:] = 128 + 0.5 * (image[:, 60:] - 128)
    parameters = HarrisParameters(cell_px=1000)
    corners = detect(image.astype(np.uint8), parameters)
    assert np.all(corners[:5, 0] < 60)
    assert np.any(corners[5:, 0] > 60)
    moved = detect(np.roll(noise_image(), (5, 3), (0, 1)), HarrisParameters(max_corners=5000))
    still = detect(noise_image(), HarrisParameters(max_corners=5000))
    inside = (np.abs(still - [130, 100]) < [90, 60]).all(1)
    distance = np.linalg.norm(still[inside, None] + [3, 5] - moved[None], axis=-1).min(1)
    assert np.mean(distance < 1e-3) > 0.95


@pytest.mark.parametrize("shape", [(1, 1), (20, 20), (24, 300), (480, 640)])
@pytest.mark.parametrize("level", [0, 130])
def test_nothing_is_found_where_nothing_is(shape: tuple[int, int], level: int) -> None:
    assert detect(np.full(shape, level, np.uint8), HarrisParameters()).shape == (0, 2)


def test_sensor_noise_alone_makes_no_corner() -> None:
    rng = np.random.default_rng(0)
    grey = np.rint(128 + 2 * rng.standard_normal((480, 640))).astype(np.uint8)
    assert len(detect(grey, HarrisParameters())) == 0


@pytest.mark.parametrize("image", [np.zeros((50, 50)), np.zeros((50, 50, 3), np.uint8)])
def test_wrong_images_are_refused(image: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"^image:"):
        detect(image, HarrisParameters())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_corners", 0),
        ("k", 0.3),
        ("min_slope", 0.0),
        ("smoothing_px", -1.0),
        ("border_px", 0),
    ],
)
def test_wrong_parameters_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name}:"):
        HarrisParameters(**{name: value})


@pytest.mark.parametrize("block_px", [1, 3, 8])
def test_the_response_is_opencv_s(block_px: int) -> None:
    image = cv2.GaussianBlur(
        np.random.default_rng(5).integers(0, 256, (150, 90), dtype=np.uint8), (0, 0), 1.5
    )
    parameters = HarrisParameters(block_px=block_px)
    whole = cv2.cornerHarris(image, block_px, 3, parameters.k)
    own = harris_response(image, parameters)
    np.testing.assert_allclose(own, whole, rtol=0, atol=1e-6 * np.abs(whole).max())


@pytest.mark.parametrize("shape", [(1, 40), (40, 1), (2, 40), (40, 2), (1, 1), (2, 2)])
def test_so_it_is_of_images_that_are_all_border(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(5).integers(0, 256, shape, dtype=np.uint8)
    parameters = HarrisParameters(block_px=3)
    whole = cv2.cornerHarris(image, 3, 3, parameters.k)
    own = harris_response(image, parameters)
    np.testing.assert_allclose(own, whole, rtol=0, atol=1e-6 * np.abs(whole).max())


def test_maxima_are_pixels_that_dilation_leaves_as_they_are() -> None:
    response = np.random.default_rng(6).integers(0, 9, (40, 50)).astype(np.float32)  # with plateaus
    inner = (slice(3, -3), slice(3, -3))
    highest = cv2.dilate(response, np.ones((3, 3)))[inner]
    v, u = np.nonzero((response[inner] == highest) & (response[inner] > 4))
    np.testing.assert_array_equal(
        local_maxima(response, 3, np.float32(4)), np.stack([u, v], -1) + 3
    )
