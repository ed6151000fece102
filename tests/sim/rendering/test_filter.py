"""Walls whose filtered pictures are known by calculus: a wave, an edge, a pair of images."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mapfusion.camera import StereoCamera
from sim.rendering.scene import make_scene
from tests.sim.rendering.scenes import TEXELS_PER_M, along_m, look, one_wall, pinhole, slanted

CAMERA = StereoCamera(640, 48, 577.0, mount_x_m=0.0)
STRAIGHT = np.zeros(3)
ROW = 24
VIEWS = [(1.5, 0.0), (3.0, 0.6), (6.0, -0.9), (12.0, 1.1), (18.0, 1.25)]  # metres, radians


@pytest.mark.parametrize(("distance_m", "slant_rad"), VIEWS)
def test_a_wave_shows_with_the_amplitude_of_its_integral_over_a_pixel(
    distance_m: float, slant_rad: float
) -> None:
    """A wave is damped by the known transfer function of a pixel's footprint."""
    per_pixel_m = distance_m / CAMERA.focal_px / np.cos(slant_rad)
    wave_m = max(3 * per_pixel_m, 0.16)  # 40 texels, so that texels are fine enough
    start, end = slanted(distance_m, slant_rad, 1.0)
    scene = one_wall(start, end, lambda t, _: 128 + 120 * np.cos(2 * np.pi * t / wave_m))
    camera = pinhole(CAMERA, STRAIGHT)
    picture = look(scene, camera)[ROW]
    fine = np.linspace(-0.5, 0.5, 201)
    u = np.arange(CAMERA.width_px)[:, None] + fine
    t = along_m(start, end, camera, u)
    inside = np.all((t > 0.02) & (t < 1.98), axis=1)
    true = np.cos(2 * np.pi * t / wave_m).mean(axis=1)[inside]
    amplitude = (picture[inside] - 128) @ true / (true @ true)
    assert np.ptp(true) > 0.3
    assert amplitude == pytest.approx(120, rel=0.005)
    texel = (np.floor(t[inside] * TEXELS_PER_M) + 0.5) / TEXELS_PER_M
    painted = np.rint(128 + 120 * np.cos(2 * np.pi * texel / wave_m)).mean(axis=1)
    assert np.abs(picture[inside] - painted).max() < 1.0


@pytest.mark.parametrize(("distance_m", "slant_rad"), VIEWS)
def test_an_edge_is_where_it_is_to_a_fiftieth_of_a_pixel(
    distance_m: float, slant_rad: float
) -> None:
    start, end = slanted(distance_m, slant_rad, 2.0)
    off = []
    for x in np.linspace(0, 0.02, 7):  # the edge crosses pixels at different places
        camera = pinhole(CAMERA, np.array([0.0, x, 0.0]))
        scene = one_wall(start, end, lambda t, _: np.where(t < 2.0, 20, 220))
        # its middle lies ahead of where the robot stood
        edge_u = camera.center_u + CAMERA.focal_px * x / distance_m
        around = slice(round(edge_u) - 8, round(edge_u) + 9)
        share = (look(scene, camera)[ROW, around] - 20) / 200
        # what is bright begins so far before the last pixel's end
        off.append(around.stop - 0.5 - share.sum() - edge_u)
    assert np.abs(off).max() < 0.02


@pytest.mark.parametrize(("distance_m", "slant_rad"), [(1.5, 0.2), *VIEWS[1:]])
def test_disparity_on_a_slanted_wall_is_unbiased_to_a_hundredth_of_a_pixel(
    distance_m: float, slant_rad: float
) -> None:
    """The shift that fits the right image to the left one, beside the true one, by regression."""
    half_wall_m = max(2.0, distance_m / 3)
    start, end = slanted(distance_m, slant_rad, half_wall_m)
    rng = np.random.default_rng(4)
    per_pixel_m = distance_m / CAMERA.focal_px / np.cos(slant_rad)
    waves_m = rng.uniform(8, 24, 12) * max(per_pixel_m, 1 / TEXELS_PER_M)
    phases, up_m = rng.uniform(0, 2 * np.pi, 12), 16 * distance_m / CAMERA.focal_px

    def grey(t: np.ndarray, up: np.ndarray) -> np.ndarray:
        # other phases in other rows, so that rounding is another too
        waves = (t / wave_m + up / up_m for wave_m in waves_m)
        cosines = (np.cos(2 * np.pi * w + p) for w, p in zip(waves, phases, strict=True))
        return 128 + 12 * sum(cosines).clip(-10, 10)

    scene = one_wall(start, end, grey)
    half_m = CAMERA.baseline_m / 2
    left_camera, right_camera = (pinhole(CAMERA, STRAIGHT, y) for y in (half_m, -half_m))
    left, right = look(scene, left_camera), look(scene, right_camera)
    u = np.arange(20.0, CAMERA.width_px - 20)
    t = along_m(start, end, left_camera, u)
    points = start + t[:, None] * (end - start) / np.linalg.norm(end - start)
    u_right = right_camera.center_u - CAMERA.focal_px * (points[:, 1] + half_m) / points[:, 0]
    kept = (
        (np.abs(t - half_wall_m) < half_wall_m - 6 * per_pixel_m)  # a pixel there shows the end too
        & (np.abs(u_right - left_camera.center_u) < CAMERA.width_px / 2 - 20)
    )
    rows = np.repeat(np.arange(4, 44), kept.sum())
    at = np.tile(u_right[kept], 40)

    def of_right(shift_px: float) -> np.ndarray:
        return map_coordinates(right, [rows, at + shift_px], order=5, mode="nearest")

    slope = (of_right(0.25) - of_right(-0.25)) / 0.5
    difference = left[rows, np.tile(u[kept].astype(int), 40)] - of_right(0.0)
    bias_px = difference @ slope / (slope @ slope)
    assert kept.sum() > 50
    assert abs(bias_px) < 0.01


def test_a_wall_of_more_light_than_its_sums_hold_shows_as_painted() -> None:
    """16 x 2.5 m of white add up to more than 2^31 grey levels: the sums run over."""
    start, end = slanted(6.0, 0.0, 8.0)
    scene = make_scene(
        np.array([[[*start, 0], [*end, 0], [*end, 2.5], [*start, 2.5]]]),
        lambda _: np.full((2500, 4000), 251, dtype=np.uint8),
    )
    assert 2500 * 4000 * 251 > 2**31
    picture = look(scene, pinhole(CAMERA, STRAIGHT))
    assert np.all(picture == 251)
