"""Stage: physics, all robots in one world, once. Writes the trajectory."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from experiments.run.job import Job
from experiments.run.stages.walls import Walls
from experiments.scenario.randomness import generator
from mapfusion.se2 import Float
from sim.driver import DriverSettings, Route, drive
from sim.trajectory import write_trajectory

TRAJECTORY_FILE = "trajectory.parquet"


@dataclass(frozen=True)
class DrivenRobot:
    """Where a robot starts (x_m, y_m, theta_rad in the world) and which points it visits."""

    name: str
    start: tuple[float, float, float]
    route: tuple[tuple[float, float], ...]
    loop: bool
    tire_friction: float


@dataclass(frozen=True)
class DriveSettings:
    """All that the robots' ways depend on; sensors are no part of it."""

    seed: int
    walls: Walls
    robots: tuple[DrivenRobot, ...]
    frames: int
    frame_interval_s: float
    start_jitter_m: float
    start_jitter_rad: float
    control: DriverSettings


def start_poses(settings: DriveSettings) -> Mapping[str, Float]:
    """T_world_start by robot: the scenario's, moved by the seed within the jitter."""
    span = np.array([settings.start_jitter_m] * 2 + [settings.start_jitter_rad])
    return {
        robot.name: np.array(robot.start)
        + generator(settings.seed, "start", robot.name).uniform(-span, span)
        for robot in settings.robots
    }


def run(settings: DriveSettings, job: Job) -> None:
    """Drive and write the trajectory; raises InputError for a route that fails."""
    starts = start_poses(settings)
    routes = [
        Route(
            robot.name, starts[robot.name], np.array(robot.route), robot.loop, robot.tire_friction
        )
        for robot in settings.robots
    ]
    trajectory = drive(
        settings.walls.floor_plan(),
        routes,
        settings.control,
        settings.frames,
        settings.frame_interval_s,
    )
    write_trajectory(job.output / TRAJECTORY_FILE, trajectory)
