"""Drive all robots along their routes in one physical world."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import Range, require_in_range
from sim.floorplan import FloorPlan, segment_distance_m
from sim.p3at import (
    OUTER_RADIUS_M,
    SKID_TRACK_M,
    TOP_SPEED_M_S,
    WHEEL_RADIUS_M,
    WIDTH_M,
    P3at,
    Pose,
)
from sim.routes import (
    ActiveHold,
    DriveRecord,
    Hold,
    Progress,
    Route,
    check_routes,
    find_deadlock,
    format_point,
    resolve_deadlock,
)
from sim.trajectory import Trajectory
from sim.world import PHYSICS_HZ, World

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


CONTROL_HZ = 60
STEPS_PER_CONTROL = PHYSICS_HZ // CONTROL_HZ
SETTLING_S = 0.5  # until the wheels have come to rest on the floor
PROGRESS_M = 0.05  # to count as progress; more than a standing robot trembles
STOPPING_GAP_M = 0.15  # between robots, kept also by the one that has the right of way
ALIGNED_RAD = 0.1  # heading error with which a turn in place ends; what is left is steered out
# Apart by this no robot stands in another's way: as `_Other.is_in_the_way` says at the most.
_REACH_M = math.hypot(2 * OUTER_RADIUS_M + STOPPING_GAP_M, 2 * OUTER_RADIUS_M)
CIRCLE_S = 1.0  # robots that wait for each other for so long will not move again by themselves
_MOST_HOLDS = 10  # a robot; each costs one drive more, and the drives of generated worlds need few
HEADING_GAIN_PER_S = 2.0  # turn rate per radian of heading error: half of it gone in 0.35 s


@dataclass(frozen=True)
class DriverSettings:
    """How the robots are driven.

    Attributes:
        speed_m_s: along straight legs; the P3-AT's top speed is 0.7.
        turn_rate_rad_s: at most; 0.4 moves a picture by 46 px in 0.2 s, a view of 640 px in 14
            frames: long enough for tracks to carry the heading through a turn.
        acceleration_m_s2: change of speed; gentle enough for the wheels to hold on straight legs.
        turn_acceleration_rad_s2: change of turn rate.
        turn_in_place_rad: heading error above which the robot stops to turn.
        stand_s: how long all robots stand before they set out. A front end needs a few frames for
            its first tracks; a turn before that is known from the odometry alone, and in the map's
            own frame its error never goes away.
        arrival_m: a waypoint counts as visited this near.
        patience_s: without progress for so long a robot counts as stuck.
        give_way_m: a robot waits while one listed before it drives this near ahead of it; enough to
            stop short of its way where both come to a crossing at once.
    """

    speed_m_s: Annotated[float, Range(0.01, TOP_SPEED_M_S, "m/s")] = 0.5
    turn_rate_rad_s: Annotated[float, Range(0.01, 10, "rad/s")] = 0.4
    acceleration_m_s2: Annotated[float, Range(0.01, 10, "m/s^2")] = 0.5
    turn_acceleration_rad_s2: Annotated[float, Range(0.01, 100, "rad/s^2")] = 2.0
    turn_in_place_rad: Annotated[float, Range(0.01, 3.2, "rad")] = 0.2
    stand_s: Annotated[float, Range(0, 3600, "s")] = 1.0
    arrival_m: Annotated[float, Range(0.01, 10, "m")] = 0.2
    patience_s: Annotated[float, Range(0.1, 3600, "s")] = 30.0
    give_way_m: Annotated[float, Range(0.01, 100, "m")] = 1.6

    def __post_init__(self) -> None:
        require_in_range(self)


def drive(
    plan: FloorPlan,
    routes: Sequence[Route],
    settings: DriverSettings,
    n_frames: int,
    frame_interval_s: float,
) -> Trajectory:
    """Let all robots follow their routes in one world.

    Args:
        plan: the walls.
        routes: one a robot.
        settings: speeds and tolerances.
        n_frames: frames to record; the first shows the start.
        frame_interval_s: a multiple of the controller's period, 1/60 s.

    Where robots come to wait for each other in a circle, all drive anew and one of them waits
    earlier, where it is in nobody's way (`right_of_way.py`).

    Raises:
        InputError: an impossible route or frame interval; a robot that hits something or is stuck
            (names robot, time and place).
    """
    check_routes(plan, routes)
    _controls_per_frame(frame_interval_s)
    holds: list[Hold] = []
    while True:
        found = _driven(plan, routes, settings, n_frames, frame_interval_s, holds)
        if isinstance(found, Trajectory):
            return found
        holds.append(found)


def _driven(
    plan: FloorPlan,
    routes: Sequence[Route],
    settings: DriverSettings,
    n_frames: int,
    frame_interval_s: float,
    holds: Sequence[Hold],
) -> Trajectory | Hold:
    """Drive under these holds; give one more hold where one is needed and there is one."""
    controls_per_frame = _controls_per_frame(frame_interval_s)
    with World() as world:
        ground = world.start_physics()
        robots = [P3at(world, route.T_world_start, route.tire_friction) for route in routes]
        drivers = [
            _Driver(route, robot, settings, [each for each in holds if each.robot == i])
            for i, (route, robot) in enumerate(zip(routes, robots, strict=True))
        ]
        circles = _Circles(drivers, settings, holds)
        names = {robot.body: route.robot for route, robot in zip(routes, robots, strict=True)}
        walls = SolidWalls(world, plan, len(robots))
        world.step(round(SETTLING_S * PHYSICS_HZ))
        encoder_zero = np.stack([robot.wheel_angles() for robot in robots])
        poses = np.empty((len(robots), n_frames, 3))
        wheels = np.empty((len(robots), n_frames, 2))
        now = [robot.pose() for robot in robots]
        for frame in range(n_frames):
            poses[:, frame] = now
            circles.record(now)
            for i, robot in enumerate(robots):
                wheels[i, frame] = robot.wheel_angles() - encoder_zero[i]
            for control in range(controls_per_frame if frame + 1 < n_frames else 0):
                time_s = frame * frame_interval_s + control / CONTROL_HZ
                parked = [driver.parked for driver in drivers]
                circles.hold(now)
                for i, driver in enumerate(drivers):
                    driver.control(time_s, now[i], _others(i, now, parked, drivers))
                if (hold := circles.hold_needed(now)) is not None:
                    return hold
                walls.stand_near(now)
                world.step(STEPS_PER_CONTROL)
                for driver in drivers:
                    driver.refuse_contact(time_s, ground, names)
                now = [robot.pose() for robot in robots]
    time_s = np.arange(n_frames, dtype=np.float64) * frame_interval_s
    return Trajectory(tuple(route.robot for route in routes), time_s, poses, wheels)


def _controls_per_frame(frame_interval_s: float) -> int:
    controls = frame_interval_s * CONTROL_HZ
    if not controls > 0.5 or abs(controls - round(controls)) > 1e-9 * controls:
        raise InputError(
            f"frame_interval_s is {frame_interval_s}: must be a multiple of 1/{CONTROL_HZ} s"
        )
    return round(controls)


class _Other(NamedTuple):
    """Another robot as a driver sees it.

    Attributes:
        T_world_robot: where it is.
        place: in the list of routes.
        goes_first: those listed first do, until they have come to their end.
        lets_by: whether it stands because this one is in its way.
    """

    T_world_robot: Pose
    format_point: int
    goes_first: bool
    lets_by: bool

    def is_in_the_way(self, x: float, y: float) -> bool:
        """Whether it is, where it is seen at (x, y).

        Of two that stand before each other one is listed first and has the right of way, but the
        other has come so far into it that it must go on: past one that stands there needs to be
        room for its own width alone, and for the other however that one turns.
        """
        passes = self.goes_first and self.lets_by
        beside_m = OUTER_RADIUS_M + (WIDTH_M / 2 if passes else OUTER_RADIUS_M)
        return x < 2 * OUTER_RADIUS_M + STOPPING_GAP_M and abs(y) < beside_m


def _others(
    of: int, now: list[Pose], parked: list[bool], drivers: list["_Driver"]
) -> Iterator[_Other]:
    """All robots but one, as that one sees them."""
    for i, driver in enumerate(drivers):
        if i != of:
            yield _Other(now[i], i, i < of and not parked[i], of in driver.waits_for)


class _Driver:
    """Steers one robot from waypoint to waypoint by its true pose."""

    def __init__(
        self, route: Route, robot: P3at, settings: DriverSettings, holds: Sequence[Hold] = ()
    ) -> None:
        self._route, self._robot, self._settings = route, robot, settings
        self._waypoints_m: list[list[float]] = route.waypoints_m.tolist()
        self._target = self._visited = 0
        self._done = False
        self._holds = [ActiveHold(each) for each in holds]
        self._holding_for: set[int] = set()
        self._speed_m_s = 0.0
        self._turn_rad_s = 0.0
        self._nearest_m = np.inf
        self._progress_s = 0.0
        self._turning = False
        self.lets_by: int | None = None  # the robot that it stops for
        # beyond, no other is in the way, whatever is rounded
        self._looks_m = 1.01 * max(settings.give_way_m, _REACH_M)

    @property
    def parked(self) -> bool:
        """Whether it has come to the end of its route."""
        return self._done

    @property
    def waits_for(self) -> set[int]:
        """The robots that it stands for, or is about to."""
        return self._holding_for if self.lets_by is None else {self.lets_by}

    @property
    def stands(self) -> bool:
        """Whether it neither drives nor turns."""
        return self._speed_m_s == 0 and self._turn_rad_s == 0

    def ahead_m(self) -> Iterator[Float]:
        """The waypoints (2,) that it visits next, without end where its route is a loop."""
        yield from self._route.waypoints_m[self._target :]
        while self._route.loop:
            yield from self._route.waypoints_m

    def progress(self, pose: Pose) -> Progress:
        """How far it has come."""
        return Progress(self._visited, -self._distance_m(pose))

    def stopping_m(self) -> float:
        """How far it rolls on if it brakes now."""
        return self._speed_m_s**2 / (2 * self._settings.acceleration_m_s2)

    def hold(self, came: Sequence[Progress], now: Sequence[Pose], clearance_m: float) -> None:
        """See which robots its holds have it wait for, given how far all have come."""
        self._holding_for = set()
        for each in self._holds:
            self._holding_for |= each.waits_for(came, now, clearance_m)

    def bear_with(self, time_s: float) -> None:
        """Count no time until then as time without progress."""
        self._progress_s = max(self._progress_s, time_s)

    @property
    def progress_s(self) -> float:
        """When it last came nearer to its waypoint, or visited one."""
        return self._progress_s

    def control(self, time_s: float, pose: Pose, others: Iterable[_Other]) -> None:
        """One step, given where all robots are."""
        settings = self._settings
        self._advance(time_s, pose)
        stands = self._done or time_s < settings.stand_s or bool(self._holding_for)
        speed, turn = (0.0, 0.0) if stands else self._wish(pose)
        self.lets_by = self._first_in_the_way(pose, others) if speed > 0 else None
        if self.lets_by is not None:
            speed = turn = 0.0
        self._speed_m_s = _towards(self._speed_m_s, speed, settings.acceleration_m_s2 / CONTROL_HZ)
        self._turn_rad_s = _towards(
            self._turn_rad_s, turn, settings.turn_acceleration_rad_s2 / CONTROL_HZ
        )
        difference = self._turn_rad_s * SKID_TRACK_M / 2
        left, right = self._speed_m_s - difference, self._speed_m_s + difference
        self._robot.drive(left / WHEEL_RADIUS_M, right / WHEEL_RADIUS_M)

    def _advance(self, time_s: float, pose: Pose) -> None:
        """Go on to the next waypoint; refuse to go on where nothing moves."""
        distance = self._distance_m(pose)
        if not self._done and distance < self._settings.arrival_m:
            self._target += 1
            self._visited += 1
            if self._target == len(self._waypoints_m):
                self._done = not self._route.loop
                self._target = 0
            self._nearest_m, self._progress_s = np.inf, time_s
            distance = self._distance_m(pose)
        if self._done or self._holding_for or distance < self._nearest_m - PROGRESS_M:
            self._nearest_m, self._progress_s = distance, time_s
        if time_s - self._progress_s > self._settings.patience_s:
            why = "waits for another robot" if self.lets_by is not None else "is stuck"
            raise InputError(
                f"robot {self._route.robot}: {why} at {format_point(pose)} since t = "
                f"{self._progress_s:.1f} s, on the way to waypoint {self._target + 1} "
                f"{format_point(self._waypoints_m[self._target])}"
            )

    def _distance_m(self, pose: Pose) -> float:
        return math.dist(self._waypoints_m[self._target], pose[:2])

    def _wish(self, pose: Pose) -> tuple[float, float]:
        """Speed and turn rate towards the waypoint.

        A corner is turned in place, after a stop: a skid-steered robot that turns while it still
        rolls slides sideways by 0.1 m per radian, which no encoder counts.
        """
        settings = self._settings
        x, y = self._waypoints_m[self._target]
        heading = math.atan2(y - pose[1], x - pose[0])
        error = (heading - pose[2] + math.pi) % (2 * math.pi) - math.pi
        top = settings.turn_rate_rad_s
        turn = min(max(HEADING_GAIN_PER_S * error, -top), top)
        self._turning = abs(error) > (ALIGNED_RAD if self._turning else settings.turn_in_place_rad)
        if self._turning:
            return 0.0, turn if self._speed_m_s == 0 else 0.0
        return settings.speed_m_s * max(0.0, 1 - abs(error) / settings.turn_in_place_rad), turn

    def _first_in_the_way(self, pose: Pose, others: Iterable[_Other]) -> int | None:
        """Another robot ahead that goes first or stands in the way."""
        for other in others:
            along, across = other.T_world_robot[0] - pose[0], other.T_world_robot[1] - pose[1]
            apart_m = math.hypot(along, across)
            if apart_m > self._looks_m:
                continue
            cos, sin = math.cos(pose[2]), math.sin(pose[2])
            x, y = cos * along + sin * across, cos * across - sin * along
            goes_first = other.goes_first and not other.lets_by
            gives_way = goes_first and apart_m < self._settings.give_way_m
            if x > 0 and (gives_way or other.is_in_the_way(x, y)):
                return other.place
        return None

    def refuse_contact(self, time_s: float, ground: int, names: dict[int, str]) -> None:
        """Raise InputError when the robot touches anything but the ground."""
        touched = self._robot.touched_bodies() - {ground}
        if touched:
            body = min(touched)
            what = f"robot {names[body]}" if body in names else "a wall"
            raise InputError(
                f"robot {self._route.robot}: hits {what} at {format_point(self._robot.pose())}, "
                f"t = {time_s:.1f} s"
            )


class _Circles:
    """Keeps the robots to their holds, and finds those that wait for each other."""

    def __init__(
        self, drivers: Sequence[_Driver], settings: DriverSettings, holds: Sequence[Hold]
    ) -> None:
        self._drivers, self._holds = drivers, holds
        self._driven = [DriveRecord() for _ in drivers]
        # from the middle of a leg, which a robot may be beside by the arrival tolerance
        self._clearance_m = _REACH_M + settings.arrival_m
        self._most_holds = _MOST_HOLDS * len(drivers)
        self._circle: tuple[int, ...] = ()
        self._n_steps = 0

    def record(self, now: Sequence[Pose]) -> None:
        """Take down where the robots are at a frame."""
        for own, driver, pose in zip(self._driven, self._drivers, now, strict=True):
            own.add(pose, driver.progress(pose), driver.stopping_m())

    def hold(self, now: Sequence[Pose]) -> None:
        """Tell the robots which others their holds have them wait for."""
        if self._holds:
            came = [each.progress(pose) for each, pose in zip(self._drivers, now, strict=True)]
            for driver in self._drivers:
                driver.hold(came, now, self._clearance_m)

    def hold_needed(self, now: Sequence[Pose]) -> Hold | None:
        """After a step: what keeps robots from waiting for each other as they do; None if none do.

        One that waits, and not in a circle, is not stuck as long as the one ahead makes progress.
        """
        waits_for = {
            i: driver.waits_for
            for i, driver in enumerate(self._drivers)
            if driver.stands and driver.waits_for
        }
        circle = find_deadlock(waits_for) if len(waits_for) > 1 else ()
        self._n_steps = self._n_steps + 1 if circle and circle == self._circle else 0
        self._circle = circle
        for i in waits_for.keys() - set(circle):
            ahead = [k for k in waits_for[i] if not self._drivers[k].parked]
            self._drivers[i].bear_with(max((self._drivers[k].progress_s for k in ahead), default=0))
        if self._n_steps != CIRCLE_S * CONTROL_HZ or len(self._holds) == self._most_holds:
            return None
        self.record(now)
        ahead_m = [driver.ahead_m() for driver in self._drivers]
        return resolve_deadlock(circle, self._driven, ahead_m, self._clearance_m, self._holds)


def _towards(value: float, target: float, step: float) -> float:
    return value + min(max(target - value, -step), step)
