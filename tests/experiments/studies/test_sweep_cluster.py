"""`mapfusion sweep --scheduler`: a scheduler and workers that share nothing but the results."""

import json
import os
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from distributed import Client

from mapfusion.robot_log import (
    Observations,
    RobotLog,
    write_log,
    write_truth_points,
    write_truth_poses,
)
from tests.helpers.other_machine import OtherMachine
from tests.helpers.tiny_scenario import command

SCENARIO = """
schema_version: 1
name: recorded
seed: 0
logs: [logs/R1, logs/R2]
slam: {filter: {n_particles: 2, proposal: motion, association: label, planar: true}}
align: {repetitions: 1, aligners: [{name: svd, method: svd}]}
merge: {aligner: svd}
evaluate: {every: 2}
"""
POINTS_M = np.array([[3.0, 1.0, 0.0], [2.0, -1.0, 0.0], [4.0, 0.5, 0.0]])
N_FRAMES = 3


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """Two robots that stand still at one place and see three landmarks with known identities."""
    seen = np.tile(POINTS_M, (N_FRAMES, 1))
    spread, label = np.tile(0.01 * np.eye(3), (len(seen), 1, 1)), np.tile(np.arange(3), N_FRAMES)
    observations = Observations(seen, spread, label=label.astype(np.int32))
    frame_of = np.repeat(np.arange(N_FRAMES), len(POINTS_M))
    for name in ("R1", "R2"):
        folder, still = tmp_path / "logs" / name, np.zeros((N_FRAMES, 3))
        times_s = np.arange(float(N_FRAMES))
        write_log(folder, RobotLog(name, True, times_s, still, frame_of, observations))
        write_truth_poses(folder, still)
        write_truth_points(folder, seen)
    (tmp_path / "recorded.yaml").write_text(SCENARIO, encoding="utf-8")
    return tmp_path / "recorded.yaml"


@pytest.fixture
def other_machine(tmp_path: Path) -> OtherMachine:
    """Return a machine without compiled kernels; they run there as plain Python."""
    return OtherMachine(tmp_path / "elsewhere", NUMBA_DISABLE_JIT="1")


@pytest.fixture
def scheduler(other_machine: OtherMachine, tmp_path: Path) -> Iterator[str]:
    """The address of a scheduler with two workers, each a process of its own."""
    told = tmp_path / "scheduler.json"
    file = ("--scheduler-file", str(told))
    at = ("--host", "127.0.0.1", "--no-dashboard", *file)
    worker = ("dask", "worker", "--nthreads", "2", "--no-nanny", *at)  # one too many
    with other_machine.running(
        ("dask", "scheduler", "--port", "0", *at),
        worker,
        worker,
        ready=lambda: bool(_address(told)),
    ):
        yield _address(told)


def _address(told: Path) -> str:
    """Return the content of the scheduler's file, or nothing while it is incomplete."""
    try:
        return json.loads(told.read_text())["address"]
    except (FileNotFoundError, json.JSONDecodeError):
        return ""


def test_workers_elsewhere_make_the_same_tables(
    scheduler: str,
    other_machine: OtherMachine,
    scenario: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(scenario.parent)  # what is given relative to here must be found there
    with Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(2)
        # a function without a name that could be looked up travels as it is
        told = client.run(lambda: (os.getpid(), os.getcwd(), sys.prefix, find_spec("experiments")))
    assert len({process for process, *_ in told.values()}) == 2
    for _, folder, prefix, package in told.values():
        assert [folder, prefix] == [str(other_machine.home), str(other_machine.prefix)]
        assert Path(package.origin).is_relative_to(other_machine.source)
    asked = ("sweep", scenario.name, "--seeds", "0..3", "--results", "results")
    reply = command(capsys, *asked, "--scheduler", scheduler)
    assert (reply.code, reply.complaints) == (0, []), reply.err
    sweep = scenario.parent / "results" / "sweeps" / "recorded"
    assert pd.read_parquet(sweep / "runs")["status"].tolist() == ["finished"] * 4
    errors = pd.read_parquet(sweep / "errors")
    assert errors["seed"].unique().tolist() == [0, 1, 2, 3]
    assert (errors["n_true"] == len(POINTS_M)).all()
    assert (errors["translation_error_m"].abs() < 0.1).all()
