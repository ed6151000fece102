"""Drives all robots along their routes in one physical world and writes down what happened."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.arguments import require_finite, require_shape
from mapfusion.errors import InputError
from mapfusion.se2 import Float, between, wrap
from sim.floorplan import FloorPlan
from sim.p3at import (
    OUTER_RADIUS_M,
    SKID_TRACK_M,
    TOP_SPEED_M_S,
    WHEEL_RADIUS_M,
    WIDTH_M,
    P3at,
)
from sim.trajectory import Trajectory
from sim.world import PHYSICS_HZ, World

CONTROL_HZ = 30
STEPS_PER_CONTROL = PHYSICS_HZ // CONTROL_HZ
SETTLING_S = 0.5  # until the wheels have come to rest on the floor
HEADING_GAIN_PER_S = 2.0  # turn rate per radian of heading error: half of it gone in 0.35 s


@dataclass(frozen=True)
class Route:
    """Where a robot starts and what it is to visit.

    Attributes:
        robot: its name.
        T_world_start: (3,).
        waypoints_m: (K, 2), visited in order.
        loop: whether it begins again with the first waypoint after the last; else it stands still.
    """

    robot: str
    T_world_start: Float
    waypoints_m: Float
    loop: bool = False

    def __post_init__(self) -> None:
        for name, shape in (("T_world_start", (3,)), ("waypoints_m", (None, 2))):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, values)
            require_shape(name, values, shape)
            require_finite(name, values)
        if len(self.waypoints_m) == 0:
            raise InputError(f"robot {self.robot}: needs at least one waypoint")


@dataclass(frozen=True)
class DriverSettings:
    """How the robots are driven.

    Attributes:
        speed_m_s: along straight legs; the P3-AT's top speed is 0.7.
        turn_rate_rad_s: at most; 0.6 turns a picture by 0.06 rad (35 px) in a tenth of a second.
        acceleration_m_s2: change of speed; gentle enough for the wheels to hold on straight legs.
        turn_acceleration_rad_s2: change of turn rate.
        turn_in_place_rad: heading error above which the robot stops to turn.
        arrival_m: a waypoint counts as visited this near.
        patience_s: without progress for so long a robot counts as stuck.
        give_way_m: a robot waits while another is this near ahead of it.
    """

    speed_m_s: float = 0.5
    turn_rate_rad_s: float = 0.6
    acceleration_m_s2: float = 0.5
    turn_acceleration_rad_s2: float = 2.0
    turn_in_place_rad: float = 0.5
    arrival_m: float = 0.2
    patience_s: float = 30.0
    give_way_m: float = 1.2

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not getattr(self, name) > 0:
                raise InputError(f"driver: {name} is {getattr(self, name)}, must be above 0")
        if self.speed_m_s > TOP_SPEED_M_S:
            raise InputError(
                f"driver: speed_m_s is {self.speed_m_s}, the P3-AT's top speed is {TOP_SPEED_M_S}"
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
                    f"at {_place(first.T_world_start)}; {2 * OUTER_RADIUS_M:.2f} m are needed"
                )


def _check_route(plan: FloorPlan, route: Route) -> None:
    points = np.concatenate([route.T_world_start[None, :2], route.waypoints_m])
    labels = ["start", *(f"waypoint {i}" for i in range(1, len(points)))]
    on_floor, clearance = plan.contains(points), plan.clearance_m(points)
    for label, point, inside, room in zip(labels, points, on_floor, clearance, strict=True):
        where = f"robot {route.robot}: {label} {_place(point)}"
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
            f"robot {route.robot}: the way from {labels[start]} {_place(points[start])} "
            f"to {labels[end]} {_place(points[end])}"
        )
        if room < 0:
            raise InputError(f"{where} leads through a wall")
        if room < WIDTH_M / 2:
            raise InputError(
                f"{where} passes a wall at {room:.2f} m, the robot needs {WIDTH_M / 2:.2f} m"
            )


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
        frame_interval_s: a multiple of the controller's period, 1/30 s.

    Raises:
        InputError: an impossible route or frame interval; a robot that hits something or is stuck
            (names robot, time and place).
    """
    check_routes(plan, routes)
    controls_per_frame = _controls_per_frame(frame_interval_s)
    with World() as world:
        ground = world.start_physics()
        world.add_solid_walls(plan)
        robots = [P3at(world, route.T_world_start) for route in routes]
        drivers = [
            _Driver(route, robot, settings) for route, robot in zip(routes, robots, strict=True)
        ]
        names = {robot.body: route.robot for route, robot in zip(routes, robots, strict=True)}
        world.step(round(SETTLING_S * PHYSICS_HZ))
        encoder_zero = np.stack([robot.wheel_angles() for robot in robots])
        poses = np.empty((len(robots), n_frames, 3))
        wheels = np.empty((len(robots), n_frames, 2))
        for frame in range(n_frames):
            for i, robot in enumerate(robots):
                poses[i, frame] = robot.pose()
                wheels[i, frame] = robot.wheel_angles() - encoder_zero[i]
            for control in range(controls_per_frame if frame + 1 < n_frames else 0):
                time_s = frame * frame_interval_s + control / CONTROL_HZ
                now = [robot.pose() for robot in robots]
                for i, driver in enumerate(drivers):
                    driver.control(time_s, now[i], now[:i] + now[i + 1 :])
                world.step(STEPS_PER_CONTROL)
                for driver in drivers:
                    driver.refuse_contact(time_s, ground, names)
    time_s = np.arange(n_frames, dtype=np.float64) * frame_interval_s
    return Trajectory(tuple(route.robot for route in routes), time_s, poses, wheels)


