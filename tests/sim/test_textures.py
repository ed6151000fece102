import cv2
import numpy as np
import pytest

from mapfusion.errors import InputError
from sim.floorplan import Face
from sim.textures import STYLES, Texture, paint, paint_posters

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


def painted(**settings: object) -> np.ndarray:
    texture = Texture(**settings)
    posters = paint_posters(texture, np.random.default_rng(9))
    picture = paint(WALL, np.random.default_rng(3), texture, posters)
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)


def test_contrast_scales_all_that_differs_from_the_plain_colour() -> None:
    full, third, none = (painted(contrast=c).astype(float) for c in (1.0, 0.3, 0.0))
    assert np.ptp(none) == 0
    np.testing.assert_allclose(third - none, 0.3 * (full - none), atol=2)  # rounded thrice
    assert full.std() > 20


def test_less_coverage_leaves_fewer_corners() -> None:
    def corners(**settings: object) -> int:
        return len(cv2.goodFeaturesToTrack(painted(**settings), 5000, 0.02, 8))

    assert corners(coverage=0.25) < 0.6 * corners()


def test_the_share_of_bare_walls_is_the_one_asked_for() -> None:
    texture, small = Texture(bare=0.3), Face(WALL.corners_m / 3, "wall")
    bare = [
        np.ptp(paint(small, np.random.default_rng(seed), texture), axis=(0, 1)).max() == 0
        for seed in range(60)
    ]
    assert 8 <= sum(bare) <= 28  # 18 expected, standard deviation 3.5


def test_the_same_posters_hang_on_different_walls() -> None:
    texture = Texture(posters=1, contrast=0.2)
    (poster,) = paint_posters(texture, np.random.default_rng(9))
    for seed in (1, 2):
        wall = paint(WALL, np.random.default_rng(seed), texture, [poster])
        found = cv2.matchTemplate(wall, poster, cv2.TM_SQDIFF)
        assert found.min() == 0
        hung = np.argwhere(found == 0)
        assert len(hung) == 1  # 3 m hold one of 1.2 m with gaps of 0.4 m, not two
        assert hung[0, 0] == round((2.5 - 0.2 - 1.6) * STYLES["wall"].texels_per_m)
    assert len(paint_posters(Texture(posters=3), np.random.default_rng(0))) == 3


def test_a_world_s_posters_have_one_width_drawn_evenly_on_a_logarithmic_scale() -> None:
    texture = Texture(posters=2, poster_width_m=(0.5, 4.0))
    density, widths = STYLES["wall"].texels_per_m, []
    for seed in range(40):
        one, two = paint_posters(texture, np.random.default_rng(seed))
        assert one.shape == two.shape
        assert one.shape[0] == 1.6 * density
        widths.append(one.shape[1] / density)
    assert 0.5 <= min(widths) < 0.65 < 3.0 < max(widths) <= 4
    assert 0.25 <= np.mean(np.array(widths) < np.sqrt(2)) <= 0.75  # half expected, sigma 0.08


def test_a_poster_hangs_only_where_there_is_room() -> None:
    texture = Texture(posters=1)
    low = Face(WALL.corners_m * [1, 1, 0.5], "wall")
    posters = paint_posters(texture, np.random.default_rng(9))
    with_posters = paint(low, np.random.default_rng(1), texture, posters)
    np.testing.assert_array_equal(with_posters, paint(low, np.random.default_rng(1)))


@pytest.mark.parametrize(
    "settings",
    [{"contrast": -1}, {"bare": 2}, {"posters": 1000}, {"poster_m": (0, 1)}, {"coverage": np.nan}]
    + [{"poster_width_m": width} for width in ((2, 1), (0.01, 1))],
)
def test_impossible_textures_are_refused(settings: dict) -> None:
    with pytest.raises(InputError, match=f"{next(iter(settings))}"):
        Texture(**settings)
