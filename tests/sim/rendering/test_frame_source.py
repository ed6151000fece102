"""Tests of `sim.rendering.frame_source`."""

import hashlib
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.geometry.se2 import transform_points
from mapfusion.geometry.se3 import in_space
from sim.floorplan import FloorPlan, Wall
from sim.p3at import LENGTH_M
from sim.renderer import Renderer
from sim.rendering.frame_source import FrameSource, Visibility, truth_behind
from sim.stereo_head import RadiometricNoise, StereoFrame, render_stereo
from sim.world import World, write_faces

CAMERA = StereoCamera(320, 240, 288.0)
NOISE = RadiometricNoise()
# a looks at b, which stands broadside 2 m ahead of it, before the far wall at y = 3.95
POSES = np.array([[1.0, 0.8, np.pi / 2], [1.0, 2.8, 0.0]])


@pytest.fixture(scope="module", params=["tiny", "raycast"])
def renderer(request: pytest.FixtureRequest) -> Renderer:
    return request.param


@pytest.fixture(scope="module")
def source(faces: Path, renderer: Renderer) -> Iterator[FrameSource]:
    with FrameSource(faces, CAMERA, "ab", renderer) as opened:
        yield opened


def render(source: FrameSource, k: int) -> StereoFrame:
    """Frame k of robot a: it backs off while b turns."""
    poses = POSES + k * np.array([[0, -0.05, 0.02], [0, 0, 0.1]])
    return source.render(poses, "a", NOISE, np.random.default_rng([7, k]))


def digest(frames: list[StereoFrame]) -> str:
    pictures = [p for f in frames for p in (f.left, f.right, f.depth_m, f.left_rgb)]
    return hashlib.sha256(b"".join(picture.tobytes() for picture in pictures)).hexdigest()


def test_any_order_and_any_process_give_the_same_bits(
    source: FrameSource, faces: Path, renderer: Renderer
) -> None:
    forth = [render(source, k) for k in range(4)]
    source.render(POSES[::-1], "b", NOISE, np.random.default_rng(1))  # something else in between
    back = [render(source, k) for k in reversed(range(4))][::-1]
    assert digest(forth) == digest(back)
    assert len({digest([frame]) for frame in forth}) == 4
    program = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from pathlib import Path\n"
        "import test_frame_source as t\n"
        "s = t.FrameSource(Path(sys.argv[1]), t.CAMERA, 'ab', sys.argv[2])\n"
        "print(t.digest([t.render(s, k) for k in (2, 0, 3, 1)][1::2]))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, str(faces), renderer],
        capture_output=True,
        check=True,
        text=True,
    )
    assert result.stdout.strip() == digest([forth[0], forth[1]])


def test_robots_see_each_other_where_they_are(source: FrameSource) -> None:
    depth = source.render(POSES, "a", NOISE, np.random.default_rng(0)).depth_m
    center = int(CAMERA.center_px[0])
    # the deck of b begins half its width nearer than its middle; the wall shows on either side
    assert depth[148:165, center].min() == pytest.approx(2.0 - 0.15 - 0.497 / 2, abs=1e-3)
    wall_m = 3.95 - 0.8 - 0.15
    assert depth[140, 90] == pytest.approx(wall_m, abs=1e-3)
    hidden = depth[148:157, 80:240] < wall_m - 0.5
    width_px = np.ptp(np.flatnonzero(hidden.any(axis=0)))
    # its nearest side is half a width nearer than its middle; half a baseline shifts, not scales
    assert width_px == pytest.approx(CAMERA.focal_px * LENGTH_M / (1.85 - 0.497 / 2), abs=4)


def test_a_robot_does_not_see_itself(faces: Path, renderer: Renderer) -> None:
    """From the rear of the deck it would see the deck; b, behind it, is out of sight too."""
    camera = StereoCamera(320, 240, 288.0, mount_x_m=-0.3)
    poses = np.array([[2.2, 2.8, 0.3], [1.0, 2.8, 0.0]])
    with FrameSource(faces, camera, "ab", renderer) as source:
        depth = source.render(poses, "a", NOISE, np.random.default_rng(0)).depth_m
    lowest_ray = (camera.height_px - 1 - camera.center_px[1]) / camera.focal_px
    assert depth.min() == pytest.approx(camera.mount_z_m / lowest_ray, abs=1e-3)  # the floor


