"""Drive all robots along their routes in one physical world."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import Range, require_in_range
from sim.floorplan import FloorPlan, format_point, segment_distance_m
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
    resolve_deadlock,
)
from sim.trajectory import Trajectory
from sim.world import PHYSICS_HZ, World

# Distance beyond the circle that a robot sweeps: PyBullet detects contacts 0.02 m ahead, and a
# robot moves up to 0.012 m between two readings of its pose.
MARGIN_M = 0.1
WITHIN_REACH_M = OUTER_RADIUS_M + MARGIN_M
NEAR_M = WITHIN_REACH_M + 0.1  # a robot needs at least 0.14 s to drive the difference


class SolidWalls:
    """Collision walls, added to a world when a robot first comes near them.

    PyBullet visits every body in every step, and robots never come near most walls. A wall without
    contact does not change any motion, so the motions are bit-equal to those among all walls.
    """

    def __init__(self, world: World, plan: FloorPlan, n_robots: int) -> None:
        self._world, self._segments = world, plan.segments()
        self._absent = np.ones(len(self._segments[0]), dtype=bool)
        # for each robot: position (x, y) of the last check, and the distance to the next one
        self._free = [(0.0, 0.0, 0.0)] * n_robots

    def stand_near(self, robots: Sequence[Pose]) -> None:
        """Add all walls within reach of the robots at their present poses to the world."""
        starts, ends, thickness, height = self._segments
        for robot, (x, y, _) in enumerate(robots):
            x0, y0, free_m = self._free[robot]
            if math.hypot(x - x0, y - y0) < free_m:
                continue
            distance_m = segment_distance_m(np.array([x, y]), starts, ends) - thickness / 2
            for i in np.flatnonzero(self._absent & (distance_m < NEAR_M)):
                self._world.add_solid_wall(starts[i], ends[i], thickness[i], height[i])
                self._absent[i] = False
            nearest_absent_m = np.min(distance_m, initial=math.inf, where=self._absent)
            self._free[robot] = x, y, nearest_absent_m - WITHIN_REACH_M


CONTROL_HZ = 60
STEPS_PER_CONTROL = PHYSICS_HZ // CONTROL_HZ
SETTLING_S = 0.5  # time in which the wheels come to rest on the floor
PROGRESS_M = 0.05  # least distance that counts as progress; a standing robot trembles by less
STOPPING_GAP_M = 0.15  # between robots, kept also by the one that has the right of way
ALIGNED_RAD = 0.1  # heading error at which a turn in place ends; steering corrects the rest
# Largest distance at which `_Other.is_in_the_way` can be true.
_REACH_M = math.hypot(2 * OUTER_RADIUS_M + STOPPING_GAP_M, 2 * OUTER_RADIUS_M)
DEADLOCK_S = 1.0  # robots that wait for each other for this long are deadlocked
_MOST_HOLDS = 10  # per robot; each hold costs one more drive, and generated worlds need few
HEADING_GAIN_PER_S = 2.0  # turn rate per radian of heading error: half of it gone in 0.35 s


@dataclass(frozen=True)
class DriverSettings:
    """Settings of the controller that drives the robots.

    Attributes:
        speed_m_s: speed on straight legs; the P3-AT's top speed is 0.7.
        turn_rate_rad_s: maximum turn rate. At 0.4 the image moves by 46 px in 0.2 s, so tracks
            last long enough to carry the heading through a turn.
        acceleration_m_s2: change of speed; the wheels must not slip on straight legs.
        turn_acceleration_rad_s2: change of turn rate.
        turn_in_place_rad: heading error above which the robot stops to turn.
        stand_s: time that all robots stand before they start. A front end needs a few frames for
            its first tracks. An earlier turn would be known from the odometry alone, and its error
            would stay in the map's frame.
        arrival_m: distance at which a waypoint counts as visited.
        patience_s: time without progress after which a robot counts as stuck.
        give_way_m: distance to a robot ahead that is listed earlier, below which a robot waits;
            large enough to stop before a crossing that both robots reach at the same time.
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
    """Drive all robots along their routes in one world.

    If robots are deadlocked, all robots drive again from the start with one more hold: one of the
    deadlocked robots waits earlier, where it blocks no other robot (see `sim.routes`).

    Args:
        plan: the walls.
        routes: one route per robot.
        settings: speeds and tolerances.
        n_frames: number of frames to record; the first frame shows the start.
        frame_interval_s: a multiple of the controller's period, 1/60 s.

    Raises:
        InputError: a route or frame interval is impossible, or a robot hits something or is stuck
            (the message names robot, time and place).
    """
    require_drivable(plan, routes, frame_interval_s)
    holds: list[Hold] = []
    while True:
        result = _drive_once(plan, routes, settings, n_frames, frame_interval_s, holds)
        if isinstance(result, Trajectory):
            return result
        holds.append(result)


