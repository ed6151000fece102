"""Renderers side by side in paper.yaml's world: time of a stereo pair, and what is seen in it.

`pytest tests/benchmarks/test_renderers.py --benchmark-only` prints both tables. Renderers take
turns within each repetition, so that what else the machine does meets all of them: ratios count.
Sensor noise, and the turning of colours into grey, are part of a pair.
"""

import itertools
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from scipy.ndimage import map_coordinates

from experiments.pipeline.stages.drive import Walls
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.geometry.se2 import compose
from mapfusion.vision.front_end import FrontEnd, FrontEndParameters, observable
from mapfusion.vision.tracking import Tracker
from sim.renderer import Renderer
from sim.rendering.frame_source import FrameSource
from sim.stereo_head import RadiometricNoise
from sim.world import write_faces

CAMERA = StereoCamera()
REPETITIONS = 5
# along the corridor, across a room into the corner, at a wall, into the corridor from a room
STATED = np.array([[1.5, 7.5, 0.0], [1.5, 1.5, 0.8], [10.5, 0.9, 1.5], [3.2, 4.8, 1.5]])
EVERY_LEG = 5  # of the robots' routes, seen from its middle along it
AHEAD = np.array([2.0, 0.3, 0.7])  # where the other robot stands, seen from the first
AWAY = np.array([50.0, 50.0, 0.0])
FRAMES, STEP_M = 20, 0.1  # of each robot's first leg
ROBUST_SIGMA = 1.4826  # standard deviation over median absolute deviation, of normal errors


def say(line: str) -> None:
    sys.stdout.write(line + "\n")


def drawn_by(name: Renderer) -> Simulation:
    """paper.yaml with what its front end knows of a renderer's pictures."""
    loaded = load_scenario(Path("scenarios/paper.yaml"), [f"render.renderer={name}"])
    assert isinstance(loaded, Simulation)
    return loaded


@pytest.fixture(scope="module")
def scenario() -> Simulation:
    return drawn_by("tiny")


