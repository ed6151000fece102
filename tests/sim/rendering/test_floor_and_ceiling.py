"""Floors in whole numbers, against the same samples taken one by one in floating point."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from mapfusion.camera import StereoCamera
from sim.rendering.floor_and_ceiling import BACKGROUND, draw_plane, footprints, row_depth_m
from sim.rendering.scene import make_scene
from sim.rendering.walls import Pinhole
from tests.sim.rendering.scenes import pinhole

# wide, so that a row is drawn in pieces; coarse, so that it needs smaller copies of the picture
CAMERA = StereoCamera(300, 120, 60.0, mount_x_m=0.0)
SIZE_M = np.array([4.0, 3.0])


@pytest.mark.parametrize("pose", [[0.6, 0.5, 0.4], [3.5, 2.8, -2.3], [2.0, 0.1, 1.6]])
def test_a_floor_is_the_mean_of_its_samples(pose: list[float]) -> None:
    rough = gaussian_filter(np.random.default_rng(3).normal(size=(120, 160)), 1.0)
    texels = np.rint(127.5 + 127.5 * rough / np.abs(rough).max()).astype(np.uint8)
    corners = np.zeros((2, 4, 3))
    corners[:, :, :2] = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * SIZE_M
    corners[0, :, :2] = [[0, 0], [4, 0], [4, 0], [0, 0]]  # there is no world without a wall
    corners[0, 2:, 2] = 2.5
    floor = make_scene(corners, lambda i: texels).floor
    camera = pinhole(CAMERA, np.array(pose))
    picture = np.zeros((CAMERA.height_px, CAMERA.width_px), dtype=np.uint8)
    draw_plane(camera, floor, False, np.full(CAMERA.width_px, 60), picture)
    plan, copies = footprints(camera, floor), copies_of(texels, len(floor.first))
    assert plan[:, 2].max() > 0
    off = []
    for v in range(60, CAMERA.height_px):
        true = row(camera, copies, plan[v], floor.height_m, v)
        # copies and the picture are rounded, and places to 1/256 of a texel
        np.testing.assert_allclose(picture[v], true, atol=1.5)
        off.append(picture[v] - true)
    assert np.abs(np.mean(off)) < 0.05
    assert np.all(picture[:60] == 0)


def copies_of(texels: np.ndarray, count: int) -> list[np.ndarray]:
    """The picture, and means of 2 x 2 texels of the one before."""
    copies = [texels.astype(float)]
    while len(copies) < count and not any(n % 2 for n in copies[-1].shape):
        height, width = copies[-1].shape
        copies.append(copies[-1].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3)))
    return copies


def row(
    camera: Pinhole, copies: list[np.ndarray], plan: np.ndarray, height_m: float, v: int
) -> np.ndarray:
    """Grey levels (W,) of a row, as planned."""
    n, across, k = plan
    if n == 0:
        return np.full(camera.width_px, BACKGROUND)
    total = np.zeros(camera.width_px)
    for side in range(across):
        u = np.arange(camera.width_px) + (0.0 if across == 1 else side / 2 - 0.25)
        for s in range(n):
            z = row_depth_m(camera, height_m, v - 0.5 + (s + 0.5) / n)
            left = (camera.center_u - u) / camera.focal_px
            cos, sin = np.cos(camera.theta), np.sin(camera.theta)
            at = np.stack([cos - left * sin, sin + left * cos]) * z
            share = (at.T + np.array([camera.eye_x_m, camera.eye_y_m])).T / SIZE_M[:, None]
            place = share[::-1] * np.array(copies[k].shape)[:, None] - 0.5
            grey = map_coordinates(copies[k], place, order=1, mode="nearest")
            inside = np.all((share >= 0) & (share < 1), axis=0)
            total += np.where(inside, grey, BACKGROUND)
    return total / (n * across)
