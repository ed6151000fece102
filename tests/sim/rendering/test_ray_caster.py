"""The ray caster beside TinyRenderer: the same pixels, and what their footprints hold."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.geometry.se3 import in_space
from sim.floorplan import FloorPlan, Wall
from sim.rendering.frame_source import FrameSource
from sim.rendering.ray_caster import RayCaster, TiltedView
from sim.stereo_head import RadiometricNoise, StereoFrame, camera_pose, depth_at
from sim.world import write_faces

CAMERA = StereoCamera(320, 240, 288.5)
NO_NOISE = RadiometricNoise(0, 0, 0)
LEFT_M = CAMERA.baseline_m / 2
# the robot that looks, and one in its view: two corners of the room, the stub's end, at an arm's
# length, half behind the stub
VIEWS = np.array(
    [
        [[1.2, 2.1, -0.35], [2.6, 1.5, 0.7]],
        [[4.2, 1.0, 2.0], [4.0, 3.0, 0.1]],
        [[1.0, 1.0, 0.4], [2.0, 1.5, 2.3]],
        [[1.0, 2.0, 0.0], [3.6, 1.6, 1.1]],
    ]
)


@pytest.fixture(scope="module")
def tiny(faces: Path) -> list[StereoFrame]:
    """TinyRenderer's frames of all views."""
    with FrameSource(faces, CAMERA, "ab") as source:
        rng = np.random.default_rng(0)
        return [source.render(view, "a", NO_NOISE, rng) for view in VIEWS]


def silhouettes(depth_m: np.ndarray, width_px: int = 3) -> np.ndarray:
    """Pixels (H, W) where one surface ends: inverse depth is linear in the image on each."""
    bent = np.abs(cv2.Laplacian((1 / depth_m).astype(np.float64), -1)) > 1e-4
    return cv2.dilate(bent.astype(np.uint8), np.ones((width_px, width_px))) > 0


def finer(camera: StereoCamera, times: int) -> StereoCamera:
    size = {"width_px": camera.width_px * times, "height_px": camera.height_px * times}
    return replace(camera, **size, focal_px=camera.focal_px * times)


