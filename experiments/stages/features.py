"""Stage: each robot's stereo images, rendered and turned into features, frame by frame.

Frames do not depend on each other, so they are made in parallel, in chunks; a chunk on disk is
never made again. Images are kept for a few frames only (for figure 1).
"""

import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa

from experiments.randomness import generator
from experiments.scenario import Scenario
from experiments.stages.drive import floor_plan
from experiments.store import StageFolder, Store
from mapfusion.robot_log import DESCRIPTOR_LENGTH
from mapfusion.se2 import Float
from mapfusion.storage import column, read_table, schema, write_table, write_whole
from mapfusion.vision.features import Features
from mapfusion.vision.frontend import FrontEnd
from sim.recorder import FrameSource, truth_points
from sim.renderer import renderer_name
from sim.trajectory import read_trajectory
from sim.world import write_faces

SOURCES = (
    "sim",
    "mapfusion/vision",
    "mapfusion/camera.py",
    "mapfusion/se2.py",
    "mapfusion/symmetric.py",
)
SOURCES += ("mapfusion/storage.py", "mapfusion/robot_log.py")
SOURCES += ("experiments/stages/features.py", "experiments/randomness.py")

FACES_SOURCES = ("sim", "mapfusion/se2.py", "experiments/stages/drive.py")
FACES_SOURCES += ("experiments/stages/features.py", "experiments/randomness.py")
FACES_SOURCES += ("mapfusion/storage.py",)

# Frames a task: about two seconds of work, so little is lost when a run is interrupted.
FRAMES_PER_CHUNK = 20

FEATURES = schema(
    "features",
    1,
    [
        pa.field("iteration", pa.int32()),
        pa.field("u_px", pa.float64()),
        pa.field("v_px", pa.float64()),
        pa.field("disparity_px", pa.float64()),
        pa.field("sigma_disparity_px", pa.float64()),
        pa.field("descriptor", pa.list_(pa.float32(), DESCRIPTOR_LENGTH)),
    ],
)
# Row i is the world point behind row i of the features. Kept apart: estimators never read it.
TRUTH = schema("features.truth", 1, [pa.field(n, pa.float64()) for n in ("x_m", "y_m", "z_m")])


def faces_stage(store: Store, scenario: Scenario) -> StageFolder:
    """Where the world's textures are or will be."""
    assert scenario.world is not None
    settings = {"seed": scenario.seed, "world": scenario.world.model_dump(mode="json")}
    return store.stage("faces", settings, [], FACES_SOURCES)


def run_faces(scenario: Scenario, output: StageFolder) -> None:
    """Paint the walls, once for all processes."""
    started = time.perf_counter()
    assert scenario.world is not None
    write_faces(
        output.path,
        floor_plan(scenario),
        generator(scenario.seed, "textures"),
        scenario.world.texture,
    )
    output.finish(elapsed_s=time.perf_counter() - started)


def stage(
    store: Store, scenario: Scenario, drive: StageFolder, faces: StageFolder, robot: str
) -> StageFolder:
    """Where this robot's features are or will be."""
    resolved = scenario.resolved()
    keep = {"images_at": scenario.keep.images_at, "images": scenario.keep.images}
    vision = {k: v for k, v in resolved["vision"].items() if k in {"harris", "stereo", "usurf"}}
    settings = {"seed": scenario.seed, "robot": robot, "keep": keep, "vision": vision}
    settings |= {
        "camera": resolved["camera"],
        "renderer": renderer_name(scenario.render.renderer),
    }
    settings |= {"radiometry": asdict(scenario.radiometry_of(robot))}
    return store.stage("features", settings, [drive, faces], SOURCES)


def chunks(n_frames: int) -> range:
    """First frames of the chunks."""
    return range(0, n_frames, FRAMES_PER_CHUNK)


def chunk_paths(folder: Path, start: int) -> tuple[Path, Path]:
    """The truth and the features of one chunk; the features are written last."""
    return folder / f"truth_{start:06d}.parquet", folder / f"features_{start:06d}.parquet"


