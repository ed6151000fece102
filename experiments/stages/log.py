"""Stage: one robot's log, from features (tracked into observations) and noisy odometry."""

import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd

from experiments import tables
from experiments.randomness import generator
from experiments.scenario import Scenario
from experiments.stages.features import read_features
from experiments.store import StageFolder, Store, link_or_copy
from mapfusion.robot_log import (
    Observations,
    write_frames,
    write_observations,
    write_truth_points,
    write_truth_poses,
)
from mapfusion.se2 import Float
from mapfusion.vision.frontend import observable, observe
from mapfusion.vision.tracks import Tracker
from sim.odometry import add_noise, calibrated_track_m, encoder_increments
from sim.trajectory import read_trajectory

SOURCES = (
    "mapfusion/vision",
    "mapfusion/camera.py",
    "mapfusion/robot_log.py",
    "mapfusion/se2.py",
    "mapfusion/symmetric.py",
)
SOURCES += ("mapfusion/storage.py", "sim", "experiments/stages/log.py", "experiments/tables.py")
SOURCES += ("experiments/randomness.py",)


def observed_stage(store: Store, scenario: Scenario, features: StageFolder) -> StageFolder:
    """Where this robot's observations are or will be; odometry plays no part in them."""
    resolved = scenario.resolved()
    settings = {"vision": resolved["vision"], "camera": resolved["camera"]}
    return store.stage("observed", settings | {"keep": resolved["keep"]}, [features], SOURCES)


def run_observed(
    scenario: Scenario, features: StageFolder, output: StageFolder, robot: str
) -> None:
    """Track features over the frames and write the observations and their truth."""
    started = time.perf_counter()
    assert scenario.drive is not None
    tracker = Tracker(scenario.vision.tracks, scenario.camera, scenario.vision.sigma_uv_px)
    observed: list[Observations] = []
    truth: list[Float] = []
    counts: list[int] = []
    tracks: list[pd.DataFrame] = []
    kept = range(scenario.keep.images_at, scenario.keep.images_at + scenario.keep.images)
    for iteration, (found, points) in enumerate(
        read_features(features.path, scenario.drive.frames)
    ):
        state = tracker.update(found)
        lasting = tracker.landmarks(state)
        rows = observable(scenario.camera, found, lasting, scenario.vision)
        observations = observe(scenario.camera, found, lasting, scenario.vision)
        observed.append(observations)
        truth.append(points[rows])
        counts.append(len(observations))
        if iteration in kept:
            columns = {"track": state.track_id, "length": state.length}
            columns |= {"u_px": found.uv_px[:, 0], "v_px": found.uv_px[:, 1]}
            tracks.append(pd.DataFrame({"robot": robot, "iteration": iteration, **columns}))
    iterations = np.repeat(np.arange(len(counts)), counts)
    write_observations(output.path, iterations, _joined(observed))
    write_truth_points(output.path, np.concatenate(truth))
    tables.write(output.path / "tracks.parquet", "tracks", pd.concat(tracks) if tracks else [])
    output.finish(elapsed_s=time.perf_counter() - started)


def _joined(parts: list[Observations]) -> Observations:
    joined = {}
    for name in ("position_m", "covariance_m2", "descriptor", "uvd_px"):
        joined[name] = np.concatenate([getattr(part, name) for part in parts])
    return Observations(**joined)


def stage(
    store: Store, scenario: Scenario, drive: StageFolder, observed: StageFolder, robot: str
) -> StageFolder:
    """Where this robot's log is or will be."""
    settings = {
        "seed": scenario.seed,
        "robot": robot,
        "odometry": asdict(scenario.odometry_of(robot)),
    }
    return store.stage("log", settings, [drive, observed], SOURCES)


def run(
    scenario: Scenario, drive: StageFolder, observed: StageFolder, output: StageFolder, robot: str
) -> None:
    """Add odometry to the observations: the log's folder, with the truth beside it."""
    started = time.perf_counter()
    trajectory = read_trajectory(drive.path / "trajectory.parquet")
    index = trajectory.index(robot)
    increments = encoder_increments(trajectory.wheel_rad[index], calibrated_track_m())
    rng = generator(scenario.seed, "odometry", robot)
    odometry = add_noise(increments, scenario.odometry_of(robot), rng)
    write_frames(output.path, robot, False, trajectory.time_s, odometry)
    for name in ("observations.parquet", "truth_points.parquet"):
        link_or_copy(observed.path / name, output.path / name)
    write_truth_poses(output.path, trajectory.T_world_robot[index])
    output.finish(elapsed_s=time.perf_counter() - started)


def copy_log(source: Path, target: Path) -> None:
    """Put a finished log at a second place."""
    for path in sorted(source.glob("*.parquet")):
        link_or_copy(path, target / path.name)
