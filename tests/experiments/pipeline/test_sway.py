"""Robots whose bodies pitch and roll: levelled by what they measure, they map as level ones do."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.truth import fit_rmse_m, load_robot
from experiments.pipeline.store import Store
from experiments.scenario.loading import load_scenario
from mapfusion.attitude import read_attitude
from mapfusion.geometry import se2
from mapfusion.robot_log import read_log, read_truth
from sim.trajectory import read_trajectory
from tests.helpers.tiny_scenario import TINY

SWAY = "drive.body_sway.sigma_rad=0.052"  # 3 degrees


class Mapped(NamedTuple):
    """Return folders of log and trajectory of one robot, and the landmark error after a fit."""

    log: Path
    drive: Path
    rmse_m: float
    observations: int


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Mapped]:
    """A level robot, one that sways and measures it, and one that does not know of it."""
    root = tmp_path_factory.mktemp("sway")
    path, found = root / "tiny.yaml", {}
    path.write_text(TINY, encoding="utf-8")
    shared = ["render.renderer=raycast", "slam.filter.proposal=informed", "evaluate.every=40"]
    kinds = {"level": [], "sways": [SWAY], "blind": [SWAY, "attitude.measured=false"]}
    for kind, own in kinds.items():
        run = EvaluatedRun.of(load_scenario(path, [*shared, *own]), Store.of(root))
        robot = run.pipeline.simulated[0]
        run.execute(1, lambda *_: None, [robot.slam])
        log = run.store.path(robot.log)
        logged = read_log(log)
        landmarks, points = load_robot(run.robot_folders(robot)).at(43)
        n = len(logged.observations)
        drive = run.store.path(robot.features.before["drive"])
        found[kind] = Mapped(log, drive, fit_rmse_m(landmarks.position_m, points)[1], n)
    return found


def test_what_is_measured_makes_up_for_the_sway(mapped: dict[str, Mapped]) -> None:
    level, sways, blind = (mapped[kind].rmse_m for kind in ("level", "sways", "blind"))
    assert sways < 1.3 * level
    assert blind > 3 * level


def test_levelled_observations_are_of_their_true_points(mapped: dict[str, Mapped]) -> None:
    """The truth of an observation accounts for how the body stood when it was made."""
    errors = {}
    for kind in ("level", "sways", "blind"):
        log, truth = read_log(mapped[kind].log), read_truth(mapped[kind].log)
        pose = se2.inverse(truth.T_world_robot)[log.iteration]
        expected = np.stack([se2.transform_points(T, p[None])[0]
                             for T, p in zip(pose, truth.point_world_m, strict=True)])  # fmt: skip
        off = np.linalg.norm(log.observations.position_m - expected, axis=1)
        errors[kind] = float(np.nanmedian(off))
    assert errors["sways"] < errors["level"] + 0.015
    assert errors["blind"] > errors["level"] + 0.03


def test_the_attitude_stands_beside_the_log(mapped: dict[str, Mapped]) -> None:
    assert read_attitude(mapped["level"].log) is None
    assert read_attitude(mapped["blind"].log) is None
    attitude = read_attitude(mapped["sways"].log)
    trajectory = read_trajectory(mapped["sways"].drive / "trajectory.parquet")
    assert attitude is not None
    assert trajectory.tilt_rad is not None
    error = attitude.value[:, :2] - trajectory.tilt_rad[0]
    assert np.all(np.abs(error) < 4.5 * attitude.sigma[:, :2])
    assert np.sqrt(np.mean(error[10:] ** 2)) < 0.003
    np.testing.assert_allclose(attitude.value[:, 2], 0.0, atol=1e-12)
