"""Time of the simulation without rendering: sensor noise, physics, a painted world."""

from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from mapfusion.camera import StereoCamera
from sim.driver import DriverSettings, drive
from sim.floorplan import FloorPlan, Wall
from sim.rendering.frame_source import FrameSource
from sim.routes import Route
from sim.stereo_head import RadiometricNoise, expose
from sim.world import write_faces


def rooms() -> FloorPlan:
    """20 x 15 m: a corridor between two rows of four rooms."""
    doors = [(0, 2), (3.2, 7), (8.2, 12), (13.2, 17), (18.2, 20)]
    walls = [Wall(np.array([[0, 0], [20, 0], [20, 15], [0, 15], [0, 0]]))]
    walls += [Wall(np.array([[x0, y], [x1, y]])) for y in (6, 9) for x0, x1 in doors]
    walls += [Wall(np.array([[x, y], [x, y + 6]])) for y in (0, 9) for x in (5, 10, 15)]
    return FloorPlan(tuple(walls))


@pytest.fixture(scope="module")
def faces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("faces")
    write_faces(folder, rooms(), np.random.default_rng(0))
    return folder


def test_exposing_a_pair_of_640x480(benchmark: BenchmarkFixture) -> None:
    pair, rng = np.full((2, 480, 640), 128, dtype=np.uint8), np.random.default_rng(0)
    benchmark(lambda: [expose(gray, RadiometricNoise(), rng) for gray in pair])


def test_sixty_seconds_of_three_robots(benchmark: BenchmarkFixture) -> None:
    routes = [
        Route("a", np.array([1, 7.5, 0]), np.array([[19, 7.5], [1, 7.5]]), loop=True),
        Route("b", np.array([2.6, 2, 1]), np.array([[2.6, 5], [2.6, 1]]), loop=True),
        Route("c", np.array([12.6, 12, 1]), np.array([[12.6, 10], [12.6, 14]]), loop=True),
    ]
    benchmark.pedantic(lambda: drive(rooms(), routes, DriverSettings(), 241, 0.25), rounds=3)


def test_painting_a_world(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    benchmark.pedantic(lambda: write_faces(tmp_path, rooms(), np.random.default_rng(0)), rounds=3)


def test_loading_a_world(benchmark: BenchmarkFixture, faces: Path) -> None:
    def load() -> None:
        FrameSource(faces, StereoCamera(), "abc").close()

    benchmark.pedantic(load, rounds=3)
