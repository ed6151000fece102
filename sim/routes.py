"""Routes of the robots: checks of free space, and right of way between robots.

Robots follow their routes and stop for each other, so two robots that meet head-on in a door are
deadlocked. `sim.driver` then drives again from the start with one more constraint, a hold: one of
the deadlocked robots waits on its way, before it blocks the others, until these have passed. Each
further deadlock adds a hold, as conflict-based search does for planned paths (Sharon, Stern, Felner
and Sturtevant, 2015, Artificial Intelligence 219); here the conflicts are found by driving. The
robot that is listed last holds if its past way has a suitable position, else the one listed before
it, and so on.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float, require_finite, require_shape
from sim.floorplan import FloorPlan, format_point, segment_distance_m
from sim.p3at import OUTER_RADIUS_M, TIRE_FRICTION, WIDTH_M, Pose


@dataclass(frozen=True)
class Route:
    """Start and waypoints of one robot.

    Attributes:
        robot: its name.
        T_world_start: start pose, shape (3,).
        waypoints_m: waypoints in order, shape (K, 2).
        loop: True if the first waypoint follows the last one; else the robot stops there.
        tire_friction: friction of the wheels against the ground; wheels slip if it is low.
        planned_start_m: start (x, y) before a random offset, for messages; None without offset.
    """

    robot: str
    T_world_start: Float
    waypoints_m: Float
    loop: bool = False
    tire_friction: float = TIRE_FRICTION
    planned_start_m: tuple[float, float] | None = None

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

    @property
    def start_text(self) -> str:
        """The start in words, with the random offset if there is one."""
        if self.planned_start_m is None:
            return f"start {format_point(self.T_world_start)}"
        moved = f"moved to {format_point(self.T_world_start)} by the start jitter"
        return f"start {format_point(self.planned_start_m)}, {moved},"


def check_routes(plan: FloorPlan, routes: Sequence[Route]) -> None:
    """Raise InputError if a route cannot be driven.

    The message names robot and position, and the place as robots.INDEX.start or
    robots.INDEX.route.INDEX, counted from 0.
    """
    names = [route.robot for route in routes]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"robot {name}: two robots have this name")
    for number, route in enumerate(routes):
        # room at the waypoints and between them
        points = np.concatenate([route.T_world_start[None, :2], route.waypoints_m])
        texts = [f"waypoint {i} {format_point(p)}" for i, p in enumerate(points[1:], start=1)]
        texts.insert(0, route.start_text)
        fields = [f"robots.{number}.start"]
        fields += [f"robots.{number}.route.{i}" for i in range(len(points) - 1)]
        on_floor, clearance = plan.contains(points), plan.clearance_m(points)
        for field_name, text, inside, room in zip(fields, texts, on_floor, clearance, strict=True):
            where = f"{field_name}: robot {route.robot}: {text}"
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
                f"{fields[end]}: robot {route.robot}: the way from {texts[start]} to {texts[end]}"
            )
            if room < 0:
                raise InputError(f"{where} leads through a wall")
            if room < WIDTH_M / 2:
                raise InputError(
                    f"{where} passes a wall at {room:.2f} m, the robot needs {WIDTH_M / 2:.2f} m"
                )
    for i, first in enumerate(routes):
        for k, second in enumerate(routes[i + 1 :], start=i + 1):
            gap = np.hypot(*(first.T_world_start - second.T_world_start)[:2])
            if gap < 2 * OUTER_RADIUS_M:
                raise InputError(
                    f"robots.{i}.start and robots.{k}.start: robots {first.robot} and "
                    f"{second.robot}: they start {gap:.2f} m apart ({first.start_text} and "
                    f"{second.start_text}); {2 * OUTER_RADIUS_M:.2f} m are needed"
                )


# Least distance between two tried positions of a hold; a smaller step has no effect.
_STEP_BACK_M = 0.25
# Least distance of a holding robot from another robot's way: their circles must not touch.
_LEAST_CLEARANCE_M = 2 * OUTER_RADIUS_M
_MOST_LEGS = 8  # legs of a way past the other robots; a rectangular loop has four


class Progress(NamedTuple):
    """Progress of a robot: visited waypoints, and the negated distance to the next waypoint."""

    visited: int
    minus_left_m: float


class Passage(NamedTuple):
    """Condition that a holding robot waits for.

    Attributes:
        robot: index of the robot that has to pass.
        beyond: its progress in the deadlock; a robot with more progress has passed.
        from_m: position (x, y) of the holding robot in the deadlock; a robot that has passed is
            also away from it.
    """

    robot: int
    beyond: Progress
    from_m: tuple[float, float]


class Hold(NamedTuple):
    """Constraint: a robot stands at a position on its way until others have passed.

    Attributes:
        robot: index of the robot.
        at: its progress at the position.
        passages: one per robot that has to pass.
    """

    robot: int
    at: Progress
    passages: tuple[Passage, ...]


@dataclass
class DriveRecord:
    """Record of one robot's drive, frame by frame.

    Attributes:
        position_m: positions (x, y).
        progress: progress along the route.
        stopping_m: stopping distances.
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
    """State of a hold during one drive; it begins once and ends when all robots have passed."""

    def __init__(self, hold: Hold) -> None:
        self._hold, self._to_pass, self._begun = hold, list(hold.passages), False

    def waits_for(
        self, came: Sequence[Progress], now: Sequence[Pose], clearance_m: float
    ) -> set[int]:
        """Return the robots that the hold waits for, given progress and pose of all robots.

        A robot has passed if its progress is above that in the deadlock, and if it is away from the
        position of the holding robot in the deadlock.
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
    """Return the robots of a cycle in the wait-for graph, sorted; empty without a cycle.

    Args:
        waits_for: robots that block each robot.
    """
    done: set[int] = set()
    for first in waits_for:
        path: list[int] = []
        if found := _find_cycle(first, waits_for, path, done):
            return tuple(sorted(found))
    return ()


def _find_cycle(
    robot: int, waits_for: Mapping[int, Iterable[int]], path: list[int], done: set[int]
) -> Sequence[int]:
    """Return a cycle reached from a robot by depth-first search; empty without a cycle."""
    if robot in path:
        return path[path.index(robot) :]
    if robot in done:
        return ()
    path.append(robot)
    for other in waits_for.get(robot, ()):
        if found := _find_cycle(other, waits_for, path, done):
            return found
    path.pop()
    done.add(robot)
    return ()


def resolve_deadlock(
    deadlock: Sequence[int],
    records: Sequence[DriveRecord],
    ahead_m: Sequence[Iterable[Float]],
    clearance_m: float,
    known: Iterable[Hold] = (),
) -> Hold | None:
    """Return a hold that avoids a deadlock; None if no robot has a suitable position.

    Args:
        deadlock: the robots in it, sorted.
        records: drives of all robots up to the deadlock.
        ahead_m: next waypoints of each robot, shape (2,) each.
        clearance_m: distance to the ways of other robots at which a robot does not block them.
        known: holds of the present drive. A new hold for the same deadlock is at an earlier
            position than the known ones.
    """
    # legs (L, 2, 2) that each robot drives next, until it is away from the others
    legs_m = {}
    for robot in deadlock:
        others_m = np.array([records[k].position_m[-1] for k in deadlock if k != robot])
        points = [np.array(records[robot].position_m[-1])]
        for waypoint in itertools.islice(ahead_m[robot], _MOST_LEGS):
            points.append(waypoint)
            if np.linalg.norm(others_m - waypoint, axis=1).min() > 2 * clearance_m:
                break
        legs_m[robot] = np.stack([points[:-1], points[1:]], axis=1)
    for robot in sorted(deadlock, reverse=True):
        driven = records[robot]
        others = [k for k in deadlock if k != robot]
        passages = tuple(Passage(k, records[k].progress[-1], driven.position_m[-1]) for k in others)
        # free distance at each past position, without the stopping distance
        legs = np.concatenate([legs_m[k] for k in others])
        positions = np.array(driven.position_m)[:, None]
        distance_m = segment_distance_m(positions, legs[:, 0], legs[:, 1]).min(axis=1)
        free_m = distance_m - np.array(driven.stopping_m)
        # only positions before the known holds of the same deadlock
        for hold in known:
            if hold.robot != robot or _next_waypoints(hold.passages) != _next_waypoints(passages):
                continue
            latest = hold.at._replace(minus_left_m=hold.at.minus_left_m - _STEP_BACK_M)
            earlier = [own < latest for own in driven.progress]
            free_m = np.where(earlier, free_m, -np.inf)
        # the last clear position, else the clearest one
        clear = np.flatnonzero(free_m >= clearance_m)
        k = int(clear[-1]) if len(clear) else int(free_m.argmax())
        if free_m[k] >= _LEAST_CLEARANCE_M:
            return Hold(robot, driven.progress[k], passages)
    return None


def _next_waypoints(passages: Iterable[Passage]) -> set[tuple[int, int]]:
    """Return robots and their next waypoints, which identify a deadlock."""
    return {(each.robot, each.beyond.visited) for each in passages}
