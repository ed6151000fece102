"""Kernels compiled before the work begins, each by one process.

Processes that begin on parts of one stage compile its kernels all of them, at the same time. Where
few are compiled yet, small runs of the same stages go first, in processes of their own: one from a
world to robots' logs, the other from made-up logs to fused maps. What they find is thrown away.
"""

import os
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.pipeline.code_version import PACKAGES, SOURCE_ROOT, kernel_folder
from experiments.pipeline.pipeline import lay_out
from experiments.pipeline.stage import Stage, with_those_before
from experiments.pipeline.store import Store
from experiments.pipeline.tasks import Task, tasks_of
from experiments.scenario.settings import Recording, Simulation
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, rotation
from mapfusion.robot_log import Observations, RobotLog, write_log

LABEL = "compile kernels"
# Of the modules with kernels, from which on a rehearsal is worth its seconds: what a change of one
# or two has made outdated is compiled sooner by those who need it.
_MISSING_SHARE = 0.5
_IN_NO_RUN = "experiments/studies"
_PICTURES = ("sim", "mapfusion/vision")
_RAY_CASTER = "sim/raycast"
# Robots that see each other, in a room that a few small pictures show.
_WORLD = {"walls": [{"points": [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]]}]}
_ROBOTS = [
    {"name": "R1", "start": [1.2, 1.2, 0.6], "route": [[4.8, 1.2], [4.8, 2.8]]},
    {"name": "R2", "start": [3.2, 2.8, -2.4], "route": [[1.2, 2.8], [1.2, 1.6]]},
]
_CAMERA = {"width_px": 160, "height_px": 120, "focal_px": 144.25}
_FRAMES = 8

# A circle and a bit among landmarks: loops are closed, and both robots see the same.
_LOG_FRAMES, _STEP = 90, np.array([0.08, 0.0, 0.08])  # m, m and rad a frame
_LANDMARKS, _ROOM_M, _TOP_M = 300, 8.0, 2.0
_HALF_VIEW_RAD, _RANGE_M, _SIGMA_M = 0.5, 4.0, 0.01
_STARTS = {"R1": [3.0, 3.0, 0.0], "R2": [4.0, 3.5, 1.5]}  # x and y in m, heading in rad
_PARTICLES = 10


def rehearsals(scenario: Simulation | Recording, left: Iterable[Task]) -> list[Task]:
    """What to run before the tasks that are left, so that their kernels are compiled once.

    Nothing for recordings: of their stages all but the first tasks wait for others.
    """
    stages = {task.name.partition("/")[0] for task in left}
    if isinstance(scenario, Recording) or not {"features", "slam", "match"} <= stages:
        return []
    drawn = [path for path in _with_kernels() if _is_in(path, _PICTURES)]
    if scenario.render.renderer != "raycast":
        drawn = [path for path in drawn if not _is_in(path, [_RAY_CASTER])]
    mapped = [path for path in _with_kernels() if not _is_in(path, [*_PICTURES, _IN_NO_RUN])]
    found = []
    for name, work, files in (
        ("pictures", rehearse_pictures, drawn),
        ("maps", rehearse_maps, mapped),
    ):
        if _is_worth_it(files):
            found.append(Task(f"rehearsal/{name}", LABEL, work, (scenario,), ()))
    return found


def rehearse_pictures(scenario: Simulation) -> None:
    """From a world to a robot's log, with the scenario's renderer and front end."""
    small = {"schema_version": 1, "name": "rehearsal", "world": _WORLD, "robots": _ROBOTS}
    same = {name: getattr(scenario, name) for name in ("render", "vision", "radiometry")}
    sway = scenario.drive.body_sway
    drive = {"frames": _FRAMES, "start_jitter_m": 0, "start_jitter_rad": 0, "body_sway": sway}
    run = lay_out(Simulation.model_validate(small | same | {"drive": drive, "camera": _CAMERA}))
    _run([run.simulated[0].log])


def rehearse_maps(scenario: Simulation) -> None:
    """From two made-up logs to fused maps, with the scenario's filter."""
    with tempfile.TemporaryDirectory() as folder:
        logs = [str(Path(folder) / name) for name in _STARTS]
        for log, start in zip(logs, _STARTS.values(), strict=True):
            write_log(Path(log), _made_up_log(Path(log).name, np.array(start)))
        few = replace(scenario.slam.filter, n_particles=_PARTICLES)
        half = {"every": _LOG_FRAMES // 2}
        settings = {"slam": {"filter": few}, "align": {"repetitions": 1}, "evaluate": half}
        settings |= {"schema_version": 1, "name": "rehearsal", "fuse": half, "logs": logs}
        _run(lay_out(Recording.model_validate(settings)).stages())


def _run(stages: Iterable[Stage]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for task in tasks_of(with_those_before(list(stages)), Store.of(Path(folder))).values():
            task.run()


def _made_up_log(robot: str, start: Float) -> RobotLog:
    """Of a robot that drives a circle from `start` in a world that is the same for all."""
    world, own = np.random.default_rng(0), np.random.default_rng(1)
    point_m = world.uniform(0, [_ROOM_M, _ROOM_M, _TOP_M], (_LANDMARKS, 3))
    descriptor = world.standard_normal((_LANDMARKS, 64))
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    pose, seen, position = start, [], []
    for _ in range(_LOG_FRAMES):
        at = point_m.copy()
        at[:, :2] = (at[:, :2] - pose[:2]) @ rotation(pose[2])
        range_m, bearing_rad = np.hypot(at[:, 0], at[:, 1]), np.arctan2(at[:, 1], at[:, 0])
        seen.append(np.flatnonzero((np.abs(bearing_rad) < _HALF_VIEW_RAD) & (range_m < _RANGE_M)))
        position.append(at[seen[-1]])
        pose = compose(pose, _STEP)
    landmark, exact = np.concatenate(seen), np.concatenate(position)
    n, odometry = len(landmark), np.tile(_STEP, (_LOG_FRAMES, 1))
    odometry[0] = 0.0
    observations = Observations(
        exact + _SIGMA_M * own.standard_normal((n, 3)),
        np.tile(_SIGMA_M**2 * np.eye(3), (n, 1, 1)),
        descriptor[landmark].astype(np.float32),
        uvd_px=np.ones((n, 3), np.float32),
        track=landmark.astype(np.int32),
    )
    frame = np.repeat(np.arange(_LOG_FRAMES), [len(each) for each in seen])
    time_s = np.arange(_LOG_FRAMES, dtype=np.float64)
    return RobotLog(robot, False, time_s, odometry, frame, observations)


def _with_kernels() -> list[Path]:
    files = (path for package in PACKAGES for path in (SOURCE_ROOT / package).rglob("*.py"))
    return [path for path in files if b"from mapfusion.geometry.numerics" in path.read_bytes()]


def _is_in(path: Path, folders: Iterable[str]) -> bool:
    return any(path.is_relative_to(SOURCE_ROOT / folder) for folder in folders)


def _is_worth_it(files: list[Path]) -> bool:
    root = os.environ.get("NUMBA_CACHE_DIR")
    if not root:
        return False
    missing = [path for path in files if not any(kernel_folder(Path(root), path).glob("*.nbi"))]
    return len(missing) > _MISSING_SHARE * len(files)
