"""Robots without physics: they go as their wheels turn, and nothing but each other stops them.

In place of PyBullet's world a drive takes a hundredth of the time. Tracks and heights of bodies are
not those of the physics, but where robots wait for each other is nearly the same.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self
from unittest.mock import patch

import numpy as np

from mapfusion.geometry.numerics import Float
from sim.p3at import SKID_TRACK_M, WHEEL_RADIUS_M, WIDTH_M, Pose
from sim.world import PHYSICS_HZ


class _World:
    """Holds the robots; stands in for `sim.world.World`."""

    def __init__(self) -> None:
        self.robots: list[_Robot] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def start_physics(self) -> int:
        return 0

    def step(self, n: int) -> None:
        for robot in self.robots:
            robot.step(n / PHYSICS_HZ)


class _Robot:
    """Stands in for `sim.p3at.P3at`."""

    def __init__(self, world: _World, T_world_robot: Float, tire_friction: float) -> None:
        del tire_friction
        world.robots.append(self)
        self._world, self.body = world, len(world.robots)
        self._x, self._y, self._theta = map(float, T_world_robot)
        self._rad_s = self._rad = np.zeros(2)

    def drive(self, left_rad_s: float, right_rad_s: float) -> None:
        self._rad_s = np.array([left_rad_s, right_rad_s])

    def step(self, elapsed_s: float) -> None:
        left_m, right_m = (self._rad_s * (WHEEL_RADIUS_M * elapsed_s)).tolist()
        self._rad = self._rad + self._rad_s * elapsed_s
        self._x += (left_m + right_m) / 2 * math.cos(self._theta)
        self._y += (left_m + right_m) / 2 * math.sin(self._theta)
        turned = self._theta + (right_m - left_m) / SKID_TRACK_M
        self._theta = math.atan2(math.sin(turned), math.cos(turned))

    def pose(self) -> Pose:
        return self._x, self._y, self._theta

    def wheel_angles(self) -> Float:
        return self._rad

    def touched_bodies(self) -> set[int]:
        """Those whose middles are nearer than two robots side by side."""
        near = (
            each
            for each in self._world.robots
            if each is not self and math.dist(each.pose()[:2], self.pose()[:2]) < WIDTH_M
        )
        return {each.body for each in near}


class _NoWalls:
    """Stands in for `sim.driver.SolidWalls`."""

    def __init__(self, *_: object) -> None:
        pass

    def stand_near(self, robots: object) -> None:
        pass


@contextmanager
def wheels_alone() -> Iterator[None]:
    """Within the `with` block `sim.driver.drive` knows no physics."""
    with (
        patch("sim.driver.World", _World),
        patch("sim.driver.P3at", _Robot),
        patch("sim.driver.SolidWalls", _NoWalls),
    ):
        yield
