"""Simulated robots whose odometry is what their pictures tell: maps as sure as they say."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.stats import chi2

from experiments.judge.judged_run import JudgedRun
from experiments.judge.map_consistency import (
    Consistency,
    fitted,
    relative_consistency,
)
from experiments.judge.written_drives import write_drives
from experiments.run.store import Store
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from experiments.scenario.yaml_input import read_calibration
from mapfusion import se2
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.result import Alignment, Status
from mapfusion.aligned_landmarks import ABSENT
from mapfusion.calibration_error import EXACT
from mapfusion.fastslam.run import run_log
from mapfusion.fused_map import AlignedPair
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import merge
from mapfusion.recordings.registry import read_recording
from mapfusion.recordings.stereo_import import Cut, StereoImport
from mapfusion.robot_log import read_truth
from mapfusion.se2 import Float
from mapfusion.smoother.smooth import SmootherParameters, smooth
from mapfusion.smoother.smoothed_map import smoothed_map
from tests.helpers.tiny_scenario import TINY

SAME_M = 0.03  # true points that are one corner


class Mapped(NamedTuple):
    """A robot's smoothed map, with the true point of each landmark and the true first pose."""

    landmarks: LandmarkMap
    point_m: Float
    start: Float


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> list[Mapped]:
    root = tmp_path_factory.mktemp("pictures")
    (root / "tiny.yaml").write_text(TINY, encoding="utf-8")
    # of this camera a pixel is four usual ones, and a corner's tracks lie 5 mm apart and not 2
    settings = ["render.renderer=raycast", "smooth.stray_m=0.004"]
    scenario = load_scenario(root / "tiny.yaml", settings)
    assert isinstance(scenario, Simulation)
    run = JudgedRun.of(scenario, Store.of(root))
    robots = run.pipeline.simulated
    run.execute(1, lambda *_: None, [robot.log for robot in robots])
    paths = write_drives(scenario, "euroc", root / "drives", root, 1, lambda *_: None)
    return [
        mapped_by_pictures(path, run.store.path(robot.log), scenario)
        for path, robot in zip(paths, robots, strict=True)
    ]


def mapped_by_pictures(path: Path, log: Path, scenario: Simulation) -> Mapped:
    recording = read_recording("euroc", path, None, read_calibration)
    assert recording.odometry is not None
    alone = type(recording)(**{**vars(recording), "odometry": None})
    work = StereoImport(alone, lambda _: scenario.vision, lambda _: EXACT)
    one, truth = work.log_of(Cut("R", slice(None))), read_truth(log)
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


def assert_no_surer_than_stated(consistency: Consistency) -> None:
    """The upper half of the band of long runs; of some fifty landmarks all may be covered."""
    assert consistency.nees_per_dof < 2.0
    assert 0.85 < consistency.coverage_95 <= 1.0


def assert_as_sure_as_stated(consistency: Consistency) -> None:
    """The band of long runs."""
    assert_no_surer_than_stated(consistency)
    assert consistency.nees_per_dof > 0.5


def consistency_of(each: Mapped) -> Consistency:
    assert len(each.landmarks) > 50
    return relative_consistency(each.landmarks, fitted(each.landmarks, each.point_m))


def test_smoothed_maps_are_no_surer_than_they_say(mapped: list[Mapped]) -> None:
    for each in mapped:
        assert_no_surer_than_stated(consistency_of(each))


@pytest.mark.xfail(
    strict=True,
    reason="bar not met: stated of landmarks with one track is a stray that their truth has not",
)
def test_smoothed_maps_are_as_sure_as_they_say(mapped: list[Mapped]) -> None:
    for each in mapped:
        assert_as_sure_as_stated(consistency_of(each))


def test_maps_fused_jointly_are_as_sure_as_they_say(mapped: list[Mapped]) -> None:
    a, b = mapped
    apart, nearest = KDTree(a.point_m).query(b.point_m)
    _, first = np.unique(nearest, return_index=True)  # one to one
    rows = first[apart[first] < SAME_M]
    pairs = Correspondences(nearest[rows], rows, np.zeros(len(rows)))
    T, certain = se2.between(a.start, b.start), np.ones(len(rows), dtype=bool)
    aligned = Alignment(T, np.eye(3) * 1e-4, certain, 0.0, Status.ACCEPTED, drift_sigma_m=0.01)
    fused = merge([a.landmarks, b.landmarks], [AlignedPair(0, 1, aligned, pairs)]).fused[0]
    assert fused.fallback == ""
    known = fused.parents != ABSENT
    world = np.where(known[:, :1], a.point_m[fused.parents[:, 0]], b.point_m[fused.parents[:, 1]])
    fit = fitted(fused.landmarks, se2.transform_points(se2.inverse(a.start), world))
    assert_as_sure_as_stated(relative_consistency(fused.landmarks, fit))
    off = fused.T_first_map[1] - T
    assert off @ np.linalg.solve(fused.motion_covariance[1], off) < chi2.ppf(0.999, 3)
