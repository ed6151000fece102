"""Stages `faces` and `drive`: painted walls, and the robots' motion in one physical world."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.pipeline.stage import Job, StageKind
from mapfusion.errors import InputError
from mapfusion.geometry.numerics import generator
from sim.driver import DriverSettings, drive, require_drivable
from sim.floorplan import FloorPlan, Wall
from sim.routes import Route
from sim.textures import Texture
from sim.trajectory import TRAJECTORY_FILE, BodySway, Trajectory, write_trajectory
from sim.world import write_faces

Look = tuple[str, bool]  # look of a wall, and True if the wall is mirrored


@dataclass(frozen=True)
class Walls:
    """Walls as polylines in world metres, all of the same height and thickness."""

    polylines_m: tuple[tuple[tuple[float, float], ...], ...]
    height_m: float
    thickness_m: float

    def floor_plan(self, looks: Sequence[Look] | None = None) -> FloorPlan:
        """Return the simulator's floor plan, with looks if the walls are rendered."""
        lines = [np.array(line) for line in self.polylines_m]
        looks = [("", False)] * len(lines) if looks is None else looks
        size = self.height_m, self.thickness_m
        walls = list[Wall]()
        for i, (line, look) in enumerate(zip(lines, looks, strict=True)):
            try:
                walls.append(Wall(line, *size, *look))
            except InputError as error:
                raise InputError(f"world.walls.{i}.points: {error}") from error
        return FloorPlan(tuple(walls))


@dataclass(frozen=True)
class FacesSettings:
    """Settings of the painted faces."""

    seed: int
    walls: Walls
    looks: tuple[Look, ...]
    texture: Texture


def run_faces(settings: FacesSettings, job: Job) -> None:
    """Write meshes and textures."""
    rng = generator(settings.seed, "textures")
    plan = settings.walls.floor_plan(settings.looks)
    write_faces(job.output, plan, rng, settings.texture)


FACES_STAGE = StageKind("faces", "paint the walls", run_faces)


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


def run_drive(settings: DriveSettings, job: Job) -> None:
    """Drive the robots and write the trajectory."""
    write_trajectory(job.output / TRAJECTORY_FILE, drive_robots(settings))


DRIVE_STAGE = StageKind("drive", "drive the robots", run_drive, (TRAJECTORY_FILE,))


def _routes(settings: DriveSettings) -> list[Route]:
    """Return the routes of all robots, with random jitter of the starts."""
    span = np.array([settings.start_jitter_m] * 2 + [settings.start_jitter_rad])
    routes = []
    for robot in settings.robots:
        jitter = generator(settings.seed, "start", robot.name).uniform(-span, span)
        start, route = np.array(robot.start) + jitter, np.array(robot.route)
        planned_m = robot.start[:2] if settings.start_jitter_m else None
        own = robot.loop, robot.tire_friction, planned_m
        routes.append(Route(robot.name, start, route, *own))
    return routes


def require_drive(settings: DriveSettings) -> None:
    """Raise InputError for a world that `drive_robots` refuses before the robots drive."""
    require_drivable(settings.walls.floor_plan(), _routes(settings), settings.frame_interval_s)


def drive_robots(settings: DriveSettings) -> Trajectory:
    """Drive the robots from starts with random jitter, and add body sway.

    Raises:
        InputError: a robot cannot follow its route.
    """
    plan, interval_s = settings.walls.floor_plan(), settings.frame_interval_s
    trajectory = drive(plan, _routes(settings), settings.control, settings.frames, interval_s)
    if settings.body_sway.sigma_rad:
        tilts = [
            settings.body_sway.tilts(trajectory.time_s, generator(settings.seed, "sway", robot))
            for robot in trajectory.robots
        ]
        trajectory = replace(trajectory, tilt_rad=np.stack(tilts))
    return trajectory
