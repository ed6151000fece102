"""Stage: a team of robots that exchange maps while they drive and go on in the joint map.

All robots are filtered again, in lock step and in one process, so that the result does not depend
on the number of workers.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job, StageKind
from experiments.pipeline.stages.slam import evaluated_iterations, log_as_filtered, noise_factor
from experiments.pipeline.stages.smooth import log_to_smooth
from experiments.pipeline.tables import (
    BOOL,
    COVARIANCE,
    FLOAT,
    INT,
    MOTION,
    TEXT,
    fields,
    write_rows,
)
from experiments.plugins.discovery import callable_aligner
from mapfusion.align.correspondences import MatchParameters
from mapfusion.align.refinement import Refinement
from mapfusion.attitude import read_attitude
from mapfusion.errors import InputError
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.files import (
    POSE_FIELDS,
    float_fields,
    named_columns,
    point_columns,
    point_fields,
    schema,
)
from mapfusion.fusion.fusers import MergeParameters, make_fuser
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import read_true_poses
from mapfusion.smoother.smooth import SmootherParameters
from mapfusion.team.adoption import ADOPTED
from mapfusion.team.link import LinkParameters
from mapfusion.team.robot import Event, Merging, Origin, RobotInput, TeamRobot
from mapfusion.team.team import Team, path_distances
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.regions import EvidenceParameters
from mapfusion.verification.registration import Registration
from mapfusion.verification.verdict import Verifier

_UPPER = np.triu_indices(3)
_STEP = fields(robot=TEXT, iteration=INT)
# Online pose of each robot in each frame, and its observations: all, and those of landmarks that
# other robots mapped.
STEPS = schema(
    "team.steps", 1, [*_STEP, *float_fields(POSE_FIELDS), *fields(n_observed=INT, n_shared=INT)]
)
# Path of the most probable particle at each evaluated iteration.
PATHS = schema("team.paths", 1, [*fields(evaluated=INT), *_STEP, *float_fields(POSE_FIELDS)])
# Landmarks of each robot at each evaluated iteration, with the observation that created each of
# them: a row of the log of the robot `origin`.
MAPS = schema(
    "team.maps", 1, [*_STEP, *point_fields(), *fields(count=INT, origin=TEXT, row=pa.int64())]
)
EVENTS = schema(
    "team.events",
    1,
    [
        *_STEP,
        *fields(other=TEXT, event=TEXT),
        *float_fields([*MOTION, *COVARIANCE]),
        *fields(reason=TEXT),
    ],
)
# arrives_s: time of arrival; infinite for lost messages.
MESSAGES = schema(
    "team.messages",
    1,
    fields(
        iteration=INT,
        sender=TEXT,
        receiver=TEXT,
        n_bytes=INT,
        n_landmarks=INT,
        n_new=INT,
        arrives_s=FLOAT,
        lost=BOOL,
    ),
)
_TABLES = {"steps": STEPS, "paths": PATHS, "maps": MAPS, "events": EVENTS, "messages": MESSAGES}
WRITES = tuple(f"{name}.parquet" for name in _TABLES)


@dataclass(frozen=True)
class TeamSettings:
    """Settings of a team, in addition to its logs.

    `origin` identifies a plug-in aligner; empty for ours.
    """

    seed: int
    filter: FastSlamParameters
    smoother: SmootherParameters
    max_memory_gb: float
    min_count: int
    every: int
    robots: tuple[str, ...]
    link: LinkParameters
    starts: dict[str, int]
    carried: dict[str, str]
    method: str
    parameters: dict[str, Any]
    time_limit_s: float
    origin: dict[str, str]
    match: MatchParameters
    refinement: Refinement
    acceptance: Acceptance
    evidence: EvidenceParameters
    merge: MergeParameters


def run(settings: TeamSettings, job: Job) -> dict[str, float]:
    """Let the team drive; write paths, maps, events and messages."""
    aligner = callable_aligner(settings.method, settings.parameters, settings.time_limit_s)
    verifier = Verifier(settings.acceptance, settings.evidence, settings.refinement)
    registration = Registration(aligner, settings.refinement, verifier)
    merging = Merging(registration, make_fuser(), settings.match, settings.merge)
    given = [_input_of(settings, job, name) for name in settings.robots]
    distance_m = None
    if settings.link.range_m is not None:
        true = [read_true_poses(job.inputs[f"log {name}"]) for name in settings.robots]
        known = [poses for poses in true if poses is not None]
        if len(known) < len(true):
            name = settings.robots[next(k for k, poses in enumerate(true) if poses is None)]
            raise InputError(f"team.link.range_m: the true poses of {name} are needed, but unknown")
        distance_m = path_distances(known)
    team = Team(given, merging, settings.link, settings.seed, distance_m)
    evaluated = [set(evaluated_iterations(len(each.log), settings.every)) for each in given]
    frames: dict[str, list[pd.DataFrame]] = {"maps": [], "paths": []}
    lists: dict[str, list[dict[str, Any]]] = {"steps": [], "events": [], "messages": []}
    seconds: dict[str, float] = {"alone": 0.0, "joint": 0.0}
    for k in range(len(team.time_s)):
        moment = team.step(k)
        done = zip(team.robots, moment.frames, moment.seconds, evaluated, strict=True)
        for robot, frame, took_s, own in done:
            if frame is None:
                continue
            seconds["joint" if robot.adopted else "alone"] += took_s
            lists["steps"].append(_step_row(robot, frame.result.best_pose))
            if frame.iteration in own:
                frames["maps"].append(_map_rows(robot, frame.iteration))
                path = robot.filter.best_path()
                poses = {"iteration": np.arange(len(path))} | named_columns(POSE_FIELDS, path)
                at = {"robot": robot.name, "evaluated": frame.iteration}
                frames["paths"].append(pd.DataFrame(poses).assign(**at))
        lists["events"] += [_event_row(event) for event in moment.events]
        for sent in moment.sent:
            message = sent.message
            row = {"iteration": k, "sender": team.robots[sent.sender].name}
            row |= {"receiver": team.robots[sent.receiver].name, "n_bytes": message.n_bytes}
            row |= {"n_landmarks": len(message.landmarks), "n_new": int(message.is_new.sum())}
            row |= {"arrives_s": sent.arrives_s, "lost": sent.is_lost}
            lists["messages"].append(row)
    for name, table in _TABLES.items():
        made = pd.concat(frames[name]) if name in frames else lists[name]
        write_rows(job.output / f"{name}.parquet", table, made)
    return seconds


TEAM_STAGE = StageKind("team", "drive as a team", run, WRITES)


def _input_of(settings: TeamSettings, job: Job, name: str) -> RobotInput:
    """Return a robot's log and settings, as its own stages use them."""
    folder, slam = job.inputs[f"log {name}"], job.inputs[f"slam {name}"]
    log, covariance = log_as_filtered(folder, slam)
    motion = settings.filter.motion.scaled(noise_factor(slam))
    smoother = log_to_smooth(folder, slam, settings.smoother)[1]
    own = replace(settings.filter, motion=motion)
    attitude = read_attitude(folder, len(log))
    more = settings.max_memory_gb, settings.starts.get(name, 0), settings.carried.get(name, "")
    return RobotInput(log, own, smoother, settings.min_count, covariance, attitude, *more)


