"""A stereo pair of 640 x 480 with depth in paper.yaml's world: ray caster, TinyRenderer, EGL.

Run it with `pytest tests/benchmarks/test_renderers.py --benchmark-only`; compare only figures of
one run, on one core. Sensor noise is in it, a millisecond with any.
"""

from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from experiments.run.stages.walls import Walls
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from sim.radiometry import RadiometricNoise
from sim.recorder import FrameSource
from sim.renderer import Renderer
from sim.world import write_faces

# along the corridor, across a room into the corner, at a wall, into the corridor from a room
OWN = np.array([[1.5, 7.5, 0.0], [1.5, 1.5, 0.8], [10.5, 0.9, 1.5], [3.2, 4.8, 1.5]])
AHEAD = np.array([2.0, 0.3, 0.7])  # where the other robot stands, seen from the first


@pytest.fixture(scope="module")
def faces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper")
    scenario = load_scenario(Path("scenarios/paper.yaml"))
    assert isinstance(scenario, Simulation)
    world = scenario.world
    lines = tuple(tuple(wall.points) for wall in world.walls)
    plan = Walls(lines, world.wall_height_m, world.wall_thickness_m).floor_plan()
    write_faces(folder, plan, np.random.default_rng(0))
    return folder


@pytest.mark.parametrize("company", ["alone", "robot in view"])
@pytest.mark.parametrize("place", range(len(OWN)))
@pytest.mark.parametrize("renderer", ["raycast", "egl", "tiny"])
def test_stereo_pair_with_depth(
    benchmark: BenchmarkFixture, faces: Path, renderer: Renderer, place: int, company: str
) -> None:
    own = OWN[place]
    cos, sin = np.cos(own[2]), np.sin(own[2])
    step = [cos * AHEAD[0] - sin * AHEAD[1], sin * AHEAD[0] + cos * AHEAD[1], AHEAD[2]]
    other = own + step if company == "robot in view" else np.array([19.0, 14.0, 0.0])
    poses, rng = np.stack([own, other]), np.random.default_rng(0)
    try:
        source = FrameSource(faces, StereoCamera(), "ab", renderer)
    except InputError as error:  # EGL, where the system has none
        pytest.skip(str(error))
    with source:
        benchmark.pedantic(
            lambda: source.render(poses, "a", RadiometricNoise(), rng, colour=False),
            rounds=5,
            iterations=4,
            warmup_rounds=1,
        )
