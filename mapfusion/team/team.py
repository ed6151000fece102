"""Team of robots that drive in lock step and exchange maps over a link."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.mapping import Frame
from mapfusion.geometry.numerics import Float, generator
from mapfusion.team.link import Link, LinkParameters, Transmission
from mapfusion.team.robot import Event, Merging, RobotInput, TeamRobot


class Moment(NamedTuple):
    """What happens in one frame of a team.

    Attributes:
        iteration: number of the frame.
        frames: result of each robot's filter; None after the end of its log.
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
        distance_m: distance of two robots, given their indices, in a frame; None: all robots hear
            each other.
    """

    def __init__(
        self,
        given: Sequence[RobotInput],
        merging: Merging,
        link: LinkParameters,
        seed: int,
        distance_m: Callable[[int, int, int], float] | None = None,
    ) -> None:
        self.robots = [TeamRobot(each, merging, seed) for each in given]
        self._link = Link(len(given), link, generator(seed, "link"))
        self._distance_m = distance_m or (lambda a, b, iteration: 0.0)
        longest = max(given, key=lambda each: len(each.log)).log
        self.time_s: Float = longest.time_s

    def step(self, iteration: int) -> Moment:
        """Process a frame: all filters, then messages, then merges where they are due."""
        frames, seconds = list[Frame | None](), list[float]()
        for robot in self.robots:
            started_s = time.perf_counter()
            frames.append(None if robot.has_ended else robot.step())
            seconds.append(time.perf_counter() - started_s)
        now_s = float(self.time_s[iteration])
        is_due = iteration > 0 and iteration % self._link.parameters.every == 0
        sent = self._send(iteration, now_s) if is_due else []
        for each in self._link.arrived(now_s):
            self.robots[each.receiver].receive(self.robots[each.sender].name, each.message)
        events = [event for robot in self.robots for event in robot.merge()] if is_due else []
        return Moment(iteration, frames, seconds, sent, events)

    def _send(self, iteration: int, now_s: float) -> list[Transmission]:
        """Send each robot's map to the others; a busy transmitter waits for the next exchange."""
        sent = []
        for a, robot in enumerate(self.robots):
            robot.smooth()
            if not self._link.is_free(a, now_s):
                continue
            for b, other in enumerate(self.robots):
                message = robot.message_to(other.name) if b != a else None
                if message is not None:
                    distance_m = self._distance_m(a, b, iteration)
                    sent.append(self._link.send(a, b, message, now_s, distance_m))
        return sent


def path_distances(T_world_robot: Sequence[Float]) -> Callable[[int, int, int], float]:
    """Return a function of two robots and a frame: the distance between their true poses.

    Args:
        T_world_robot: true poses of each robot, shape (T_k, 3).
    """

    def distance_m(a: int, b: int, iteration: int) -> float:
        at = [T_world_robot[k][min(iteration, len(T_world_robot[k]) - 1), :2] for k in (a, b)]
        return float(np.linalg.norm(at[0] - at[1]))

    return distance_m