class _OpenWorld:
    """The world this process last rendered from: loading one takes seconds, so it stays open."""

    key: tuple[str, str] | None = None
    source: FrameSource | None = None

    @classmethod
    def get(cls, scenario: Scenario, faces: StageFolder) -> FrameSource:
        key = (
            faces.key,
            scenario.model_dump_json(include={"camera", "radiometry", "render", "robots"}),
        )
        if cls.key != key:
            if cls.source is not None:
                cls.source.close()
            noise = {robot.name: scenario.radiometry_of(robot.name) for robot in scenario.robots}
            renderer = scenario.render.renderer
            cls.source = FrameSource(faces.path, scenario.camera, noise, renderer)
            cls.key = key
        assert cls.source is not None
        return cls.source


def run_chunk(
    scenario: Scenario,
    drive: StageFolder,
    faces: StageFolder,
    output: StageFolder,
    robot: str,
    start: int,
) -> None:
    """Render and extract the frames of one chunk."""
    chunk_started = time.perf_counter()
    trajectory = read_trajectory(drive.path / "trajectory.parquet")
    source = _OpenWorld.get(scenario, faces)
    front_end = FrontEnd(scenario.camera, scenario.vision)
    features: list[Features] = []
    truth: list[Float] = []
    rendering_s = 0.0
    frames = range(start, min(start + FRAMES_PER_CHUNK, len(trajectory)))
    for iteration in frames:
        rng = generator(scenario.seed, "radiometry", robot, iteration)
        poses = trajectory.T_world_robot[:, iteration]
        started = time.perf_counter()
        frame = source.render(poses, robot, rng)
        rendering_s += time.perf_counter() - started
        found = front_end.extract(frame.left, frame.right)
        own_pose = poses[trajectory.index(robot)]
        features.append(found)
        truth.append(truth_points(scenario.camera, frame.depth_m, found.uv_px, own_pose))
        if 0 <= iteration - scenario.keep.images_at < scenario.keep.images:
            _write_image(output.path / f"image_{iteration:06d}.png", frame.left)
    truth_path, features_path = chunk_paths(output.path, start)
    points = np.concatenate(truth)
    write_table(truth_path, {n: points[:, i] for i, n in enumerate(TRUTH.names)}, TRUTH)
    write_table(features_path, _columns(frames, features), FEATURES)
    elapsed_s = time.perf_counter() - chunk_started
    output.note(f"{start:06d}", elapsed_s=elapsed_s, rendering_s=rendering_s)


def finish(output: StageFolder) -> None:
    """Mark the stage as finished once all chunks are there."""
    output.finish(**output.noted())


def _write_image(path: Path, image: np.ndarray) -> None:
    encoded = cv2.imencode(".png", image)[1].tobytes()
    write_whole(path, lambda temporary: temporary.write_bytes(encoded))


def _columns(frames: range, features: list[Features]) -> dict[str, np.ndarray]:
    uv = np.concatenate([f.uv_px for f in features])
    return {
        "iteration": np.repeat(np.array(frames), [len(f) for f in features]),
        "u_px": uv[:, 0],
        "v_px": uv[:, 1],
        "disparity_px": np.concatenate([f.disparity_px for f in features]),
        "sigma_disparity_px": np.concatenate([f.sigma_disparity_px for f in features]),
        "descriptor": np.concatenate([f.descriptor for f in features]),
    }


def read_features(folder: Path, n_frames: int) -> Iterator[tuple[Features, Float]]:
    """Features and their true world points (N, 3), frame by frame, in order."""
    for start in chunks(n_frames):
        truth_path, features_path = chunk_paths(folder, start)
        table, _ = read_table(features_path, FEATURES)
        truth_table, _ = read_table(truth_path, TRUTH)
        truth = np.stack([column(truth_table, name) for name in TRUTH.names], -1)
        iteration = column(table, "iteration")
        uv = np.stack([column(table, "u_px"), column(table, "v_px")], -1)
        disparity, sigma = column(table, "disparity_px"), column(table, "sigma_disparity_px")
        descriptor = column(table, "descriptor")
        for k in range(start, min(start + FRAMES_PER_CHUNK, n_frames)):
            rows = slice(*np.searchsorted(iteration, [k, k + 1]))
            yield (
                Features(uv[rows], disparity[rows], sigma[rows], descriptor[rows]),
                truth[rows],
            )