def test_truth_points_lie_on_what_is_seen(source: FrameSource) -> None:
    frame = source.render(POSES, "a", NOISE, np.random.default_rng(0))
    rng = np.random.default_rng(2)
    uv = rng.uniform([90, 1], [140, 100], (200, 2))  # above b: the wall at y = 3.95, sub-pixel
    points, _ = truth_behind(CAMERA, frame.depth_m, uv, POSES[0])
    np.testing.assert_allclose(points[:, 1], 3.95, atol=1e-4)
    # seen from the left camera, the points fall on their pixels again
    x, y, z = points.T
    depth = y - 0.8 - CAMERA.mount_x_m
    lateral = 1.0 - x  # a looks along y, so its left is towards smaller x
    u = CAMERA.center_px[0] - CAMERA.focal_px * (lateral - CAMERA.baseline_m / 2) / depth
    v = CAMERA.center_px[1] - CAMERA.focal_px * (z - CAMERA.mount_z_m) / depth
    np.testing.assert_allclose(np.stack([u, v], -1), uv, atol=0.01)


def test_truth_on_a_slanted_plane_interpolates_the_inverse_depth() -> None:
    """A plane's inverse depth is linear in the image; linear depth would be off by millimetres."""
    v, u = np.mgrid[:240, :320]
    depth = (1 / (0.2 + 0.0005 * u + 0.0002 * v)).astype(np.float32)
    uv = np.random.default_rng(3).uniform([0, 0], [319, 239], (500, 2))
    points, _ = truth_behind(CAMERA, depth, uv, np.zeros(3))
    expected = 1 / (0.2 + 0.0005 * uv[:, 0] + 0.0002 * uv[:, 1])
    np.testing.assert_allclose(points[:, 0] - CAMERA.mount_x_m, expected, atol=2e-6)


def test_at_an_edge_the_nearest_pixel_counts() -> None:
    depth = np.full((240, 320), 2.0, dtype=np.float32)
    depth[:, 100:] = 5.0
    depth[:, 200:] = np.nan
    uv = np.array([[99.4, 50.0], [99.6, 50.0], [199.4, 50.0], [199.6, 50.0], [319.0, 239.0]])
    points, _ = truth_behind(CAMERA, depth, uv, np.zeros(3))
    np.testing.assert_allclose(
        points[:, 0] - CAMERA.mount_x_m, [2, 5, 5, np.nan, np.nan], atol=1e-6
    )


def test_truth_follows_the_pixel_on_its_own_surface() -> None:
    """Two slanted planes that meet at a step in depth: the points of either move along it."""
    v, u = np.mgrid[:240, :320]
    planes = [1 / (0.2 + 0.0005 * u + 0.0002 * v), 1 / (0.4 - 0.0004 * u + 0.0003 * v)]
    depth = np.where(u < 150, *planes).astype(np.float32)
    uv = np.random.default_rng(3).uniform([3, 3], [316, 236], (500, 2))
    uv = np.concatenate([uv, [[149.0, 100.0], [150.0, 100.0]]])  # at the step, on either side
    pose = np.array([1.0, 2.0, 0.7])
    _, slope = truth_behind(CAMERA, depth, uv, pose)
    for own, left in zip(planes, (uv[:, 0] < 149.01, uv[:, 0] > 149.99), strict=True):
        for axis, step in enumerate(0.01 * np.eye(2)):
            there, here = (
                CAMERA.back_project(at, map_coordinates(own, at[:, ::-1].T, order=3))
                for at in (uv[left] + step, uv[left] - step)
            )
            along = (transform_points(pose, there) - transform_points(pose, here)) / 0.02
            np.testing.assert_allclose(slope[left, :, axis], along, atol=3e-4)
    gone = np.where(u < 150, planes[0], np.nan).astype(np.float32)
    assert np.all(truth_behind(CAMERA, gone, np.array([[200.0, 50.0]]), pose)[1] == 0)


def test_no_pixels_no_points() -> None:
    depth = np.ones((240, 320), dtype=np.float32)
    assert truth_behind(CAMERA, depth, np.zeros((0, 2)), np.zeros(3))[0].shape == (0, 3)


def test_a_body_that_tilts_sees_the_same_room(source: FrameSource) -> None:
    """Points behind its pixels, put into the world by its pose, lie on its surfaces."""
    tilted = in_space(POSES, [[0.06, -0.08], [0.02, 0.03]])
    frame = source.render(tilted, "a", NOISE, np.random.default_rng(0))
    rng = np.random.default_rng(2)
    uv = rng.uniform([30, 3], [290, 236], (2000, 2))
    points, _ = truth_behind(CAMERA, frame.depth_m, uv, tilted[0])
    # not on b, nor on an edge, where the nearest pixel counts
    inside = np.all(np.abs(points[:, :2] - POSES[1, :2]) > 0.4, axis=1)
    surfaces = np.array([[0.05, 4.95], [0.05, 3.95], [0.0, 2.5]])
    off = np.abs(points[inside, :, None] - surfaces)
    assert np.quantile(off.min(axis=(1, 2)), 0.95) < 2e-3
    _, slope = truth_behind(CAMERA, frame.depth_m, uv, tilted[0])
    there, _ = truth_behind(CAMERA, frame.depth_m, uv + np.array([0.3, 0.0]), tilted[0])
    near = np.linalg.norm(there - points - 0.3 * slope[:, :, 0], axis=1)
    assert np.quantile(near, 0.9) < 1e-3


