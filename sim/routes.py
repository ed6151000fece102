"""Routes of the robots: checks of free space, and right of way between robots.

Robots follow their routes and stop for each other, so two that meet head-on in a door would stand
there for ever. `sim.driver` then drives anew from the start, with one more constraint: a robot of
the circle holds on its way, before it comes into the way of the others, until these have passed.
This is repeated for each further circle, as conflict-based search does for planned paths (Sharon,
Stern, Felner and Sturtevant, 2015, Artificial Intelligence 219); the drive itself tells the
conflicts. Of a circle the robot that is listed last holds if its way so far has a place for that,
else the one listed before it, and so on.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import require_finite, require_shape
from sim.floorplan import FloorPlan, segment_distance_m
from sim.p3at import OUTER_RADIUS_M, TIRE_FRICTION, WIDTH_M, Pose


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
                    f"at {format_point(first.T_world_start)}; {2 * OUTER_RADIUS_M:.2f} m are needed"
                )


def _check_route(plan: FloorPlan, route: Route) -> None:
    points = np.concatenate([route.T_world_start[None, :2], route.waypoints_m])
    labels = ["start", *(f"waypoint {i}" for i in range(1, len(points)))]
    on_floor, clearance = plan.contains(points), plan.clearance_m(points)
    for label, point, inside, room in zip(labels, points, on_floor, clearance, strict=True):
        where = f"robot {route.robot}: {label} {format_point(point)}"
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
            f"robot {route.robot}: the way from {labels[start]} {format_point(points[start])} "
            f"to {labels[end]} {format_point(points[end])}"
        )
        if room < 0:
            raise InputError(f"{where} leads through a wall")
        if room < WIDTH_M / 2:
            raise InputError(
                f"{where} passes a wall at {room:.2f} m, the robot needs {WIDTH_M / 2:.2f} m"
            )


def format_point(point: ArrayLike) -> str:
    """A point (2,) or pose (3,) as people read it: `(x, y)` in metres."""
    x, y = np.asarray(point)[:2]
    return f"({x:.2f}, {y:.2f})"


# An earlier place to hold at is so far before the one that was tried: less changes nothing.
_STEP_BACK_M = 0.25
# Nearer than this to the way of another robot, one that holds would be touched by its circle.
_LEAST_CLEARANCE_M = 2 * OUTER_RADIUS_M
_MOST_LEGS = 8  # of a way that leads past the others; a rectangle's loop has four


class Progress(NamedTuple):
    """Progress of a robot: waypoints visited since the start, and minus the metres to go."""

    visited: int
    minus_left_m: float


class Passage(NamedTuple):
    """Condition that a holding robot waits for.

    Attributes:
        robot: the one that is to pass, by its place in the list.
        beyond: where it stood when all waited for each other; it has passed once it is farther.
        from_m: (x, y) where the holding robot stood then; and once it is away from there.
    """

    robot: int
    beyond: Progress
    from_m: tuple[float, float]


class Hold(NamedTuple):
    """A robot stands from a place on its way on until others have passed.

    Attributes:
        robot: by its place in the list.
        at: from there on.
        passages: of the others.
    """

    robot: int
    at: Progress
    passages: tuple[Passage, ...]


@dataclass
class DriveRecord:
    """Record of one robot's drive so far, frame by frame.

    Attributes:
        position_m: (x, y).
        progress: how far it had come.
        stopping_m: how far it would have rolled on if told to stop.
    """

    position_m: list[tuple[float, float]] = field(default_factory=list)
    progress: list[Progress] = field(default_factory=list)
    stopping_m: list[float] = field(default_factory=list)

    def add(self, pose: Pose, progress: Progress, stopping_m: float) -> None:
        """Add one frame."""
        self.position_m.append(pose[:2])
        self.progress.append(progress)
        self.stopping_m.append(stopping_m)


class ActiveHold:
    """A hold as one drive keeps it: once begun it lasts until all have passed, and only once."""

    def __init__(self, hold: Hold) -> None:
        self._hold, self._to_pass, self._begun = hold, list(hold.passages), False

    def waits_for(
        self, came: Sequence[Progress], now: Sequence[Pose], clearance_m: float
    ) -> set[int]:
        """The robots that it has its own wait for, given how far all have come and where they are.

        One has passed that is farther than it stood in the circle, and away from where the holding
        robot stood.
        """
        self._to_pass = [
            each
            for each in self._to_pass
            if came[each.robot] <= each.beyond
            or math.dist(now[each.robot][:2], each.from_m) < clearance_m
        ]
        self._begun |= came[self._hold.robot] >= self._hold.at
        return {each.robot for each in self._to_pass} if self._begun else set()


def find_deadlock(waits_for: Mapping[int, Iterable[int]]) -> tuple[int, ...]:
    """The robots of a circle in which each waits for the next, sorted; empty if there is none.

    Args:
        waits_for: by robot, those that it waits for, of which each alone keeps it from going on.
    """
    done: set[int] = set()
    for first in waits_for:
        path: list[int] = []
        if found := _circle_from(first, waits_for, path, done):
            return tuple(sorted(found))
    return ()


def _circle_from(
    robot: int, waits_for: Mapping[int, Iterable[int]], path: list[int], done: set[int]
) -> Sequence[int]:
    """Depth-first search: a robot that is on the path already closes a circle."""
    if robot in path:
        return path[path.index(robot) :]
    if robot in done:
        return ()
    path.append(robot)
    for other in waits_for.get(robot, ()):
        if found := _circle_from(other, waits_for, path, done):
            return found
    path.pop()
    done.add(robot)
    return ()


def resolve_deadlock(
    circle: Sequence[int],
    driven: Sequence[DriveRecord],
    ahead_m: Sequence[Iterable[Float]],
    clearance_m: float,
    known: Iterable[Hold] = (),
) -> Hold | None:
    """Find a hold with which a circle does not come about; None if no robot has a place for it.

    Args:
        circle: the robots in it, sorted.
        driven: by robot, until they stood there.
        ahead_m: by robot, the waypoints (2,) that it would visit next.
        clearance_m: from the others' ways; a robot that stands so far off is in nobody's way.
        known: holds with which the circle came about. Of those found for it before, the place is
            to be an earlier one.
    """
    ways = {k: _way_past(k, circle, driven, ahead_m[k], clearance_m) for k in circle}
    for robot in sorted(circle, reverse=True):
        from_m = driven[robot].position_m[-1]
        others = [k for k in circle if k != robot]
        passages = tuple(Passage(k, driven[k].progress[-1], from_m) for k in others)
        tried = [each.at for each in known if _is_of(each, robot, passages)]
        legs = np.concatenate([ways[k] for k in others])
        at = _place(driven[robot], legs, clearance_m, tried)
        if at is not None:
            return Hold(robot, at, passages)
    return None


def _is_of(hold: Hold, robot: int, passages: tuple[Passage, ...]) -> bool:
    """Return True if a hold is of the same circle: robots on the way to the same waypoints."""
    asked, found = (
        {(p.robot, p.beyond.visited) for p in each} for each in (passages, hold.passages)
    )
    return hold.robot == robot and asked == found


def _way_past(
    robot: int,
    circle: Sequence[int],
    driven: Sequence[DriveRecord],
    ahead_m: Iterable[Float],
    clearance_m: float,
) -> Float:
    """Legs (L, 2, 2) that a robot would drive next, until it is away from the others."""
    others = np.array([driven[k].position_m[-1] for k in circle if k != robot])
    points = [np.array(driven[robot].position_m[-1])]
    for waypoint in itertools.islice(ahead_m, _MOST_LEGS):
        points.append(waypoint)
        if np.linalg.norm(others - waypoint, axis=1).min() > 2 * clearance_m:
            break
    return np.stack([points[:-1], points[1:]], axis=1)


def _place(
    driven: DriveRecord, legs_m: Float, clearance_m: float, tried: Sequence[Progress]
) -> Progress | None:
    """The last place before `tried` that is clear of legs (L, 2, 2); else the one most so."""
    there = np.array(driven.position_m)[:, None]
    distance_m = segment_distance_m(there, legs_m[:, 0], legs_m[:, 1]).min(axis=1)
    free_m = distance_m - np.array(driven.stopping_m)
    for at in tried:
        earlier = [
            own < at._replace(minus_left_m=at.minus_left_m - _STEP_BACK_M)
            for own in driven.progress
        ]
        free_m = np.where(earlier, free_m, -np.inf)
    clear = np.flatnonzero(free_m >= clearance_m)
    k = int(clear[-1]) if len(clear) else int(free_m.argmax())
    return driven.progress[k] if free_m[k] >= _LEAST_CLEARANCE_M else None
