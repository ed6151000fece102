"""Harris corners: where they are, which are kept, and what the threshold means."""

import cv2
import numpy as np
import pytest

from mapfusion.vision.harris import (
    HarrisParameters,
    detect,
    local_maxima,
    spread,
    strongest_maxima,
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


def test_equal_responses_keep_the_order_of_rows() -> None:
    response = np.zeros((60, 60), np.float32)
    response[30, 20], response[20, 30], response[25, 40] = 1, 1, 2
    parameters = HarrisParameters(border_px=5, min_slope=1.0)
    assert strongest_maxima(response, parameters).tolist() == [[40, 25], [30, 20], [20, 30]]


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


def test_maxima_are_those_of_the_obvious_search() -> None:
    response = np.random.default_rng(6).integers(0, 9, (40, 50)).astype(np.float32)  # with plateaus
    found = [
        [u, v]
        for v in range(3, 37)
        for u in range(3, 47)
        if response[v, u] > 4 and response[v, u] == response[v - 1 : v + 2, u - 1 : u + 2].max()
    ]
    assert local_maxima(response, 3, 4.0).tolist() == found
