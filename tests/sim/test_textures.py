import cv2
import numpy as np
import pytest

from sim.floorplan import Face
from sim.textures import STYLES, paint

WALL = Face(np.array([[0, 0, 0], [3, 0, 0], [3, 0, 2.5], [0, 0, 2.5]], dtype=float), "wall")


def gray(seed: int) -> np.ndarray:
    return cv2.cvtColor(paint(WALL, np.random.default_rng(seed)), cv2.COLOR_RGB2GRAY)


def test_a_picture_depends_on_its_generator_alone() -> None:
    np.testing.assert_array_equal(gray(3), gray(3))
    assert np.mean(gray(3) != gray(4)) > 0.9


def test_size_follows_the_face() -> None:
    density = STYLES["wall"].texels_per_m
    assert paint(WALL, np.random.default_rng(0)).shape == (2.5 * density, 3 * density, 3)
    sliver = Face(WALL.corners_m * [0.001, 1, 1], "wall")
    assert paint(sliver, np.random.default_rng(0)).shape[1] >= 1


@pytest.mark.parametrize("distance_m", [1.0, 2.0, 4.0, 8.0])
def test_corners_at_every_distance(distance_m: float) -> None:
    """Harris' strong corners in a 640x480 picture of the wall, as a lens of 577 px draws it."""
    picture = gray(1)
    scale = 577 / distance_m / STYLES["wall"].texels_per_m
    seen = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    seen = seen[:480, :640]
    corners = cv2.goodFeaturesToTrack(seen, 500, 0.02, 8, useHarrisDetector=True)
    per_quarter_degree_px = 10_000  # an image of 640x480 holds 31 such squares
    assert len(corners) / (seen.size / per_quarter_degree_px) > 2  # 60 and more in an image


def test_nothing_repeats() -> None:
    """No patch of half a metre is found again anywhere else, in this face or in another."""
    first, second = gray(1), gray(2)
    size = STYLES["wall"].texels_per_m // 2
    for row, column in ((20, 30), (200, 300), (400, 500)):
        patch = first[row : row + size, column : column + size]
        score = cv2.matchTemplate(first, patch, cv2.TM_CCOEFF_NORMED)
        assert score[row, column] > 0.999
        near = size // 2
        score[max(0, row - near) : row + near, max(0, column - near) : column + near] = 0
        assert score.max() < 0.6
        assert cv2.matchTemplate(second, patch, cv2.TM_CCOEFF_NORMED).max() < 0.6
