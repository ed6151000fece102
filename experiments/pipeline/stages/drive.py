"""Stage: drive all robots in one physical world and write the trajectory."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.faces import Walls
from experiments.scenario.seeds import generator
from sim.driver import DriverSettings, Route, drive
from sim.trajectory import BodySway, Trajectory, write_trajectory

LABEL = "drive the robots"
TRAJECTORY_FILE = "trajectory.parquet"
WRITES = (TRAJECTORY_FILE,)


@dataclass(frozen=True)
class DrivenRobot:
    """Start pose (x_m, y_m, theta_rad in the world) and waypoints of a robot."""

    name: str
    start: tuple[float, float, float]
    route: Sequence[tuple[float, float]]
    loop: bool
    tire_friction: float


@dataclass(frozen=True)
class DriveSettings:
    """Settings of the robots' motion, without sensors."""

    seed: int
    walls: Walls
    robots: tuple[DrivenRobot, ...]
    frames: int
    frame_interval_s: float
    start_jitter_m: float
    start_jitter_rad: float
    control: DriverSettings
    body_sway: BodySway


def run(settings: DriveSettings, job: Job) -> None:
    """Drive the robots and write the trajectory."""
    write_trajectory(job.output / TRAJECTORY_FILE, drive_robots(settings))


def drive_robots(settings: DriveSettings) -> Trajectory:
    """Drive the robots from starts with random jitter, and add body sway.

    Raises:
        InputError: a robot cannot follow its route.
    """
    span = np.array([settings.start_jitter_m] * 2 + [settings.start_jitter_rad])
    routes = []
    for robot in settings.robots:
        jitter = generator(settings.seed, "start", robot.name).uniform(-span, span)
        start, route = np.array(robot.start) + jitter, np.array(robot.route)
        routes.append(Route(robot.name, start, route, robot.loop, robot.tire_friction))
    plan, interval_s = settings.walls.floor_plan(), settings.frame_interval_s
    trajectory = drive(plan, routes, settings.control, settings.frames, interval_s)
    if settings.body_sway.sigma_rad:
        tilts = [
            settings.body_sway.tilts(trajectory.time_s, generator(settings.seed, "sway", robot))
            for robot in trajectory.robots
        ]
        trajectory = replace(trajectory, tilt_rad=np.stack(tilts))
    return trajectory
