"""Leaving out hidden faces must not change one bit of an image."""

from pathlib import Path

import numpy as np
import pytest

from mapfusion.geometry.camera import StereoCamera
from sim.floorplan import FloorPlan, Wall
from sim.recorder import Visibility
from sim.stereo_head import RadiometricNoise, render_stereo
from sim.world import World, write_faces

CAMERA = StereoCamera(200, 150, 180.0)


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
        visibility = Visibility(corners, CAMERA)
        everything = np.ones(len(corners), dtype=bool)
        for pose in poses:
            seen = visibility.seen(pose)
            left_out.append(np.mean(~seen))
            frames = []
            for shown in (everything, seen):
                world.show_faces(shown)
                frames.append(
                    render_stereo(
                        world, CAMERA, pose, RadiometricNoise(0, 0, 0), np.random.default_rng(0)
                    )
                )
            np.testing.assert_array_equal(frames[0].left_rgb, frames[1].left_rgb)
            np.testing.assert_array_equal(frames[0].right, frames[1].right)
            np.testing.assert_array_equal(frames[0].depth_m, frames[1].depth_m)
    assert np.mean(left_out) > 0.6


def test_a_single_wall_is_seen_from_its_front_only() -> None:
    wall = np.array([[[2, 1, 0], [2, -1, 0], [2, -1, 2.5], [2, 1, 2.5]]], dtype=float)
    visibility = Visibility(wall, CAMERA)
    assert visibility.seen(np.zeros(3)).tolist() == [True]
    assert visibility.seen(np.array([0, 0, np.pi])).tolist() == [False]
    assert visibility.seen(np.array([4, 0, np.pi])).tolist() == [False]
