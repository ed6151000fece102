"""Where the robots are to go, and whether there is room for it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.arguments import require_finite, require_shape
from mapfusion.errors import InputError
from mapfusion.se2 import Float
from sim.floorplan import FloorPlan
from sim.p3at import OUTER_RADIUS_M, TIRE_FRICTION, WIDTH_M


@dataclass(frozen=True)
class Route:
    """Where a robot starts and what it is to visit.

    Attributes:
        robot: its name.
        T_world_start: (3,).
        waypoints_m: (K, 2), visited in order.
        loop: whether it begins again with the first waypoint after the last; else it stands still.
        tire_friction: of the robot's wheels against the ground; low, and they slip.
    """

    robot: str
    T_world_start: Float
    waypoints_m: Float
    loop: bool = False
    tire_friction: float = TIRE_FRICTION

    def __post_init__(self) -> None:
        for name, shape in (("T_world_start", (3,)), ("waypoints_m", (None, 2))):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, values)
            require_shape(name, values, shape)
            require_finite(name, values)
        if len(self.waypoints_m) == 0:
            raise InputError(f"robot {self.robot}: needs at least one waypoint")
        if not 0 < self.tire_friction < np.inf:
            raise InputError(
                f"robot {self.robot}: tire_friction is {self.tire_friction}, must be above 0"
            )


def check_routes(plan: FloorPlan, routes: Sequence[Route]) -> None:
    """Refuse routes that cannot be driven; raises InputError that names robot and place."""
    names = [route.robot for route in routes]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"robot {name}: two robots have this name")
    for route in routes:
        _check_route(plan, route)
    for i, first in enumerate(routes):
        for second in routes[i + 1 :]:
            gap = np.hypot(*(first.T_world_start - second.T_world_start)[:2])
            if gap < 2 * OUTER_RADIUS_M:
                raise InputError(
                    f"robots {first.robot} and {second.robot}: they start {gap:.2f} m apart, "
                    f"at {place(first.T_world_start)}; {2 * OUTER_RADIUS_M:.2f} m are needed"
                )


def _check_route(plan: FloorPlan, route: Route) -> None:
    points = np.concatenate([route.T_world_start[None, :2], route.waypoints_m])
    labels = ["start", *(f"waypoint {i}" for i in range(1, len(points)))]
    on_floor, clearance = plan.contains(points), plan.clearance_m(points)
    for label, point, inside, room in zip(labels, points, on_floor, clearance, strict=True):
        where = f"robot {route.robot}: {label} {place(point)}"
        if not inside:
            raise InputError(f"{where} lies outside the world")
        if room < 0:
            raise InputError(f"{where} lies inside a wall")
        if room < OUTER_RADIUS_M:
            raise InputError(
                f"{where} is {room:.2f} m from a wall, turning needs {OUTER_RADIUS_M:.2f} m"
            )
    ends = list(range(1, len(points))) + ([1] if route.loop else [])
    starts = list(range(len(ends)))
    for start, end in zip(starts, ends, strict=True):
        room = plan.leg_clearance_m(points[start], points[end])
        where = (
            f"robot {route.robot}: the way from {labels[start]} {place(points[start])} "
            f"to {labels[end]} {place(points[end])}"
        )
        if room < 0:
            raise InputError(f"{where} leads through a wall")
        if room < WIDTH_M / 2:
            raise InputError(
                f"{where} passes a wall at {room:.2f} m, the robot needs {WIDTH_M / 2:.2f} m"
            )


def place(point: ArrayLike) -> str:
    """A point (2,) or pose (3,) as people read it: `(x, y)` in metres."""
    x, y = np.asarray(point)[:2]
    return f"({x:.2f}, {y:.2f})"
