"""Robots that drive in circles among labelled points, their maps and their teams."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from mapfusion.align.aligners import make_aligner
from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fusion.fusers import make_fuser
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose, inverse, transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import Observations, RobotLog, first_frames
from mapfusion.smoother.smooth import Smoothed, SmootherParameters, smooth, smoothed_map
from mapfusion.team.adoption import ADOPTED, TimedMap
from mapfusion.team.link import LinkParameters
from mapfusion.team.robot import Event, Merging, RobotInput, TeamRobot
from mapfusion.team.team import Moment, Team
from mapfusion.verification.registration import Registration
from tests.mapfusion.fastslam.landmark_worlds import unit
from tests.mapfusion.smoother.white_noise_logs import dead_reckoned, white_noise_log

SIGMA_M, RANGE_M = 0.02, 5.0
STEP, STEP_SIGMA = np.array([0.3, 0.0, 0.06]), np.array([0.01, 0.005, 0.002])
NORTH, SOUTH = (0.0, -5.0, 0.0), (0.0, 5.0, 3.1)
FILTER = FastSlamParameters(n_particles=20, association=Association.LABEL, planar=True)
EVERY = 10


class Drive(NamedTuple):
    """Log of a robot with the truth: its path (T, 3) and points (L, 2) in the world."""

    log: RobotLog
    T_world_robot: Float
    point_world_m: Float


def drive(
    seed: int,
    name: str = "north",
    start: Sequence[float] = NORTH,
    n_frames: int = 80,
    centre_m: Sequence[float] = (0.0, 0.0),
) -> Drive:
    """Drive on a circle with a radius of 5 m among 60 points, which labels number.

    The points depend on their centre alone, the noise on seed and name.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    n_points, first = 60, int(abs(centre_m[0]) + abs(centre_m[1]))
    point_m = np.random.default_rng(4 + first).uniform(-8, 8, (n_points, 2)) + centre_m
    odometry = np.tile(STEP, (n_frames, 1)) + rng.normal(0, STEP_SIGMA, (n_frames, 3))
    odometry[0] = 0.0
    pose, path, frame, seen, label = np.array(start), [], [], [], []
    for k in range(n_frames):
        pose = compose(pose, STEP) if k else pose
        path.append(pose)
        local_m = transform_points(inverse(pose), point_m)
        near = np.flatnonzero(np.hypot(*local_m.T) < RANGE_M)
        frame += [k] * len(near)
        label += (first * n_points + near).tolist()
        seen += (local_m[near] + rng.normal(0, SIGMA_M, (len(near), 2))).tolist()
    position_m = np.column_stack([seen, np.zeros(len(seen))])
    covariance_m2 = np.tile(np.diag([SIGMA_M**2, SIGMA_M**2, 0.0]), (len(seen), 1, 1))
    seen_as = np.array(label, dtype=np.int32)
    observations = Observations(position_m, covariance_m2, label=seen_as)
    time_s = np.arange(n_frames) / 2
    log = RobotLog(name, True, time_s, odometry, np.array(frame), observations)
    return Drive(log, np.array(path), point_m)


def given(*drives: Drive) -> list[RobotInput]:
    return [RobotInput(each.log, FILTER, SmootherParameters()) for each in drives]


def merging() -> Merging:
    return Merging(Registration(make_aligner("ransac")), make_fuser())


class Voyage(NamedTuple):
    """Team after its drive, and all that happened."""

    team: Team
    drives: tuple[Drive, ...]
    moments: list[Moment]

    @property
    def events(self) -> list[Event]:
        return [event for moment in self.moments for event in moment.events]

    def robot(self, name: str) -> TeamRobot:
        return next(each for each in self.team.robots if each.name == name)


def voyage(*drives: Drive, seed: int = 0, link: LinkParameters | None = None) -> Voyage:
    """Let a team drive to the end of its longest log."""
    link = LinkParameters(every=EVERY) if link is None else link
    team = Team(given(*drives), merging(), link, seed)
    return Voyage(team, drives, [team.step(k) for k in range(len(team.time_s))])


@cache
def usual_voyage() -> Voyage:
    return voyage(drive(0), drive(0, "south", SOUTH))


def kinds(events: Sequence[Event], robot: str) -> list[tuple[str, str]]:
    """Return what happened to a robot, as pairs of kind and other robot."""
    return [(event.kind, event.other) for event in events if event.robot == robot]


def adopted(landmarks: LandmarkMap) -> LandmarkMap:
    """Return the landmarks that the robot has not observed itself before it adopted them."""
    return landmarks[landmarks.source_observation >= ADOPTED]


def errors_m(landmarks: LandmarkMap, drive: Drive) -> Float:
    """Return the errors (N, 2) of landmarks in the frame of a robot."""
    assert landmarks.label is not None
    true_m = transform_points(inverse(drive.T_world_robot[0]), drive.point_world_m)
    return landmarks.position_m[:, :2] - true_m[landmarks.label % len(true_m)]


def path_errors_m(path: Float, drive: Drive) -> Float:
    """Return the distances (T,) of a path's poses from the truth."""
    true = between(drive.T_world_robot[0], drive.T_world_robot[: len(path)])
    return np.linalg.norm((path - true)[:, :2], axis=1)


def smoothed_of(log: RobotLog, stray_m: float = 0.0) -> tuple[Smoothed, TimedMap]:
    """Smooth a log with the associations that its labels tell."""
    label = log.observations.label
    assert label is not None
    _, first, inverse_ = np.unique(label, return_index=True, return_inverse=True)
    parameters = SmootherParameters(stray_m=stray_m)
    smoothed = smooth(log, first[inverse_], dead_reckoned(log), parameters)
    return smoothed, TimedMap.of(log, smoothed, smoothed_map(log, smoothed))


@cache
def described_log(planar: bool) -> RobotLog:
    """Return a log of 90 frames with labels and descriptors of 64 numbers."""
    rng = np.random.default_rng(3)
    log = white_noise_log(rng, 90, 80, planar).log
    label = log.observations.label
    assert label is not None
    look = unit(rng.standard_normal((80, 64)))[label] + 0.01 * rng.standard_normal((len(label), 64))
    return replace(log, observations=replace(log.observations, descriptor=look.astype(np.float32)))


@cache
def described_map(n_frames: int, planar: bool = False) -> TimedMap:
    """Return the map of the first frames of `described_log`."""
    return smoothed_of(first_frames(described_log(planar), n_frames))[1]