def _step_row(robot: TeamRobot, pose: np.ndarray) -> dict[str, Any]:
    """Return the row of a robot's last frame."""
    row = dict(zip(POSE_FIELDS, pose, strict=True))
    row |= {"robot": robot.name, "iteration": robot.iteration}
    row |= {"n_observed": len(robot.filter.last_associations())}
    return row | {"n_shared": robot.n_shared_now()}


def _map_rows(robot: TeamRobot, iteration: int) -> pd.DataFrame:
    """Return the landmarks of a robot's map."""
    landmarks: LandmarkMap = robot.filter.best_map(robot.given.min_count, with_drift=True)
    source = landmarks.source_observation.tolist()
    origins = [
        robot.origins[each] if each >= ADOPTED else Origin(robot.name, each) for each in source
    ]
    points = point_columns(landmarks.position_m, landmarks.covariance_m2)
    rows = pd.DataFrame(points | {"count": landmarks.count})
    rows["origin"] = [each.robot for each in origins]
    rows["row"] = [each.row for each in origins]
    return rows.assign(robot=robot.name, iteration=iteration)


def _event_row(event: Event) -> dict[str, Any]:
    """Return the row of an event."""
    row = {"robot": event.robot, "iteration": event.iteration, "other": event.other}
    row |= {"event": event.kind, "reason": event.reason}
    row |= dict(zip(MOTION, event.T_robot_other, strict=True))
    row |= dict(zip(COVARIANCE, event.covariance[_UPPER], strict=True))
    return row
