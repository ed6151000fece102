"""U-SURF against a version without integral images, and against the symmetries it must have."""

import numpy as np
import pytest

from mapfusion.vision.surf import USurfParameters, describe


def overlap(low: float, high: float, first: int, count: int) -> np.ndarray:
    """Length of [low, high] inside each of `count` unit intervals from `first` on."""
    edge = first + np.arange(count)
    return np.clip(np.minimum(high, edge + 1) - np.maximum(low, edge), 0, None)


def twin(image: np.ndarray, u: float, v: float, s: float) -> np.ndarray:
    """One descriptor by integrating every half of every wavelet over the pixels' squares."""
    margin = int(12 * s) + 10  # also for keypoints somewhat outside
    padded = np.pad(image.astype(float), margin, mode="edge")
    height, width = padded.shape

    def box(x0: float, x1: float, y0: float, y1: float) -> float:
        return overlap(y0, y1, -margin, height) @ padded @ overlap(x0, x1, -margin, width)

    cells = np.zeros((4, 4, 4))
    for i in range(20):
        for j in range(20):
            x, y = u + 0.5 + (j - 9.5) * s, v + 0.5 + (i - 9.5) * s
            weight = np.exp(-((i - 9.5) ** 2 + (j - 9.5) ** 2) / (2 * 3.3**2))
            dx = weight * (box(x, x + s, y - s, y + s) - box(x - s, x, y - s, y + s))
            dy = weight * (box(x - s, x + s, y, y + s) - box(x - s, x + s, y - s, y))
            cells[i // 5, j // 5] += dx, dy, abs(dx), abs(dy)
    return cells.ravel() / np.linalg.norm(cells)


@pytest.fixture
def image() -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.integers(0, 200, (90, 110)).astype(np.uint8)


@pytest.mark.parametrize(
    ("u", "v", "s"),
    [
        (50.0, 40.0, 2.0),
        (50.3, 41.8, 1.37),
        (4.2, 85.9, 3.1),  # the window leaves the image: border pixels repeat
        (-6.0, 40.0, 2.0),  # the keypoint lies outside
        (55.0, 45.0, 9.0),  # the window is larger than the image
    ],
)
def test_equals_direct_integration(image: np.ndarray, u: float, v: float, s: float) -> None:
    found = describe(image, np.array([[u, v]]), np.array([s]))[0]
    np.testing.assert_allclose(found, twin(image, u, v, s), atol=1e-6)


def test_brightness_and_contrast_do_not_matter(image: np.ndarray) -> None:
    dark = image // 4
    uv, s = np.array([[50.3, 41.8], [30.0, 30.0]]), np.array([1.7, 2.0])
    expected = describe(dark, uv, s)
    np.testing.assert_allclose(describe(dark + 90, uv, s), expected, atol=1e-6)
    np.testing.assert_allclose(describe(dark * 3, uv, s), expected, atol=1e-6)


def test_moves_with_the_image(image: np.ndarray) -> None:
    uv, shift, s = np.array([[50.3, 41.8]]), np.array([-5, 7]), np.array([1.7])
    moved = np.roll(image, (7, -5), axis=(0, 1))
    np.testing.assert_allclose(describe(moved, uv + shift, s), describe(image, uv, s), atol=1e-6)


def test_magnified_image_at_magnified_scale_is_the_same(image: np.ndarray) -> None:
    """An image of doubled pixels is the same picture, as a metric window requires."""
    uv, s = np.array([[50.3, 41.8]]), np.array([1.7])
    magnified = image.repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_allclose(
        describe(magnified, 2 * uv + 0.5, 2 * s), describe(image, uv, s), atol=1e-6
    )


@pytest.mark.parametrize("axis", ["u", "v", "diagonal"])
def test_mirror_images_have_mirrored_cells(image: np.ndarray, axis: str) -> None:
    height, width = image.shape
    u, v = 50.3, 41.8
    cells = describe(image, np.array([[u, v]]), np.array([1.7])).reshape(4, 4, 4)
    if axis == "u":
        mirrored, uv = image[:, ::-1], [width - 1 - u, v]
        expected = cells[:, ::-1] * [-1, 1, 1, 1]
    elif axis == "v":
        mirrored, uv = image[::-1], [u, height - 1 - v]
        expected = cells[::-1] * [1, -1, 1, 1]
    else:
        mirrored, uv = image.T, [v, u]
        expected = cells.transpose(1, 0, 2)[..., [1, 0, 3, 2]]
    found = describe(np.ascontiguousarray(mirrored), np.array([uv]), np.array([1.7]))
    np.testing.assert_allclose(found.reshape(4, 4, 4), expected, atol=1e-6)


def test_ramp_answers_with_its_slope_everywhere() -> None:
    """On a ramp every dx is the same but for its weight, and dy vanishes."""
    ramp = np.tile(np.arange(0, 240, 2, dtype=np.uint8), (100, 1))
    cells = describe(ramp, np.array([[60.2, 50.7]]), np.array([2.0])).reshape(4, 4, 4)
    np.testing.assert_allclose(cells[..., [1, 3]], 0, atol=1e-6)
    np.testing.assert_allclose(cells[..., 0], cells[..., 2], atol=1e-6)
    offset = (np.arange(20) - 9.5).reshape(4, 5)
    along = np.exp(-(offset**2) / (2 * 3.3**2)).sum(1)
    expected = np.outer(along, along)
    expected /= np.sqrt(2) * np.linalg.norm(expected)
    np.testing.assert_allclose(cells[..., 0], expected, atol=1e-6)


def test_unit_length_or_zero_where_nothing_is(image: np.ndarray) -> None:
    uv = np.array([[50.3, 41.8], [3.0, 3.0]])
    np.testing.assert_allclose(
        np.linalg.norm(describe(image, uv, np.array([1.3, 2.9])), axis=1), 1, atol=1e-6
    )
    for level in (0, 77, 255):
        flat = np.full((90, 110), level, np.uint8)
        assert not describe(flat, uv, np.array([1.3, 2.9])).any()
    assert describe(np.zeros((1, 1), np.uint8), uv[:1], np.array([2.0])).shape == (1, 64)
    assert describe(image, np.zeros((0, 2)), np.zeros(0)).shape == (0, 64)


def test_flat_is_what_is_faint_over_the_whole_window() -> None:
    """One grey level at one of 600 x 600 pixels, well off the middle: a mean of 1e-5 of a level."""
    image = np.full((900, 900), 100, np.uint8)
    image[450 + 6 * 30, 450 + 8 * 30] = 101
    uv = np.array([[450.0, 450.0], [450.0 + 8 * 30, 450.0 + 6 * 30]])
    assert not describe(image, uv[:1], np.array([30.0])).any()
    assert describe(image, uv[1:], np.array([2.0])).any()  # in the middle of a small window


def test_scales() -> None:
    depth = np.array([1.0, 4.0, 1000.0, 0.01])
    metric = USurfParameters("metric", side_m=0.8, min_scale_px=1.5, max_scale_px=30.0)
    np.testing.assert_allclose(metric.scales_px(depth, 500.0), [20.0, 5.0, 1.5, 30.0])
    pixels = USurfParameters("pixels", scale_px=2.5)
    np.testing.assert_allclose(pixels.scales_px(depth, 500.0), 2.5)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("image", (np.zeros((9, 9)), np.zeros((1, 2)), np.ones(1))),
        ("image", (np.zeros((9, 9, 3), np.uint8), np.zeros((1, 2)), np.ones(1))),
        ("image", (np.zeros((0, 9), np.uint8), np.zeros((1, 2)), np.ones(1))),
        ("uv_px", (np.zeros((9, 9), np.uint8), np.zeros((1, 3)), np.ones(1))),
        ("uv_px", (np.zeros((9, 9), np.uint8), np.full((1, 2), np.nan), np.ones(1))),
        ("scale_px", (np.zeros((9, 9), np.uint8), np.zeros((1, 2)), np.ones(2))),
        ("scale_px", (np.zeros((9, 9), np.uint8), np.zeros((1, 2)), np.zeros(1))),
    ],
)
def test_wrong_arguments_are_named(name: str, arguments: tuple) -> None:
    with pytest.raises(ValueError, match=f"^{name}:"):
        describe(*arguments)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("window", {"window": "round"}),
        ("scale_px", {"scale_px": 0.0}),
        ("side_m", {"side_m": -1.0}),
        ("max_scale_px", {"min_scale_px": 2.0, "max_scale_px": 1.0}),
    ],
)
def test_wrong_parameters_are_named(name: str, values: dict) -> None:
    with pytest.raises(ValueError, match=f"^{name}:"):
        USurfParameters(**values)
