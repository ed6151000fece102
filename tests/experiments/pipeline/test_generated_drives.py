"""A sample of `tests/benchmarks/generated_drives.py`: robots of generated worlds get through."""

from pathlib import Path
from typing import cast
from unittest.mock import patch

import numpy as np
import pytest

from experiments.pipeline.stages.drive import DriveSettings, drive_robots
from experiments.pipeline.stages.pipeline import build_pipeline
from experiments.scenario.loading import load_scenario
from sim.routes import resolve_deadlock
from tests.helpers.wheels_alone import wheels_alone

ROOMS_LOW = Path(__file__).parents[3] / "scenarios" / "rooms_low.yaml"


@pytest.mark.parametrize(("seed", "n_robots"), [(201, 2), (200, 5)])
def test_robots_that_met_head_on_get_through(seed: int, n_robots: int) -> None:
    settings = [f"generate.robots={n_robots}", "drive.frames=90"]
    (stage,) = (
        each
        for each in build_pipeline(load_scenario(ROOMS_LOW, settings, seed)).stages()
        if each.name == "drive"
    )
    counted = patch("sim.driver.resolve_deadlock", side_effect=resolve_deadlock)
    with wheels_alone(), counted as asked:
        trajectory = drive_robots(cast(DriveSettings, stage.settings))
    assert asked.call_count > 0
    steps_m = np.linalg.norm(np.diff(trajectory.T_world_robot[:, :, :2], axis=1), axis=2)
    assert steps_m.sum(axis=1).min() > 3.0  # they had come 0.8 m when they stood for ever