def _controls_per_frame(frame_interval_s: float) -> int:
    controls = frame_interval_s * CONTROL_HZ
    if not controls > 0.5 or abs(controls - round(controls)) > 1e-9 * controls:
        raise InputError(
            f"frame_interval_s is {frame_interval_s}: must be a multiple of 1/{CONTROL_HZ} s"
        )
    return round(controls)


class _Driver:
    """Steers one robot from waypoint to waypoint by its true pose."""

    def __init__(self, route: Route, robot: P3at, settings: DriverSettings) -> None:
        self._route, self._robot, self._settings = route, robot, settings
        self._target = 0
        self._done = False
        self._speed_m_s = 0.0
        self._turn_rad_s = 0.0
        self._nearest_m = np.inf
        self._progress_s = 0.0
        self._waiting = False

    def control(self, time_s: float, pose: Float, others: list[Float]) -> None:
        """One step of the controller."""
        settings = self._settings
        self._advance(time_s, pose)
        speed, turn = (0.0, 0.0) if self._done else self._wish(pose)
        self._waiting = speed > 0 and self._must_wait(pose, others)
        if self._waiting:
            speed = turn = 0.0
        self._speed_m_s = _towards(self._speed_m_s, speed, settings.acceleration_m_s2 / CONTROL_HZ)
        self._turn_rad_s = _towards(
            self._turn_rad_s, turn, settings.turn_acceleration_rad_s2 / CONTROL_HZ
        )
        difference = self._turn_rad_s * SKID_TRACK_M / 2
        left, right = self._speed_m_s - difference, self._speed_m_s + difference
        self._robot.drive(left / WHEEL_RADIUS_M, right / WHEEL_RADIUS_M)

    def _advance(self, time_s: float, pose: Float) -> None:
        """Go on to the next waypoint; refuse to go on where nothing moves."""
        distance = self._distance_m(pose)
        if not self._done and distance < self._settings.arrival_m:
            self._target += 1
            if self._target == len(self._route.waypoints_m):
                self._done = not self._route.loop
                self._target = 0
            self._nearest_m, self._progress_s = np.inf, time_s
            distance = self._distance_m(pose)
        if self._done or distance < self._nearest_m - 0.05:
            self._nearest_m, self._progress_s = distance, time_s
        if time_s - self._progress_s > self._settings.patience_s:
            why = "waits for another robot" if self._waiting else "is stuck"
            raise InputError(
                f"robot {self._route.robot}: {why} at {_place(pose)} since t = "
                f"{self._progress_s:.1f} s, on the way to waypoint {self._target + 1} "
                f"{_place(self._route.waypoints_m[self._target])}"
            )

    def _distance_m(self, pose: Float) -> float:
        return float(np.hypot(*(self._route.waypoints_m[self._target] - pose[:2])))

    def _wish(self, pose: Float) -> tuple[float, float]:
        """Speed and turn rate towards the waypoint: slower the more it lies to the side."""
        settings = self._settings
        along = self._route.waypoints_m[self._target] - pose[:2]
        error = float(wrap(np.arctan2(along[1], along[0]) - pose[2]))
        turn = float(
            np.clip(HEADING_GAIN_PER_S * error, -settings.turn_rate_rad_s, settings.turn_rate_rad_s)
        )
        return settings.speed_m_s * max(0.0, 1 - abs(error) / settings.turn_in_place_rad), turn

    def _must_wait(self, pose: Float, others: list[Float]) -> bool:
        """Whether another robot is near, ahead, and in the way."""
        for other in others:
            x, y, _ = between(pose, other)
            if 0 < x < self._settings.give_way_m and abs(y) < 2 * OUTER_RADIUS_M:
                return True
        return False

    def refuse_contact(self, time_s: float, ground: int, names: dict[int, str]) -> None:
        """Raise InputError when the robot touches anything but the ground."""
        touched = self._robot.touched_bodies() - {ground}
        if touched:
            body = min(touched)
            what = f"robot {names[body]}" if body in names else "a wall"
            raise InputError(
                f"robot {self._route.robot}: hits {what} at {_place(self._robot.pose())}, "
                f"t = {time_s:.1f} s"
            )


def _towards(value: float, target: float, step: float) -> float:
    return value + float(np.clip(target - value, -step, step))


def _place(point: Float) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"
