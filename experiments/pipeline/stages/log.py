"""Stages `observed` and `log`: features of one robot become observations, and its log."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.pipeline.stage import Job, StageKind
from experiments.pipeline.stages.features import read_features
from experiments.pipeline.store import link_or_copy
from experiments.pipeline.tables import TRACKS, write_rows
from mapfusion.attitude import FILE as ATTITUDE_FILE
from mapfusion.attitude import write_attitude
from mapfusion.camera import StereoCamera
from mapfusion.geometry.numerics import Float, generator
from mapfusion.robot_log import (
    write_frames,
    write_observations,
    write_truth_points,
    write_truth_poses,
)
from mapfusion.vision.attitude_filter import AttitudeEstimator, AttitudeMeasurement
from mapfusion.vision.front_end import FrontEndParameters, Observer, concatenate_observations
from sim.odometry import OdometryNoise, add_noise, calibrated_track_m, encoder_increments
from sim.trajectory import TRAJECTORY_FILE, AttitudeNoise, Trajectory, read_trajectory

_LABEL = "track features"
_LOGGED = ("observations.parquet", "truth_points.parquet")  # files of both stages


@dataclass(frozen=True)
class ObservedSettings:
    """Settings of a robot's observations, in addition to its features."""

    seed: int
    robot: str
    n_frames: int
    camera: StereoCamera
    attitude: AttitudeNoise
    vision: FrontEndParameters  # tracks, noise and depths; the rest has default values
    images_at: int
    images: int


def run_observed(settings: ObservedSettings, job: Job) -> None:
    """Track features over the frames and write the observations and their truth.

    If the robot's body sways, its measured attitude levels the observations and is written too.
    """
    observer = Observer.of(settings.camera, settings.vision)
    tilt_rad = measured_tilt(settings, read_trajectory(job.inputs["drive"] / TRAJECTORY_FILE))
    levelling = None if tilt_rad is None else AttitudeEstimator()
    # the floor is level, so the height is known
    sigma = np.array([settings.attitude.sigma_rad, settings.attitude.sigma_rad, 0.0])
    observed, truth, tracks = [], [], []
    with_images = range(settings.images_at, settings.images_at + settings.images)
    frames = read_features(job.inputs["features"], settings.n_frames)
    for iteration, (extracted, points) in enumerate(frames):
        if levelling is None or tilt_rad is None:
            frame = observer.observe(extracted)
            observed.append(frame.observations)
        else:
            measured = AttitudeMeasurement(np.array([*tilt_rad[iteration], 0.0]), sigma)
            turn = levelling.expected_turn(measured)
            frame = observer.observe(extracted, R_after_before=turn)
            levelling.add(frame.tracks.motion, measured)
            observed.append(levelling.to_level_frame(frame.observations))
        state = frame.tracks
        truth.append(points.at(state.uv_px - extracted.uv_px)[frame.rows])
        if iteration in with_images:
            seen = pd.DataFrame(state.uv_px, columns=pd.Index(["u_px", "v_px"]))
            seen = seen.assign(robot=settings.robot, iteration=iteration)
            tracks.append(seen.assign(track=state.track_id, length=state.length))
    write_observations(job.output, *concatenate_observations(observed))
    write_truth_points(job.output, np.concatenate(truth))
    write_attitude(job.output, None if levelling is None else levelling.attitude)
    write_rows(job.output / "tracks.parquet", TRACKS, pd.concat(tracks) if tracks else [])


OBSERVED_STAGE = StageKind("observed", _LABEL, run_observed, (*_LOGGED, "tracks.parquet"))


def measured_tilt(settings: ObservedSettings, trajectory: Trajectory) -> Float | None:
    """Return measured roll and pitch (T, 2); None if the robot assumes a level body."""
    if trajectory.tilt_rad is None or not settings.attitude.measured:
        return None
    rng = generator(settings.seed, "attitude", settings.robot)
    return settings.attitude.applied(trajectory.tilt_rad[trajectory.index(settings.robot)], rng)


@dataclass(frozen=True)
class LogSettings:
    """Settings of a robot's log, in addition to trajectory and observations."""

    seed: int
    robot: str
    odometry: OdometryNoise


def run_log(settings: LogSettings, job: Job) -> None:
    """Write odometry, observations and truth to the folder of the log."""
    trajectory = read_trajectory(job.inputs["drive"] / TRAJECTORY_FILE)
    index = trajectory.index(settings.robot)
    odometry = measured_odometry(settings, trajectory)
    write_frames(job.output, settings.robot, False, trajectory.time_s, odometry)
    for name in _LOGGED:
        link_or_copy(job.inputs["observed"] / name, job.output / name)
    attitude = job.inputs["observed"] / ATTITUDE_FILE
    if attitude.exists():  # for a body that sways
        link_or_copy(attitude, job.output / ATTITUDE_FILE)
    write_truth_poses(job.output, trajectory.T_world_robot[index])


LOG_STAGE = StageKind("log", _LABEL, run_log, ("frames.parquet", *_LOGGED, "truth_poses.parquet"))


def measured_odometry(settings: LogSettings, trajectory: Trajectory) -> Float:
    """Return the noisy wheel odometry of a robot as increments, shape (T, 3)."""
    wheel_rad = trajectory.wheel_rad[trajectory.index(settings.robot)]
    rng = generator(settings.seed, "odometry", settings.robot)
    increments = encoder_increments(wheel_rad, calibrated_track_m())
    return add_noise(increments, settings.odometry, rng)
