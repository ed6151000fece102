"""Stage: one robot's features, tracked into observations; odometry plays no part in them."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.run.frames import write_rows
from experiments.run.job import Job
from experiments.run.stage_tables import TRACKS
from experiments.run.stages.drive import TRAJECTORY_FILE
from experiments.run.stages.features import read_features
from experiments.scenario.randomness import generator
from mapfusion.attitude import write_attitude
from mapfusion.camera import StereoCamera
from mapfusion.robot_log import write_observations, write_truth_points
from mapfusion.vision.attitude_filter import Measured
from mapfusion.vision.frontend import FrontEndParameters
from mapfusion.vision.levelling import Levelling
from mapfusion.vision.observing import Observer, joined
from sim.sway import AttitudeNoise
from sim.trajectory import Trajectory, read_trajectory

LABEL = "track features"
WRITES = ("observations.parquet", "truth_points.parquet", "tracks.parquet")


@dataclass(frozen=True)
class ObservedSettings:
    """All that a robot's observations depend on, beside its features."""

    seed: int
    robot: str
    n_frames: int
    camera: StereoCamera
    attitude: AttitudeNoise
    vision: FrontEndParameters  # tracks, noise and depths; the rest stays at its defaults
    images_at: int
    images: int


def run(settings: ObservedSettings, job: Job) -> None:
    """Track features over the frames and write the observations and their truth.

    Those of a robot whose body sways are levelled by the attitude that it measures, which is
    written beside them.
    """
    observer = Observer.of(settings.camera, settings.vision)
    measured = _measured(settings, read_trajectory(job.inputs["drive"] / TRAJECTORY_FILE))
    levelling = None if measured is None else Levelling()
    observed, truth, tracks = [], [], []
    kept = range(settings.images_at, settings.images_at + settings.images)
    frames = read_features(job.inputs["features"], settings.n_frames)
    for iteration, (found, points) in enumerate(frames):
        if levelling is None or measured is None:
            frame = observer.observe(found)
            observed.append(frame.observations)
        else:
            turn = levelling.expected_turn(measured[iteration])
            frame = observer.observe(found, R_after_before=turn)
            levelling.add(frame.tracks.motion, measured[iteration])
            observed.append(levelling.applied(frame.observations))
        state = frame.tracks
        truth.append(points.at(state.uv_px - found.uv_px)[frame.rows])
        if iteration in kept:
            seen = pd.DataFrame(state.uv_px, columns=pd.Index(["u_px", "v_px"]))
            seen = seen.assign(robot=settings.robot, iteration=iteration)
            tracks.append(seen.assign(track=state.track_id, length=state.length))
    write_observations(job.output, *joined(observed))
    write_truth_points(job.output, np.concatenate(truth))
    write_attitude(job.output, None if levelling is None else levelling.attitude)
    write_rows(job.output / "tracks.parquet", TRACKS, pd.concat(tracks) if tracks else [])


def _measured(settings: ObservedSettings, trajectory: Trajectory) -> list[Measured] | None:
    """What the robot is told of its attitude, frame by frame; None: nothing, it is level to it.

    Robots drive on one level floor, so their heights are known.
    """
    if trajectory.tilt_rad is None or not settings.attitude.measured:
        return None
    rng = generator(settings.seed, "attitude", settings.robot)
    told = settings.attitude.applied(trajectory.tilt_rad[trajectory.index(settings.robot)], rng)
    sigma = np.array([settings.attitude.sigma_rad, settings.attitude.sigma_rad, 0.0])
    return [Measured(np.array([*angles, 0.0]), sigma) for angles in told]
