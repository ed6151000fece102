"""The walls of a world, as stages are told of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.floorplan import FloorPlan, Wall

Look = tuple[str, bool]  # a wall's, and whether it is mirrored


@dataclass(frozen=True)
class Walls:
    """Polylines in world metres, all of one height and thickness."""

    polylines_m: tuple[tuple[tuple[float, float], ...], ...]
    height_m: float
    thickness_m: float

    def floor_plan(self, looks: Sequence[Look] | None = None) -> FloorPlan:
        """As the simulator takes them, with a look each where they are to be seen."""
        lines = [np.array(line) for line in self.polylines_m]
        looks = [("", False)] * len(lines) if looks is None else looks
        size = self.height_m, self.thickness_m
        each = zip(lines, looks, strict=True)
        return FloorPlan(tuple(Wall(line, *size, *look) for line, look in each))