def require_drivable(plan: FloorPlan, routes: Sequence[Route], frame_interval_s: float) -> None:
    """Raise InputError for a route or frame interval that `drive` refuses before it drives."""
    check_routes(plan, routes)
    _controls_per_frame(frame_interval_s)


def _drive_once(
    plan: FloorPlan,
    routes: Sequence[Route],
    settings: DriverSettings,
    n_frames: int,
    frame_interval_s: float,
    holds: Sequence[Hold],
) -> Trajectory | Hold:
    """Drive with the given holds; return a further hold if the robots are deadlocked."""
    controls_per_frame = _controls_per_frame(frame_interval_s)
    with World() as world:
        ground = world.start_physics()
        robots = [P3at(world, route.T_world_start, route.tire_friction) for route in routes]
        drivers = [
            _Driver(route, robot, settings, [each for each in holds if each.robot == i])
            for i, (route, robot) in enumerate(zip(routes, robots, strict=True))
        ]
        monitor = _DeadlockMonitor(drivers, settings, holds)
        names = {robot.body: route.robot for route, robot in zip(routes, robots, strict=True)}
        walls = SolidWalls(world, plan, len(robots))
        world.step(round(SETTLING_S * PHYSICS_HZ))
        encoder_zero = np.stack([robot.wheel_angles() for robot in robots])
        poses = np.empty((len(robots), n_frames, 3))
        wheels = np.empty((len(robots), n_frames, 2))
        now = [robot.pose() for robot in robots]
        for frame in range(n_frames):
            poses[:, frame] = now
            monitor.record(now)
            for i, robot in enumerate(robots):
                wheels[i, frame] = robot.wheel_angles() - encoder_zero[i]
            for control in range(controls_per_frame if frame + 1 < n_frames else 0):
                time_s = frame * frame_interval_s + control / CONTROL_HZ
                finished = [driver.finished for driver in drivers]
                monitor.apply_holds(now)
                for i, driver in enumerate(drivers):
                    driver.control(time_s, now[i], _others(i, now, finished, drivers))
                if (hold := monitor.hold_needed(now)) is not None:
                    return hold
                walls.stand_near(now)
                world.step(STEPS_PER_CONTROL)
                for driver in drivers:
                    driver.refuse_contact(time_s, ground, names)
                now = [robot.pose() for robot in robots]
    time_s = np.arange(n_frames, dtype=np.float64) * frame_interval_s
    return Trajectory(tuple(route.robot for route in routes), time_s, poses, wheels)


def _controls_per_frame(frame_interval_s: float) -> int:
    """Return the number of control steps per frame; raises InputError if it is not whole."""
    controls = frame_interval_s * CONTROL_HZ
    if not controls > 0.5 or abs(controls - round(controls)) > 1e-9 * controls:
        raise InputError(
            f"drive.frame_interval_s is {frame_interval_s}: must be a multiple of 1/{CONTROL_HZ} s"
        )
    return round(controls)


class _Other(NamedTuple):
    """Another robot from the view of one driver.

    Attributes:
        T_world_robot: its pose.
        index: position in the list of routes.
        goes_first: True if it has the right of way: it is listed earlier and has not finished.
        yields: True if it stands because the driver's robot blocks it.
    """

    T_world_robot: Pose
    index: int
    goes_first: bool
    yields: bool

    def is_in_the_way(self, x: float, y: float) -> bool:
        """Return True if a robot at (x, y) in the driver's robot frame blocks the driver.

        If two robots stand before each other, the earlier listed one has the right of way. If it
        yields, the other robot must continue: the passage then needs room for the width of the
        passing robot, and for the full circle of the standing one.
        """
        passes = self.goes_first and self.yields
        beside_m = OUTER_RADIUS_M + (WIDTH_M / 2 if passes else OUTER_RADIUS_M)
        return x < 2 * OUTER_RADIUS_M + STOPPING_GAP_M and abs(y) < beside_m


