"""The walls that robots may bump into, as far as the physics need to know of them."""

import math
from collections.abc import Sequence

import numpy as np

from mapfusion.se2 import Float
from sim.floorplan import FloorPlan, segment_distance_m
from sim.p3at import OUTER_RADIUS_M, Pose
from sim.world import World

# From the circle that a robot sweeps: PyBullet sees contacts 0.02 m ahead, and a robot goes
# another 0.012 m before it is asked again where it is.
MARGIN_M = 0.1
WITHIN_REACH_M = OUTER_RADIUS_M + MARGIN_M
NEAR_M = WITHIN_REACH_M + 0.1  # a robot takes 0.14 s or more for the difference


class SolidWalls:
    """Puts each wall into a world when a robot first comes near it.

    PyBullet looks at every body in every step, and most walls no robot ever comes near. What
    touches nothing moves nothing: motions are the same, bit for bit, as among all walls.
    """

    def __init__(self, world: World, plan: FloorPlan, n_robots: int) -> None:
        self._world, self._segments = world, plan.segments()
        self._absent = np.ones(len(self._segments[0]), dtype=bool)
        # where each robot was when last looked at, and how far it may go before the next look
        self._free = [(0.0, 0.0, 0.0)] * n_robots

    def stand_near(self, robots: Sequence[Pose]) -> None:
        """Have all walls within reach of the robots, as they are now, stand in the world."""
        for i, (x, y, _) in enumerate(robots):
            x0, y0, free_m = self._free[i]
            if math.hypot(x - x0, y - y0) >= free_m:
                self._free[i] = x, y, self._put_near(np.array([x, y])) - WITHIN_REACH_M

    def _put_near(self, point: Float) -> float:
        """Put in the walls near a point (2,); returns how far (m) the nearest other one is."""
        starts, ends, thickness, height = self._segments
        distance_m = segment_distance_m(point, starts, ends) - thickness / 2
        for i in np.flatnonzero(self._absent & (distance_m < NEAR_M)):
            self._world.add_solid_wall(starts[i], ends[i], thickness[i], height[i])
            self._absent[i] = False
        return np.min(distance_m, initial=math.inf, where=self._absent)
