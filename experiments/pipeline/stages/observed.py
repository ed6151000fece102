"""Stage: features of one robot are tracked and become observations, without odometry."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.drive import TRAJECTORY_FILE
from experiments.pipeline.stages.features import read_features
from experiments.pipeline.tables import TRACKS, write_rows
from experiments.scenario.seeds import generator
from mapfusion.attitude import write_attitude
from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.numerics import Float
from mapfusion.robot_log import write_observations, write_truth_points
from mapfusion.vision.attitude_filter import AttitudeEstimator, AttitudeMeasurement
from mapfusion.vision.front_end import FrontEndParameters, Observer, concatenate_observations
from sim.trajectory import AttitudeNoise, Trajectory, read_trajectory

LABEL = "track features"
WRITES = ("observations.parquet", "truth_points.parquet", "tracks.parquet")


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


def run(settings: ObservedSettings, job: Job) -> None:
    """Track features over the frames and write the observations and their truth.

    If the robot's body sways, its measured attitude levels the observations and is written too.
    """
    observer = Observer.of(settings.camera, settings.vision)
    told = told_tilt(settings, read_trajectory(job.inputs["drive"] / TRAJECTORY_FILE))
    levelling = None if told is None else AttitudeEstimator()
    # the floor is level, so the height is known
    sigma = np.array([settings.attitude.sigma_rad, settings.attitude.sigma_rad, 0.0])
    observed, truth, tracks = [], [], []
    kept = range(settings.images_at, settings.images_at + settings.images)
    frames = read_features(job.inputs["features"], settings.n_frames)
    for iteration, (found, points) in enumerate(frames):
        if levelling is None or told is None:
            frame = observer.observe(found)
            observed.append(frame.observations)
        else:
            measured = AttitudeMeasurement(np.array([*told[iteration], 0.0]), sigma)
            turn = levelling.expected_turn(measured)
            frame = observer.observe(found, R_after_before=turn)
            levelling.add(frame.tracks.motion, measured)
            observed.append(levelling.to_level_frame(frame.observations))
        state = frame.tracks
        truth.append(points.at(state.uv_px - found.uv_px)[frame.rows])
        if iteration in kept:
            seen = pd.DataFrame(state.uv_px, columns=pd.Index(["u_px", "v_px"]))
            seen = seen.assign(robot=settings.robot, iteration=iteration)
            tracks.append(seen.assign(track=state.track_id, length=state.length))
    write_observations(job.output, *concatenate_observations(observed))
    write_truth_points(job.output, np.concatenate(truth))
    write_attitude(job.output, None if levelling is None else levelling.attitude)
    write_rows(job.output / "tracks.parquet", TRACKS, pd.concat(tracks) if tracks else [])


def told_tilt(settings: ObservedSettings, trajectory: Trajectory) -> Float | None:
    """Return measured roll and pitch (T, 2); None if the robot assumes a level body."""
    if trajectory.tilt_rad is None or not settings.attitude.measured:
        return None
    rng = generator(settings.seed, "attitude", settings.robot)
    return settings.attitude.applied(trajectory.tilt_rad[trajectory.index(settings.robot)], rng)