def _others(
    robot: int, now: list[Pose], finished: list[bool], drivers: list["_Driver"]
) -> Iterator[_Other]:
    """Yield all robots except one, from the view of that one."""
    for i, driver in enumerate(drivers):
        if i != robot:
            goes_first = i < robot and not finished[i]
            yield _Other(now[i], i, goes_first, robot in driver.waits_for)


class _Driver:
    """Controller that steers one robot from waypoint to waypoint by its true pose."""

    def __init__(
        self, route: Route, robot: P3at, settings: DriverSettings, holds: Sequence[Hold] = ()
    ) -> None:
        self._route, self._robot, self._settings = route, robot, settings
        self._waypoints_m: list[list[float]] = route.waypoints_m.tolist()
        self._target = self._visited = 0
        self.finished = False  # True at the end of the route
        self._holds = [ActiveHold(each) for each in holds]
        self._holding_for: set[int] = set()
        self._speed_m_s = 0.0
        self._turn_rad_s = 0.0
        self._nearest_m = np.inf
        # time at which it last came nearer to its waypoint or visited one
        self.progress_s = 0.0
        self._turning = False
        self.yields_to: int | None = None  # index of the robot that it stops for
        # no robot beyond this distance blocks it, with a margin for rounding
        self._range_m = 1.01 * max(settings.give_way_m, _REACH_M)

    @property
    def waits_for(self) -> set[int]:
        """Indices of the robots that it waits for."""
        return self._holding_for if self.yields_to is None else {self.yields_to}

    @property
    def stands(self) -> bool:
        """True if the robot neither drives nor turns."""
        return self._speed_m_s == 0 and self._turn_rad_s == 0

    def ahead_m(self) -> Iterator[Float]:
        """Yield the next waypoints, shape (2,); endless if the route is a loop."""
        yield from self._route.waypoints_m[self._target :]
        while self._route.loop:
            yield from self._route.waypoints_m

    def progress(self, pose: Pose) -> Progress:
        """Return the progress along the route."""
        return Progress(self._visited, -self._distance_m(pose))

    def stopping_m(self) -> float:
        """Return the stopping distance at the present speed."""
        return self._speed_m_s**2 / (2 * self._settings.acceleration_m_s2)

    def hold(self, came: Sequence[Progress], now: Sequence[Pose], clearance_m: float) -> None:
        """Update the robots that the holds wait for from the progress of all robots."""
        self._holding_for = set()
        for each in self._holds:
            self._holding_for |= each.waits_for(came, now, clearance_m)

    def control(self, time_s: float, pose: Pose, others: Iterable[_Other]) -> None:
        """Perform one control step, given the poses of all robots.

        Raises:
            InputError: the robot is stuck.
        """
        settings = self._settings
        # progress: on arrival the next waypoint is selected
        distance = self._distance_m(pose)
        if not self.finished and distance < settings.arrival_m:
            self._target += 1
            self._visited += 1
            if self._target == len(self._waypoints_m):
                self.finished = not self._route.loop
                self._target = 0
            self._nearest_m, self.progress_s = np.inf, time_s
            distance = self._distance_m(pose)
        if self.finished or self._holding_for or distance < self._nearest_m - PROGRESS_M:
            self._nearest_m, self.progress_s = distance, time_s
        if time_s - self.progress_s > settings.patience_s:
            why = "waits for another robot" if self.yields_to is not None else "is stuck"
            raise InputError(
                f"robot {self._route.robot}: {why} at {format_point(pose)} since t = "
                f"{self.progress_s:.1f} s, on the way to waypoint {self._target + 1} "
                f"{format_point(self._waypoints_m[self._target])}"
            )

        stands = self.finished or time_s < settings.stand_s or bool(self._holding_for)
        speed, turn = (0.0, 0.0) if stands else self._desired_speeds(pose)
        self.yields_to = self._blocking_robot(pose, others) if speed > 0 else None
        if self.yields_to is not None:
            speed = turn = 0.0
        self._speed_m_s = _towards(self._speed_m_s, speed, settings.acceleration_m_s2 / CONTROL_HZ)
        self._turn_rad_s = _towards(
            self._turn_rad_s, turn, settings.turn_acceleration_rad_s2 / CONTROL_HZ
        )
        difference = self._turn_rad_s * SKID_TRACK_M / 2
        left, right = self._speed_m_s - difference, self._speed_m_s + difference
        self._robot.drive(left / WHEEL_RADIUS_M, right / WHEEL_RADIUS_M)

    def _distance_m(self, pose: Pose) -> float:
        return math.dist(self._waypoints_m[self._target], pose[:2])

    def _desired_speeds(self, pose: Pose) -> tuple[float, float]:
        """Return speed (m/s) and turn rate (rad/s) towards the waypoint.

        The robot stops before it turns in place: a skid-steered robot that turns while it rolls
        slides sideways by 0.1 m per radian, and its encoders do not measure that.
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

    def _blocking_robot(self, pose: Pose, others: Iterable[_Other]) -> int | None:
        """Return the first robot ahead that has the right of way or is in the way, or None."""
        for other in others:
            along, across = other.T_world_robot[0] - pose[0], other.T_world_robot[1] - pose[1]
            apart_m = math.hypot(along, across)
            if apart_m > self._range_m:
                continue
            cos, sin = math.cos(pose[2]), math.sin(pose[2])
            x, y = cos * along + sin * across, cos * across - sin * along
            goes_first = other.goes_first and not other.yields
            gives_way = goes_first and apart_m < self._settings.give_way_m
            if x > 0 and (gives_way or other.is_in_the_way(x, y)):
                return other.index
        return None

    def refuse_contact(self, time_s: float, ground: int, names: dict[int, str]) -> None:
        """Raise InputError if the robot touches anything except the ground."""
        touched = self._robot.touched_bodies() - {ground}
        if touched:
            body = min(touched)
            what = f"robot {names[body]}" if body in names else "a wall"
            raise InputError(
                f"robot {self._route.robot}: hits {what} at {format_point(self._robot.pose())}, "
                f"t = {time_s:.1f} s"
            )


class _DeadlockMonitor:
    """Monitor that applies the holds and detects robots that wait for each other in a cycle."""

    def __init__(
        self, drivers: Sequence[_Driver], settings: DriverSettings, holds: Sequence[Hold]
    ) -> None:
        self._drivers, self._holds = drivers, holds
        self._records = [DriveRecord() for _ in drivers]
        # a robot may be beside the middle of its leg by the arrival tolerance
        self._clearance_m = _REACH_M + settings.arrival_m
        self._most_holds = _MOST_HOLDS * len(drivers)
        self._deadlock: tuple[int, ...] = ()
        self._n_steps = 0

    def record(self, now: Sequence[Pose]) -> None:
        """Record poses and progress of the robots at a frame."""
        for robot_records, driver, pose in zip(self._records, self._drivers, now, strict=True):
            robot_records.add(pose, driver.progress(pose), driver.stopping_m())

    def apply_holds(self, now: Sequence[Pose]) -> None:
        """Update the robots that each driver's holds wait for."""
        if self._holds:
            came = [each.progress(pose) for each, pose in zip(self._drivers, now, strict=True)]
            for driver in self._drivers:
                driver.hold(came, now, self._clearance_m)

    def hold_needed(self, now: Sequence[Pose]) -> Hold | None:
        """Return a hold that avoids the present deadlock; None without a deadlock.

        A robot that waits outside the cycle is not stuck while the robot ahead makes progress.
        """
        waits_for = {
            i: driver.waits_for
            for i, driver in enumerate(self._drivers)
            if driver.stands and driver.waits_for
        }
        deadlock = find_deadlock(waits_for) if len(waits_for) > 1 else ()
        self._n_steps = self._n_steps + 1 if deadlock and deadlock == self._deadlock else 0
        self._deadlock = deadlock
        for i in waits_for.keys() - set(deadlock):
            ahead = [self._drivers[k] for k in waits_for[i] if not self._drivers[k].finished]
            driver = self._drivers[i]
            driver.progress_s = max([driver.progress_s, *(each.progress_s for each in ahead)])
        if self._n_steps != DEADLOCK_S * CONTROL_HZ or len(self._holds) == self._most_holds:
            return None
        self.record(now)
        ahead_m = [driver.ahead_m() for driver in self._drivers]
        return resolve_deadlock(deadlock, self._records, ahead_m, self._clearance_m, self._holds)


def _towards(value: float, target: float, step: float) -> float:
    """Return a value changed towards the target by at most one step."""
    return value + min(max(target - value, -step), step)
