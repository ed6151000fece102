"""Simulated robots mapped by what their pictures tell of their motion, without their wheels."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.single_steps import write_drives
from experiments.pipeline.store import Store
from experiments.scenario.settings import Simulation
from experiments.scenario.yaml_files import read_calibration
from mapfusion.camera import EXACT
from mapfusion.datasets.formats import read_recording
from mapfusion.datasets.stereo_import import RecordingPart, StereoImport
from mapfusion.fastslam.mapping import run_log
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import read_truth
from mapfusion.smoother.smooth import SmootherParameters, smooth, smoothed_map


class Mapped(NamedTuple):
    """A robot's smoothed map, with the true point of each landmark and the true first pose."""

    landmarks: LandmarkMap
    point_m: Float
    start: Float


def mapped_by_pictures(scenario: Simulation, root: Path, jobs: int = 1) -> list[Mapped]:
    """Each robot's drive is written below `root` as a recording, imported again and mapped."""
    run = EvaluatedRun.of(scenario, Store.of(root))
    robots = run.pipeline.simulated
    run.execute(jobs, lambda *_: None, [robot.log for robot in robots])
    paths = write_drives(scenario, "euroc", root / "drives", root, jobs, lambda *_: None)
    return [
        _mapped(path, run.store.path(robot.log), scenario)
        for path, robot in zip(paths, robots, strict=True)
    ]


def _mapped(path: Path, log: Path, scenario: Simulation) -> Mapped:
    recording = read_recording("euroc", path, None, read_calibration)
    assert recording.odometry is not None
    alone = type(recording)(**{**vars(recording), "odometry": None})
    work = StereoImport(alone, lambda _: scenario.vision, lambda _: EXACT)
    one, truth = work.log_of(RecordingPart("R", slice(None))), read_truth(log)
    told, parameters = one.odometry_covariance, scenario.slam.filter
    assert told is not None
    *_, last = run_log(one.log, parameters, np.random.default_rng(0), odometry_covariance=told)
    landmark, path_m = last.slam.best_associations(), last.slam.best_path()
    own = SmootherParameters(stray_m=scenario.smooth.stray_m, odometry_covariance=told)
    smoothed = smooth(one.log, landmark, path_m, own)
    found = smoothed_map(one.log, smoothed, attitude=one.attitude)
    seen_at = [truth.point_world_m[smoothed.landmark == s] for s in found.source_observation]
    points = np.array([np.median(each, axis=0) for each in seen_at])
    return Mapped(found, points, truth.T_world_robot[0])
