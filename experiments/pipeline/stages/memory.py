"""Memory that a run will need, estimated before the run starts.

Estimates are upper bounds of the parts that grow with the settings, accurate to a factor of about
two. They detect mistyped settings.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow.parquet as pq

from experiments.pipeline.stage import RecordedLog
from experiments.pipeline.stages.pipeline import Pipeline, RobotStages
from experiments.scenario.settings import Scenario, SimulatedScenario, Simulation
from mapfusion.errors import InputError
from mapfusion.tables import is_csv, table_path
from sim.textures import STYLES

_GB = 1e9
_PROCESS_BYTES = 300e6  # worker with numerical libraries and compiled kernels
# A landmark has a mean (3 numbers), a covariance (6) and a count for each particle, and a slot with
# a descriptor. The factor 1.5 is for the old half while arrays are doubled.
_ROW_BYTES, _SLOT_BYTES = 1.5 * (9 * 8 + 4), 1.5 * 400
# Share of the corners of a frame that become new landmarks: 0.5 to 2 % in the suite.
_NEW_SHARE = 0.02
_POSE_BYTES = 3 * 8 + 4  # per particle and frame: pose and ancestor
_ASSOCIATION_BYTES = 4  # per particle and observation: landmark
# Both are stored for all M particles only since their common ancestor. That is at most 2 M
# resamplings ago on average, with ten frames or more between two resamplings.
_FRAMES_A_PARTICLE = 30
# Observation of a log: position, covariance, descriptor, label, pixels, frame.
_OBSERVATION_BYTES = 3 * 8 + 9 * 8 + 64 * 4 + 4 + 3 * 4 + 4
# Two images with depth, noise and corner responses need 60 to 80 bytes per pixel.
_PIXEL_BYTES = 100
# The renderer's copy of a texel, and the memory per texel while a face is painted.
_TEXEL_BYTES, _PAINTED_BYTES = 4, 20
# A landmark of an evaluated map has twelve numbers, and a copy while it is written.
_EVALUATED_BYTES = 2 * 12 * 8
_CGROUP_LIMITS = ("memory.max", "memory/memory.limit_in_bytes")  # cgroup version 2 and 1


@dataclass(frozen=True)
class Need:
    """Memory of one process, and the setting on which it depends."""

    n_bytes: float
    setting: str
    why: str


def require_memory(pipeline: Pipeline, jobs: int, machine_bytes: float | None = None) -> None:
    """Raise InputError, naming the setting, if the machine has less memory than the run needs.

    `machine_bytes` is the memory of the machine; None: that of this machine.
    """
    has = memory_bytes() if machine_bytes is None else machine_bytes
    need = max(needs(pipeline), key=lambda need: need.n_bytes)
    wanted = jobs * process_bytes(pipeline)
    if wanted > has:
        processes = f" in each of {jobs} processes (--jobs 1 needs least)" if jobs > 1 else ""
        raise InputError(
            f"{need.setting}: {need.why} take about {need.n_bytes / _GB:.1f} GB{processes}, this "
            f"machine has {has / _GB:.1f} GB"
        )


def process_bytes(pipeline: Pipeline) -> float:
    """Return the memory of a process that does the largest task of a run, in bytes."""
    return _PROCESS_BYTES + max(need.n_bytes for need in needs(pipeline))


def needs(pipeline: Pipeline) -> Iterator[Need]:
    """Yield the memory of the tasks that need most.

    The smoother's memory depends on the log and is bounded later, by
    `smooth.max_memory_gb` (`mapfusion.smoother.elimination.memory_bytes`).
    """
    scenario = pipeline.scenario
    for robot in pipeline.robots:
        yield from _of_filter(scenario, robot)
    if isinstance(scenario, Simulation):
        camera = scenario.camera
        pixels = camera.width_px * camera.height_px
        why = f"images of {camera.width_px} x {camera.height_px} pixels"
        yield Need(_PIXEL_BYTES * pixels, "camera.width_px", why)
        yield _of_textures(scenario)


def _of_filter(scenario: Scenario, robot: RobotStages) -> Iterator[Need]:
    """Yield the memory of the filter with its log, and of the evaluated maps."""
    settings = scenario.slam.filter
    n_frames = n_observations = robot.n_frames
    where = "drive.frames"
    if isinstance(robot.log, RecordedLog):
        path = table_path(robot.log.path, "observations")
        if is_csv(path):
            with path.open("rb") as file:
                n_observations = max(sum(1 for _ in file) - 1, 0)
        else:
            n_observations = pq.read_metadata(path).num_rows
        where = "logs"
    elif isinstance(scenario, SimulatedScenario):
        n_observations = n_frames * scenario.vision.harris.max_corners
    n_landmarks, late = _NEW_SHARE * n_observations, 1.0  # share of frames with distinct particles
    if settings.resample_fraction > 0:
        late = min(1.0, _FRAMES_A_PARTICLE * settings.n_particles / max(n_frames, 1))
    a_particle = late * (
        n_landmarks * _ROW_BYTES + n_observations * _ASSOCIATION_BYTES + n_frames * _POSE_BYTES
    )
    once = n_observations * _OBSERVATION_BYTES + n_landmarks * _SLOT_BYTES
    of_particles = settings.n_particles * a_particle
    setting = "slam.filter.n_particles" if of_particles > once else where
    why = f"{n_observations} observations in {n_frames} frames"
    yield Need(of_particles + once, setting, f"{settings.n_particles} particles with {why}")
    # maps grow from zero, so their mean size is half that of the last one
    n_rows = n_frames / scenario.evaluate.every * n_landmarks / 2
    often = f"maps each {scenario.evaluate.every} of {n_frames} frames"
    yield Need(n_rows * _EVALUATED_BYTES, "evaluate.every", often)


def _of_textures(scenario: Simulation) -> Need:
    """Return the memory of the textures of all walls (two sides each), floor and ceiling."""
    world = scenario.world
    corners = [point for wall in world.walls for point in wall.points]
    wide, deep = (max(axis) - min(axis) for axis in zip(*corners, strict=True))
    lengths = [
        ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
        for wall in world.walls
        for (x0, y0), (x1, y1) in zip(wall.points, wall.points[1:], strict=False)
    ]
    upright, level = STYLES["wall"].texels_per_m ** 2, STYLES["floor"].texels_per_m ** 2
    faces = [2 * length * world.wall_height_m * upright for length in lengths]
    plans = [2 * wide * deep * level]
    painted = max(max(faces), *plans) / 2
    n_bytes = _TEXEL_BYTES * (sum(faces) + sum(plans)) + _PAINTED_BYTES * painted
    why = f"walls of {sum(lengths):.0f} m around {wide:.0f} m x {deep:.0f} m, painted,"
    return Need(n_bytes, "world.walls", why)


def memory_bytes() -> float:
    """Return the total memory of this machine, or of the container of this process."""
    has = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for name in _CGROUP_LIMITS:
        try:
            has = min(has, float((Path("/sys/fs/cgroup") / name).read_text()))
        except (OSError, ValueError):  # no limit; "max" means no limit either
            continue
    return has
