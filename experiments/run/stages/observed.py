"""Stage: one robot's features, tracked into observations; odometry plays no part in them."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.run.frames import write_rows
from experiments.run.job import Job
from experiments.run.stage_tables import TRACKS
from experiments.run.stages.features import read_features
from mapfusion.camera import StereoCamera
from mapfusion.robot_log import write_observations, write_truth_points
from mapfusion.vision.frontend import FrontEndParameters
from mapfusion.vision.observing import Observer, joined

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
    observer = Observer.of(settings.camera, settings.vision)
    observed, truth, tracks = [], [], []
    kept = range(settings.images_at, settings.images_at + settings.images)
    frames = read_features(job.inputs["features"], settings.n_frames)
    for iteration, (found, points) in enumerate(frames):
        frame = observer.observe(found)
        state = frame.tracks
        observed.append(frame.observations)
        truth.append(points.at(state.uv_px - found.uv_px)[frame.rows])
        if iteration in kept:
            seen = pd.DataFrame(state.uv_px, columns=pd.Index(["u_px", "v_px"]))
            seen = seen.assign(robot=settings.robot, iteration=iteration)
            tracks.append(seen.assign(track=state.track_id, length=state.length))
    write_observations(job.output, *joined(observed))
    write_truth_points(job.output, np.concatenate(truth))
    write_rows(job.output / "tracks.parquet", TRACKS, pd.concat(tracks) if tracks else [])