def test_a_tilted_mount_is_a_tilted_body(faces: Path, renderer: Renderer) -> None:
    """As long as both turn about the same point, here the middle between the optical centres."""
    mounted = replace(CAMERA, mount_roll_rad=0.05, mount_pitch_rad=-0.1)
    poses = in_space(POSES[:1], np.array([[0.05, -0.1]]))
    middle = np.array([CAMERA.mount_x_m, 0.0, CAMERA.mount_z_m])
    upright = in_space(POSES[:1], np.zeros((1, 2)))
    poses[0, :3, 3] += (upright[0, :3, :3] - poses[0, :3, :3]) @ middle
    frames = []
    for camera, own in ((mounted, POSES[:1]), (CAMERA, poses)):
        with FrameSource(faces, camera, "a", renderer) as opened:
            frames.append(opened.render(own, "a", NOISE, np.random.default_rng(0)))
    same = np.isclose(frames[0].depth_m, frames[1].depth_m, rtol=1e-5)
    assert same.mean() > 0.999
    assert np.mean(np.abs(frames[0].left.astype(int) - frames[1].left) > 1) < 1e-3


def test_unknown_robots_and_wrong_shapes_are_named(source: FrameSource) -> None:
    with pytest.raises(InputError, match="robot c: unknown, there are a, b"):
        source.render(POSES, "c", NOISE, np.random.default_rng(0))
    with pytest.raises(ValueError, match="T_world_robots: shape"):
        source.render(POSES[:1], "a", NOISE, np.random.default_rng(0))


VISIBILITY_CAMERA = StereoCamera(200, 150, 180.0)


@pytest.fixture(scope="module")
def maze(tmp_path_factory: pytest.TempPathFactory) -> tuple[FloorPlan, Path]:
    """Three rooms with doors, a low wall one can look over, and a pillar."""
    plan = FloorPlan(
        (
            Wall(np.array([[0, 0], [9, 0], [9, 5], [0, 5], [0, 0]])),
            Wall(np.array([[3, 0], [3, 3.6]])),
            Wall(np.array([[6, 5], [6, 2.6], [7.5, 2.6]])),
            Wall(np.array([[4, 2], [5, 2.5]]), height_m=0.7),
            Wall(np.array([[1.2, 2], [1.6, 2], [1.6, 2.4], [1.2, 2.4], [1.2, 2]])),
        )
    )
    folder = tmp_path_factory.mktemp("maze")
    write_faces(folder, plan, np.random.default_rng(0))
    return plan, folder


def test_images_are_the_same_with_hidden_faces_left_out(maze: tuple[FloorPlan, Path]) -> None:
    plan, folder = maze
    rng = np.random.default_rng(1)
    places = rng.uniform([0.3, 0.3], [8.7, 4.7], (60, 2))
    places = places[plan.clearance_m(places) > 0.3]
    poses = np.column_stack([places, rng.uniform(-np.pi, np.pi, len(places))])
    poses[:4, 2] = np.arange(4) * np.pi / 2  # along the walls
    left_out = []
    with World() as world:
        corners = world.add_painted_faces(folder)
        visibility = Visibility(corners, VISIBILITY_CAMERA)
        everything = np.ones(len(corners), dtype=bool)
        for pose in poses:
            seen = visibility.seen(pose)
            left_out.append(np.mean(~seen))
            frames = []
            for shown in (everything, seen):
                world.show_faces(shown)
                frames.append(
                    render_stereo(
                        world,
                        VISIBILITY_CAMERA,
                        pose,
                        RadiometricNoise(0, 0, 0),
                        np.random.default_rng(0),
                    )
                )
            np.testing.assert_array_equal(frames[0].left_rgb, frames[1].left_rgb)
            np.testing.assert_array_equal(frames[0].right, frames[1].right)
            np.testing.assert_array_equal(frames[0].depth_m, frames[1].depth_m)
    assert np.mean(left_out) > 0.6


def test_a_single_wall_is_seen_from_its_front_only() -> None:
    wall = np.array([[[2, 1, 0], [2, -1, 0], [2, -1, 2.5], [2, 1, 2.5]]], dtype=float)
    visibility = Visibility(wall, VISIBILITY_CAMERA)
    assert visibility.seen(np.zeros(3)).tolist() == [True]
    assert visibility.seen(np.array([0, 0, np.pi])).tolist() == [False]
    assert visibility.seen(np.array([4, 0, np.pi])).tolist() == [False]