def averaged(picture: np.ndarray, times: int) -> np.ndarray:
    height, width = picture.shape
    blocks = picture.reshape(height // times, times, width // times, times)
    return blocks.astype(np.float64).mean(axis=(1, 3))


def test_sampled_at_the_middles_the_pictures_are_tinyrenderer_s(
    faces: Path, tiny: list[StereoFrame]
) -> None:
    caster = RayCaster(faces, CAMERA, "middle")
    for view, frame in zip(VIEWS, tiny, strict=True):
        for y_m, expected in ((LEFT_M, frame.left), (-LEFT_M, frame.right)):
            off = np.abs(caster.grey(view[0], y_m, view[1:]).astype(float) - expected)
            assert off.mean() < 0.01
            assert np.mean(off > 0) < 0.002
        rgb = caster.rgb(view[0], LEFT_M, view[1:])
        assert np.mean(np.any(rgb != frame.left_rgb, axis=-1)) < 0.002


def test_depth_is_tinyrenderer_s_and_so_are_the_robots_pixels(
    faces: Path, tiny: list[StereoFrame]
) -> None:
    caster = RayCaster(faces, CAMERA)
    for view, frame in zip(VIEWS, tiny, strict=True):
        depth_m = caster.depth_m(view[0], LEFT_M, view[1:])
        alone_m = caster.depth_m(view[0], LEFT_M, np.zeros((0, 3)))
        robot, true_robot = depth_m < alone_m, frame.depth_m < 0.999 * alone_m
        assert true_robot.sum() > 200
        assert np.sum(robot != true_robot) < 0.005 * true_robot.sum()
        same = robot == true_robot
        assert np.mean(np.abs(depth_m / frame.depth_m - 1)[same] > 1e-4) < 1e-4


def test_filtered_pictures_are_tinyrenderer_s_of_four_times_the_size_averaged(faces: Path) -> None:
    caster = RayCaster(faces, CAMERA)
    large = finer(CAMERA, 4)
    nobody = np.zeros((0, 3))
    off, off_edges, plain = [], [], []
    with FrameSource(faces, large, "a") as source, FrameSource(faces, CAMERA, "a") as small:
        for own in VIEWS[:3, 0]:
            rng = np.random.default_rng(0)
            # the same rays: the middle of 4 x 4 pixels is the middle of the one they make up
            true = averaged(source.render(own[None], "a", NO_NOISE, rng).left, 4)
            edge = silhouettes(caster.depth_m(own, LEFT_M, nobody))
            error = np.abs(caster.grey(own, LEFT_M, nobody) - true)
            aliased = np.abs(small.render(own[None], "a", NO_NOISE, rng).left - true)
            off.append(error[~edge].mean())
            off_edges.append(error[edge].mean())
            plain.append(aliased[~edge].mean())
    assert np.mean(off) < 0.6
    assert np.mean(off) < 0.6 * np.mean(plain)
    assert np.mean(off_edges) < 1.0


def test_robots_in_filtered_pictures_are_those_that_many_rays_hit(faces: Path) -> None:
    """The change of an image by a robot, with walls in front of it and behind it."""
    caster, fine, nobody = RayCaster(faces, CAMERA), finer(CAMERA, 8), np.zeros((0, 3))
    by_rays = RayCaster(faces, fine, "middle")
    for view in VIEWS:
        own, robot = view[0], view[1:]
        picture, alone = (caster.grey(own, LEFT_M, who).astype(float) for who in (robot, nobody))
        changed, by_ray = (by_rays.grey(own, LEFT_M, who) for who in (robot, nobody))
        true = averaged(changed.astype(float) - by_ray, 8)
        off = np.abs(picture - alone - true)
        where = (np.abs(true) > 1) | (np.abs(picture - alone) > 1)
        assert where.sum() > 200
        assert off[where].mean() < 1.5
        assert np.mean(off[where] > 10) < 0.03


TILTS = np.array([[0.09, -0.05], [-0.03, 0.1], [0.05, 0.05]])


def test_tilted_pictures_are_tinyrenderer_s(faces: Path) -> None:
    """Images and depths equal averaged ones of four times the size, within the level bounds."""
    caster, nobody = RayCaster(faces, CAMERA), np.zeros((0, 3))
    off, off_edges, plain = [], [], []
    with (
        FrameSource(faces, finer(CAMERA, 4), "a") as source,
        FrameSource(faces, CAMERA, "a") as small,
    ):
        for own in in_space(VIEWS[:3, 0], TILTS):
            rng = np.random.default_rng(0)
            true = averaged(source.render(own[None], "a", NO_NOISE, rng).left, 4)
            frame = small.render(own[None], "a", NO_NOISE, rng)
            edge = silhouettes(frame.depth_m)
            error = np.abs(caster.grey(own, LEFT_M, nobody) - true)
            off.append(error[~edge].mean())
            off_edges.append(error[edge].mean())
            plain.append(np.abs(frame.left - true)[~edge].mean())
            deep = np.abs(caster.depth_m(own, LEFT_M, nobody) / frame.depth_m - 1)
            assert deep[~edge].max() < 1e-4
            assert np.mean(deep > 1e-4) < 0.01
    assert np.mean(off) < 0.6
    assert np.mean(off) < 0.6 * np.mean(plain)
    assert np.mean(off_edges) < 1.0


def test_depth_of_a_tilted_view_is_that_between_pixels(faces: Path) -> None:
    """By the slow way: the level depth image, looked up where the tilted pixels' rays go."""
    nobody, T = np.zeros((0, 3)), in_space(VIEWS[1, 0], TILTS[0])
    depth_m = RayCaster(faces, CAMERA).depth_m(T, LEFT_M, nobody)
    view = TiltedView.of(CAMERA, camera_pose(CAMERA, T, LEFT_M))
    rng = np.random.default_rng(0)
    level = (2 + 0.2 * rng.random((view.level.height_px, view.level.width_px))).astype(np.float32)
    level[:, ::7] = 5.0
    level[:, ::31] = np.nan
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    ahead, u_ahead, v_ahead = view.to_level @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    uv = np.stack([u_ahead / ahead, v_ahead / ahead], -1)
    expected = (depth_at(level, uv) / ahead).reshape(depth_m.shape)
    np.testing.assert_allclose(view.depth_m(level), expected, rtol=1e-6)


def test_filtered_pictures_are_their_own_of_eight_times_the_size_averaged(faces: Path) -> None:
    caster, fine = RayCaster(faces, CAMERA), RayCaster(faces, finer(CAMERA, 8))
    for view in VIEWS:
        picture = caster.grey(view[0], LEFT_M, view[1:]).astype(float)
        off = np.abs(picture - averaged(fine.grey(view[0], LEFT_M, view[1:]), 8))
        edge = silhouettes(caster.depth_m(view[0], LEFT_M, view[1:]))
        assert off.mean() < 0.25
        assert np.quantile(off[~edge], 0.99) < 2
        assert off[edge].mean() < 1


def test_what_it_cannot_draw_is_one_line(tmp_path: Path) -> None:
    around = np.array([[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]])
    write_faces(tmp_path, FloorPlan((Wall(around, height_m=0.6),)), np.random.default_rng(0))
    with pytest.raises(InputError, match=r"raycast cannot draw from 0\.8 m above walls of 0\.6 m"):
        RayCaster(tmp_path, replace(CAMERA, mount_z_m=0.8))
    low_room = RayCaster(tmp_path, CAMERA)
    tipped = in_space([2.0, 1.5, 0.0], [0.0, -1.0])
    with pytest.raises(InputError, match=r"raycast cannot draw what a camera sees that tilts so"):
        RayCaster(tmp_path, replace(CAMERA, mount_z_m=0.2)).grey(tipped, LEFT_M, np.zeros((0, 3)))
    with pytest.raises(InputError, match=r"cannot draw from 0\.79\d* m above walls of 0\.6 m"):
        low_room.grey(in_space([2.0, 1.5, 0.0], [1.0, -0.9]), 1.0, np.zeros((0, 3)))
    low = Wall(np.array([[1, 1], [2, 1]]), height_m=0.5)
    write_faces(tmp_path, FloorPlan((Wall(around), low)), np.random.default_rng(0))
    with pytest.raises(
        InputError, match="cannot draw walls of different heights; renderer: tiny can"
    ):
        RayCaster(tmp_path, CAMERA)
