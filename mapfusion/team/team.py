"""Team of robots that drive in lock step and exchange maps over a link."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.mapping import Frame
from mapfusion.geometry.numerics import Float, generator
from mapfusion.team.link import Link, LinkParameters, Transmission
from mapfusion.team.robot import Event, Merging, RobotInput, TeamRobot

# Distance of two robots by index and frame of the first, index and frame of the second.
DistanceOf = Callable[[int, int, int, int], float]
# Number of frames after which a robot that was carried elsewhere looks for itself again.
_LOST_EVERY = 5


class Moment(NamedTuple):
    """Result of one frame of a team.

    Attributes:
        iteration: number of the frame.
        frames: result of each robot's filter; None before its log and after it.
        seconds: time that each filter took.
        sent: messages that are sent.
        events: changes of what robots have adopted.
    """

    iteration: int
    frames: Sequence[Frame | None]
    seconds: Sequence[float]
    sent: Sequence[Transmission]
    events: Sequence[Event]


class Team:
    """Robots and their link.

    Args:
        given: logs and settings of the robots.
        merging: methods of the team.
        link: settings of the link.
        seed: seed of all random numbers.
        distance_m: distance of two robots; None: all robots hear each other.
    """

    def __init__(
        self,
        given: Sequence[RobotInput],
        merging: Merging,
        link: LinkParameters,
        seed: int,
        distance_m: DistanceOf | None = None,
    ) -> None:
        self.robots = [TeamRobot(each, merging, seed) for each in given]
        self._by_name = {robot.name: robot for robot in self.robots}
        self.starts = [self._start_of(each) for each in given]
        self._link = Link(len(given), link, generator(seed, "link"))
        self._distance_m = distance_m
        ends = [start + len(each.log) for start, each in zip(self.starts, given, strict=True)]
        longest = max(given, key=lambda each: len(each.log)).log
        missing = np.arange(1, 1 + max(ends) - len(longest))
        step_s = float(np.diff(longest.time_s).mean()) if len(longest) > 1 else 1.0
        self.time_s: Float = np.append(longest.time_s, longest.time_s[-1] + step_s * missing)

    def _start_of(self, given: RobotInput) -> int:
        """Return the frame of the team in which a robot's log starts."""
        if not given.predecessor:
            return given.start
        before = self._by_name[given.predecessor].given
        return self._start_of(before) + len(before.log)

    def step(self, iteration: int) -> Moment:
        """Process a frame: all filters, then messages, then merges where they are due."""
        frames, seconds = list[Frame | None](), list[float]()
        for robot, start in zip(self.robots, self.starts, strict=True):
            if iteration == start and robot.given.predecessor:
                robot.inherit(self._by_name[robot.given.predecessor])
            started_s = time.perf_counter()
            drives = iteration >= start and not robot.has_ended
            frames.append(robot.step() if drives else None)
            seconds.append(time.perf_counter() - started_s)
        now_s = float(self.time_s[iteration])
        is_due = iteration > 0 and iteration % self._link.parameters.every == 0
        sent = self._send(now_s) if is_due else []
        for each in self._link.arrived(now_s):
            self.robots[each.receiver].receive(self.robots[each.sender].name, each.message)
        events = list[Event]()
        for robot in self.robots:
            if robot.is_lost and robot.iteration > 0 and robot.iteration % _LOST_EVERY == 0:
                robot.smooth()
                events += robot.merge()
            elif is_due:
                events += robot.merge()
        return Moment(iteration, frames, seconds, sent, events)

    def _send(self, now_s: float) -> list[Transmission]:
        """Send each robot's map to the others; a busy transmitter waits for the next exchange."""
        sent = []
        for a, robot in enumerate(self.robots):
            if robot.iteration < 1:  # it has not started
                continue
            robot.smooth()
            if not self._link.is_free(a, now_s):
                continue
            for b, other in enumerate(self.robots):
                is_same = robot.name in (other.name, other.given.predecessor)
                if is_same or other.name == robot.given.predecessor:
                    continue
                message = robot.message_to(other.name)
                if message is not None:
                    distance_m = 0.0
                    if self._distance_m is not None:
                        at = a, robot.iteration, b, max(other.iteration, 0)
                        distance_m = self._distance_m(*at)
                    sent.append(self._link.send(a, b, message, now_s, distance_m))
        return sent


def path_distances(T_world_robot: Sequence[Float]) -> DistanceOf:
    """Return a function of the indices and frames of two robots: their true distance.

    Args:
        T_world_robot: true poses of each robot, shape (T_k, 3).
    """

    def distance_m(a: int, frame_a: int, b: int, frame_b: int) -> float:
        apart_m = T_world_robot[a][frame_a, :2] - T_world_robot[b][frame_b, :2]
        return float(np.linalg.norm(apart_m))

    return distance_m
