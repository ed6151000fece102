"""Export of simulated drives as datasets: images, wheel odometry and the truth."""

from pathlib import Path

import numpy as np

from experiments.evaluation.evaluated_run import JudgedRun
from experiments.evaluation.single_steps import require_simulation
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.drive import TRAJECTORY_FILE
from experiments.pipeline.stages.features import render_frame
from experiments.pipeline.stages.log import measured_odometry
from experiments.pipeline.stages.observed import told_tilt
from experiments.pipeline.stages.pipeline import SimulatedRobotStages
from experiments.pipeline.store import Store, retry_damaged
from experiments.pipeline.tasks import OnProgress
from experiments.scenario.settings import AnyScenario
from mapfusion.datasets.export import StereoDrive
from mapfusion.datasets.formats import EXPORTERS, export_drive
from mapfusion.errors import InputError
from sim.rendering.frame_source import FrameSource
from sim.trajectory import Trajectory, read_trajectory


def write_drives(
    scenario: AnyScenario,
    format_name: str,
    output: Path,
    results: Path,
    jobs: int,
    on_progress: OnProgress,
) -> list[Path]:
    """Simulate, and write what each robot sees into `output`; returns what can be imported.

    Raises:
        InputError: an unknown format, or a scenario of recorded logs.
    """
    if format_name not in EXPORTERS:
        known = ", ".join(["log", *EXPORTERS])
        raise InputError(f"--format {format_name}: unknown; known: {known}")
    require_simulation(scenario)
    run = JudgedRun.of(scenario, Store.of(results))
    robots = run.pipeline.simulated
    driven, painted = (_before(robots[0], name) for name in ("drive", "faces"))
    retry_damaged(run.store, lambda: run.execute(jobs, on_progress, [driven, painted]))
    trajectory = read_trajectory(run.store.path(driven) / TRAJECTORY_FILE)
    settings = robots[0].features.settings  # camera and renderer are all robots'
    world = (run.store.path(painted), settings.camera, trajectory.robots, settings.renderer)
    written = []
    with FrameSource(*world) as source:
        for robot in robots:
            label = f"{robot.name}: write {format_name}"
            drive = _drive_of(robot, trajectory, source)
            written += export_drive(
                format_name, output, drive, lambda done, n, label=label: on_progress(label, done, n)
            )
    return written


def _before(robot: SimulatedRobotStages, name: str) -> Stage:
    stage = robot.features.before[name]
    assert isinstance(stage, Stage)
    return stage


def _drive_of(
    robot: SimulatedRobotStages, trajectory: Trajectory, source: FrameSource
) -> StereoDrive:
    def pair(k: int) -> tuple[np.ndarray, np.ndarray]:
        frame = render_frame(robot.features.settings, source, trajectory.bodies(k), k)
        return frame.left, frame.right

    index, tilts = trajectory.index(robot.name), trajectory.tilt_rad
    return StereoDrive(
        robot.name,
        robot.features.settings.camera,
        trajectory.time_s,
        trajectory.T_world_robot[index],
        measured_odometry(robot.log.settings, trajectory),
        pair,
        None if tilts is None else tilts[index],
        told_tilt(robot.observed.settings, trajectory),
    )
