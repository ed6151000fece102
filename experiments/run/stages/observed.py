"""Stage: one robot's features, tracked into observations; odometry plays no part in them."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from experiments.run.frames import write_rows
from experiments.run.job import Job
from experiments.run.stage_tables import TRACKS
from experiments.run.stages.features import read_features
from mapfusion.camera import StereoCamera
from mapfusion.robot_log import Observations, write_observations, write_truth_points
from mapfusion.vision.frontend import FrontEndParameters, observable, observe
from mapfusion.vision.tracks import Tracker

LABEL = "track features"
WRITES = ("observations.parquet", "truth_points.parquet", "tracks.parquet")


@dataclass(frozen=True)
class ObservedSettings:
    """All that a robot's observations depend on, beside its features."""

    robot: str
    n_frames: int
    camera: StereoCamera
    vision: FrontEndParameters  # tracks, noise and depths; the rest stays at its defaults
    images_at: int
    images: int


def run(settings: ObservedSettings, job: Job) -> None:
    """Track features over the frames and write the observations and their truth."""
    camera, vision = settings.camera, settings.vision
    tracker = Tracker(vision.tracks, camera, vision.sigma_uv_px)
    observed, track, truth, tracks = [], [], [], []
    kept = range(settings.images_at, settings.images_at + settings.images)
    frames = read_features(job.inputs["features"], settings.n_frames)
    for iteration, (found, points) in enumerate(frames):
        state = tracker.update(found)
        lasting = tracker.landmarks(state)
        own = replace(found, uv_px=state.uv_px, disparity_px=state.disparity_px)
        rows = observable(camera, own, lasting, vision)
        observed.append(observe(camera, own, lasting, vision))
        track.append(state.track_id[rows])
        truth.append(points.at(state.uv_px - found.uv_px)[rows])
        if iteration in kept:
            seen = pd.DataFrame(state.uv_px, columns=pd.Index(["u_px", "v_px"]))
            seen = seen.assign(robot=settings.robot, iteration=iteration)
            tracks.append(seen.assign(track=state.track_id, length=state.length))
    iterations = np.repeat(np.arange(len(observed)), [len(own) for own in observed])
    names = ("position_m", "covariance_m2", "descriptor", "uvd_px")
    joined = {name: np.concatenate([getattr(own, name) for own in observed]) for name in names}
    observations = Observations(**joined, track=np.concatenate(track))
    write_observations(job.output, iterations, observations)
    write_truth_points(job.output, np.concatenate(truth))
    write_rows(job.output / "tracks.parquet", TRACKS, pd.concat(tracks) if tracks else [])
