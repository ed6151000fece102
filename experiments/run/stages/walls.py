"""The walls of a world, as stages are told of them."""

from dataclasses import dataclass

import numpy as np

from sim.floorplan import FloorPlan, Wall


@dataclass(frozen=True)
class Walls:
    """Polylines in world metres, all of one height and thickness."""

    polylines_m: tuple[tuple[tuple[float, float], ...], ...]
    height_m: float
    thickness_m: float

    def floor_plan(self) -> FloorPlan:
        """As the simulator takes them."""
        lines = map(np.array, self.polylines_m)
        return FloorPlan(tuple(Wall(line, self.height_m, self.thickness_m) for line in lines))
