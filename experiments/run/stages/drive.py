"""Stage: physics, all robots in one world, once. Writes the trajectory."""

import time

import numpy as np

from experiments.run.store import StageFolder, Store
from experiments.scenario.randomness import generator
from experiments.scenario.settings import Scenario
from mapfusion.errors import InputError
from mapfusion.se2 import Float
from sim.driver import Route, drive
from sim.floorplan import FloorPlan, Wall
from sim.trajectory import write_trajectory

SOURCES = ("sim", "mapfusion/se2.py", "mapfusion/storage.py")
SOURCES += ("experiments/run/stages/drive.py", "experiments/scenario/randomness.py")

_SENSORS = {"odometry", "radiometry"}  # of a robot; its way does not depend on them


def floor_plan(scenario: Scenario) -> FloorPlan:
    """The scenario's walls as the simulator takes them."""
    world = scenario.world
    assert world is not None
    return FloorPlan(
        tuple(
            Wall(np.array(wall.points), world.wall_height_m, world.wall_thickness_m)
            for wall in world.walls
        )
    )


def start_poses(scenario: Scenario) -> dict[str, Float]:
    """T_world_start by robot: the scenario's, moved by the seed within the jitter."""
    drive_settings = scenario.drive
    assert drive_settings is not None
    span = np.array([drive_settings.start_jitter_m] * 2 + [drive_settings.start_jitter_rad])
    return {
        robot.name: np.array(robot.start)
        + generator(scenario.seed, "start", robot.name).uniform(-span, span)
        for robot in scenario.robots
    }


def stage(store: Store, scenario: Scenario) -> StageFolder:
    """Where the trajectory is or will be."""
    world, drive_settings = scenario.world, scenario.drive
    assert world is not None
    assert drive_settings is not None
    settings = {
        "seed": scenario.seed,
        "world": world.model_dump(mode="json", exclude={"texture"}),
        "robots": [robot.model_dump(mode="json", exclude=_SENSORS) for robot in scenario.robots],
        "drive": drive_settings.model_dump(mode="json"),
    }
    return store.stage("drive", settings, [], SOURCES)


def run(scenario: Scenario, output: StageFolder) -> None:
    """Drive and write `trajectory.parquet`; raises InputError for a route that fails."""
    started = time.perf_counter()
    drive_settings = scenario.drive
    assert drive_settings is not None
    starts = start_poses(scenario)
    routes = [
        Route(
            robot.name, starts[robot.name], np.array(robot.route), robot.loop, robot.tire_friction
        )
        for robot in scenario.robots
    ]
    try:
        trajectory = drive(
            floor_plan(scenario),
            routes,
            drive_settings.control,
            drive_settings.frames,
            drive_settings.frame_interval_s,
        )
    except InputError as error:
        raise InputError(f"scenario {scenario.name}: {error}") from error
    write_trajectory(output.path / "trajectory.parquet", trajectory)
    output.finish(elapsed_s=time.perf_counter() - started)
