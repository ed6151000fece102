import math

import numpy as np
import pytest

from sim import driver
from sim.driver import NEAR_M, WITHIN_REACH_M, DriverSettings, SolidWalls, drive
from sim.floorplan import FloorPlan, Wall, segment_distance_m
from sim.routes import Route
from sim.world import World

HALL = FloorPlan(
    (
        Wall(np.array([[0, 0], [8, 0], [8, 6], [0, 6], [0, 0]])),
        Wall(np.array([[4, 0], [4, 2]]), thickness_m=0.3),
    )
)


Place = tuple[float, float]
MIDDLES: list[Place] = [
    (float(x), float(y)) for x, y in np.mean(HALL.segments()[:2], axis=0)
]  # no two alike


def standing(world: World) -> set[Place]:
    """Where the walls' middles are."""
    p, client = world.bullet, world.client
    bodies = range(p.getNumBodies(physicsClientId=client))
    places = [p.getBasePositionAndOrientation(body, physicsClientId=client)[0] for body in bodies]
    return {(x, y) for x, y, _ in places}


def test_what_is_within_reach_stands_and_what_never_was_near_does_not() -> None:
    rng = np.random.default_rng(0)
    starts, ends, thickness, _ = HALL.segments()
    numbers = set()
    for step_m in (0.01, 0.02, 0.05, 3.0):
        with World() as world:
            walls = SolidWalls(world, HALL, 2)
            poses, was_near = np.array([[0.8, 3.0, 0.0], [6.0, 5.2, 0.0]]), set()
            for _ in range(200):
                poses[:, :2] = (poses[:, :2] + rng.normal(0, step_m, (2, 2))).clip(
                    0.47, [7.53, 5.53]
                )
                walls.stand_near([(x, y, theta) for x, y, theta in poses.tolist()])
                away_m = segment_distance_m(poses[:, None, :2], starts, ends) - thickness / 2
                there = standing(world)
                for middle, nearest_m in zip(MIDDLES, away_m.min(axis=0), strict=True):
                    if nearest_m < NEAR_M:
                        was_near.add(middle)
                    assert nearest_m > WITHIN_REACH_M or middle in there
                assert there <= was_near
            numbers.add(len(there))
    assert min(numbers) < len(MIDDLES) == max(numbers)


def test_motions_are_those_among_all_walls(monkeypatch: pytest.MonkeyPatch) -> None:
    routes = [
        Route("a", np.array([1, 1, 0.5]), np.array([[1, 3], [6, 3], [6, 1]])),
        Route("b", np.array([6, 5, 3.0]), np.array([[1, 5.2], [6, 5]]), loop=True),
    ]
    among_near = drive(HALL, routes, DriverSettings(), 120, 0.2)
    monkeypatch.setattr(driver, "NEAR_M", math.inf)
    among_all = drive(HALL, routes, DriverSettings(), 120, 0.2)
    np.testing.assert_array_equal(among_near.T_world_robot, among_all.T_world_robot)
    np.testing.assert_array_equal(among_near.wheel_rad, among_all.wheel_rad)