@pytest.fixture(scope="module")
def faces(scenario: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper")
    world = scenario.world
    lines = tuple(tuple(wall.points) for wall in world.walls)
    plan = Walls(lines, world.wall_height_m, world.wall_thickness_m).floor_plan()
    write_faces(folder, plan, np.random.default_rng(0))
    return folder


def legs(scenario: Simulation) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Robot, first pose (3,) and direction (2,) of each leg, and its end in the last of them."""
    for robot in scenario.robots:
        points = np.array([robot.start[:2], *robot.route])
        for start, end in itertools.pairwise(points):
            along = end - start
            yield robot.name, np.array([*start, np.arctan2(along[1], along[0])]), along


def sources(faces: Path, stack: ExitStack, names: list[Renderer]) -> dict[Renderer, FrameSource]:
    """Renderers that work here."""
    opened: dict[Renderer, FrameSource] = {}
    for name in names:
        try:
            opened[name] = stack.enter_context(FrameSource(faces, CAMERA, "ab", name))
        except InputError as error:  # EGL, where the system has none
            say(str(error))
    return opened


def in_view(own: np.ndarray) -> np.ndarray:
    return compose(own, AHEAD)


def times_ms(opened: dict[Renderer, FrameSource], poses: np.ndarray) -> np.ndarray:
    """(REPETITIONS, renderers); a picture before them is not counted."""
    rng, taken = np.random.default_rng(0), np.empty((REPETITIONS + 1, len(opened)))
    for i in range(len(taken)):
        for k, source in enumerate(opened.values()):
            begin = time.perf_counter()
            source.render(poses, "a", RadiometricNoise(), rng, colour=False)
            taken[i, k] = 1e3 * (time.perf_counter() - begin)
    return taken[1:]


def test_stereo_pair_with_depth(
    benchmark: BenchmarkFixture,
    scenario: Simulation,
    faces: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    middles = [[*(start[:2] + along / 2), start[2]] for _, start, along in legs(scenario)]
    places = np.vstack([STATED, np.unique(middles, axis=0)[::EVERY_LEG]])

    def measure() -> None:
        with ExitStack() as stack, capsys.disabled():
            opened = sources(faces, stack, ["raycast", "egl", "tiny"])
            for company in ("alone", "robot in view"):
                say(f"\n{company}; ms, median (spread) of {REPETITIONS}: {', '.join(opened)}")
                ratios = []
                for own in places:
                    other = AWAY if company == "alone" else in_view(own)
                    taken = times_ms(opened, np.stack([own, other]))
                    medians, spread = np.median(taken, axis=0), np.ptp(taken, axis=0)
                    ratios.append(medians[1:] / medians[0])
                    cells = (f"{m:7.2f} ({s:5.2f})" for m, s in zip(medians, spread, strict=True))
                    over = " ".join(f"{ratio:5.1f}" for ratio in ratios[-1])
                    say(f"{own.round(1)!s:20} {' '.join(cells)}   over raycast {over}")
                say(f"over raycast, median over poses: {np.median(ratios, axis=0).round(1)}")
                say(f"over raycast, worst pose: {np.min(ratios, axis=0).round(1)}")

    benchmark.pedantic(measure, rounds=1)


def seen_on_a_leg(
    source: FrameSource, vision: FrontEndParameters, start: np.ndarray, along: np.ndarray
) -> np.ndarray:
    """Rows (N, 3) of frame, error of disparity in px and the same over its stated sigma."""
    front_end, rng, rows = FrontEnd(CAMERA, vision), np.random.default_rng(1), []
    tracker = Tracker(front_end.parameters.tracks, CAMERA, front_end.parameters.sigma_uv_px)
    for i in range(FRAMES):
        own = start.copy()
        own[:2] += i * STEP_M * along / np.linalg.norm(along)
        frame = source.render(np.stack([own, AWAY]), "a", RadiometricNoise(), rng, colour=False)
        features = front_end.extract(frame.left, frame.right)
        keep = tracker.landmarks(tracker.update(features))
        given = (features.disparity_px, features.sigma_disparity_px)
        kept = observable(CAMERA, *given, keep, front_end.parameters)
        # inverse depth is linear in the picture on a plane
        at = features.uv_px[kept, ::-1].T
        nearness = map_coordinates(1 / frame.depth_m.astype(float), at, order=1)
        error = features.disparity_px[kept] - CAMERA.focal_px * CAMERA.baseline_m * nearness
        rows.append(
            np.column_stack(
                [np.full(len(kept), i), error, error / features.sigma_disparity_px[kept]]
            )
        )
    return np.concatenate(rows)


def test_disparities_and_observations(
    benchmark: BenchmarkFixture,
    scenario: Simulation,
    faces: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    first = {name: (start, along) for name, start, along in reversed(list(legs(scenario)))}

    def measure() -> None:
        with ExitStack() as stack, capsys.disabled():
            say(f"\n{FRAMES} frames of each robot's first leg")
            for name, source in sources(faces, stack, ["raycast", "egl", "tiny"]).items():
                vision = drawn_by(name).vision
                rows = [seen_on_a_leg(source, vision, *leg) for leg in first.values()]
                rows = np.concatenate(rows)
                error, z = rows[:, 1], rows[:, 2]
                near = np.abs(error) < 1.0  # the rest are slips
                mad = np.median(np.abs(error - np.median(error)))
                say(
                    f"{name:8} {len(rows) / FRAMES / len(first):6.1f} observations a frame, "
                    f"disparity: bias {np.median(error):+.4f} px, MAD {mad:.4f} px, "
                    f"z RMS {np.sqrt(np.mean(z[near] ** 2)):.2f}, "
                    f"robust {ROBUST_SIGMA * np.median(np.abs(z)):.2f}, slips {np.mean(~near):.4f}"
                )

    benchmark.pedantic(measure, rounds=1)
