"""Tests of `experiments.pipeline.cluster`."""

import pickle
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.pipeline import cluster
from experiments.pipeline.cluster import (
    SweepTerms,
    TaskFailedError,
    UnfitWorkerError,
    code_version,
    perform,
)
from experiments.pipeline.tasks import Task
from mapfusion.errors import InputError
from tests.helpers import acting


class Killed:
    """In place of a cluster: the first so many fail to start, as Dask says it."""

    def __init__(self, failures: int) -> None:
        self.failures, self.started = failures, 0

    def __call__(self, **asked: object) -> str:
        assert asked["n_workers"] == 2
        self.started += 1
        if self.started <= self.failures:
            raise RuntimeError("Nanny failed to start.")
        return "a cluster"


@pytest.mark.parametrize("failures", [0, 1, 2])
def test_it_is_started_again(monkeypatch: pytest.MonkeyPatch, failures: int) -> None:
    killed = Killed(failures)
    monkeypatch.setattr(cluster, "LocalCluster", killed)
    assert cluster._start_cluster(2) == "a cluster"
    assert killed.started == failures + 1


def test_three_times_in_a_row_is_no_accident(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "LocalCluster", Killed(99))
    with pytest.raises(InputError, match="--jobs 2: 2 workers could not be started, 3 times"):
        cluster._start_cluster(2)


@pytest.fixture
def terms(tmp_path: Path) -> SweepTerms:
    attempts = tmp_path / "attempts"
    attempts.mkdir()
    return SweepTerms(attempts, 2, code_version())


def packed(function: object, *arguments: object, outputs: tuple[Path, ...] = ()) -> bytes:
    return pickle.dumps(Task("drive/k", "drive", function, arguments, outputs))  # type: ignore[arg-type]


def test_it_runs_and_leaves_no_mark(terms: SweepTerms, tmp_path: Path) -> None:
    task = packed(acting.write, tmp_path / "out", "text", outputs=(tmp_path / "out",))
    perform("drive/k", task, terms)
    assert (tmp_path / "out").read_text() == "text"
    assert not list(terms.attempts.iterdir())


def test_it_returns_what_the_function_returns(terms: SweepTerms, tmp_path: Path) -> None:
    assert perform("drive/k", packed(int, "7"), terms) == 7
    done = packed(acting.break_down, outputs=(Path(__file__),))  # done before: it is not called
    assert perform("drive/k", done, terms) is None


@pytest.mark.parametrize(
    ("function", "reason", "with_details"),
    [
        (acting.collide, "scenario x: R1 drove into a wall at (1, 2)", False),
        (acting.run_out_of_memory, "drive: MemoryError", False),
        (acting.break_down, "drive: a defect of mapfusion itself: ZeroDivisionError a bug", True),
    ],
)
def test_what_it_raises_is_a_reason(
    terms: SweepTerms, function: object, reason: str, with_details: bool
) -> None:
    with pytest.raises(TaskFailedError) as raised:
        perform("drive/k", packed(function), terms)
    error = pickle.loads(pickle.dumps(raised.value))  # as it travels
    assert error.task == "drive/k"
    assert error.reason.startswith(reason)
    assert ("Traceback" in error.details) == with_details
    assert not list(terms.attempts.iterdir())


def test_a_task_that_kills_its_worker_is_begun_only_so_often(
    terms: SweepTerms, tmp_path: Path
) -> None:
    """Only the task at work is blamed, by the mark that the killed process left behind."""
    journal, script = tmp_path / "journal", tmp_path / "worker.py"
    task = packed(acting.die, journal)
    script.write_text(
        "import pickle, sys\n"
        f"sys.path[:0] = {sys.path!r}\n"
        "from experiments.pipeline.cluster import perform\n"
        f"perform('drive/k', {task!r}, pickle.loads({pickle.dumps(terms)!r}))\n"
    )
    for _ in range(1 + terms.retries):
        ended = subprocess.run([sys.executable, script], check=False)
        assert ended.returncode == -signal.SIGKILL
    refused = subprocess.run([sys.executable, script], check=False, capture_output=True, text=True)
    assert refused.returncode == 1
    assert "TaskFailedError: " in refused.stderr.splitlines()[-1]
    assert "killed 3 times" in refused.stderr.splitlines()[-1]
    assert journal.read_text().split() == ["died"] * 3


def test_machines_that_cannot_take_part_say_so(terms: SweepTerms, tmp_path: Path) -> None:
    elsewhere = SweepTerms(tmp_path / "not shared" / "attempts", 2, terms.code)
    with pytest.raises(UnfitWorkerError, match="must be shared"):
        perform("drive/k", packed(acting.break_down), elsewhere)
    outdated = SweepTerms(terms.attempts, 2, "another version")
    with pytest.raises(UnfitWorkerError, match="other source or libraries"):
        perform("drive/k", packed(acting.break_down), outdated)
