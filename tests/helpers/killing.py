"""A sweep in a process group of its own, to be killed after any number of its files."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

from tests.helpers.waiting import PATIENCE_S, wait_until

Victim = Literal["worker", "everything"]
# Read by every Python process that is started, so also by workers. A finished file is renamed to
# its name, which Python tells its audit hooks before it happens: no table without a permit.
_GATE = """
import pathlib, sys, time

permits = pathlib.Path({permits!r})

def ask(event, arguments):
    if event != "os.rename" or not str(arguments[1]).endswith(".parquet"):
        return
    while not (permits / "unlimited").exists():
        for permit in permits.glob("permit_*"):
            try:
                permit.unlink()
                return
            except FileNotFoundError:  # somebody else has taken it
                pass
        time.sleep(0.01)

sys.addaudithook(ask)
"""


class KilledSweep:
    """Runs one and the same sweep again and again until nothing is left; use in a `with` block.

    It makes as many tables as it is let, however fast the machine is, until `finish` is called.
    """

    def __init__(self, arguments: Sequence[object], results: Path, jobs: int = 2) -> None:
        self._gate = tempfile.TemporaryDirectory()
        self._permits = Path(self._gate.name)
        text = _GATE.format(permits=self._gate.name)
        (self._permits / "sitecustomize.py").write_text(text, encoding="utf-8")
        self._command = [
            sys.executable,
            "-m",
            "experiments.cli.main",
            "sweep",
            *map(str, arguments),
        ]
        self._command += ["--jobs", str(jobs), "--results", str(results)]
        self.process = self._start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:  # a test that failed leaves nothing running
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.communicate()
        self._gate.cleanup()

    def _start(self) -> subprocess.Popen[bytes]:
        path = os.pathsep.join([self._gate.name, *filter(None, sys.path)])
        return subprocess.Popen(
            self._command,
            env=os.environ | {"PYTHONPATH": path},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def kill_at_random(self, rng: random.Random, victims: Sequence[Victim]) -> list[Victim]:
        """Kill each in turn, after a few more tables were made; starts the sweep again if needed.

        Returns:
            Those that were killed before the sweep came to its end.
        """
        killed: list[Victim] = []
        for victim in victims:
            if not self._makes(rng.randint(1, 6)):
                break
            if victim == "worker":
                assert wait_until(lambda: len(self.workers()) > 0)
                _kill(rng.choice(self.workers()))
            else:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.communicate()
                self.process = self._start()
            killed.append(victim)
        return killed

    def _makes(self, more: int) -> bool:
        """Let so many tables be made; whether the sweep goes on until they are."""
        for number in range(more):
            (self._permits / f"permit_{number}").touch()
        taken = wait_until(lambda: not any(self._permits.glob("permit_*")) or self._has_ended)
        assert taken, "it makes nothing any more"
        return not self._has_ended

    @property
    def _has_ended(self) -> bool:
        return self.process.poll() is not None

    def workers(self) -> list[int]:
        """Process ids of the Dask workers."""
        children = Path(f"/proc/{self.process.pid}/task").glob("*/children")
        pids = [int(pid) for path in children for pid in path.read_text().split()]
        return [pid for pid in pids if b"spawn_main" in _command_line(pid)]

    def let_go(self) -> None:
        """Let it make all that is left."""
        (self._permits / "unlimited").touch()

    def finish(self) -> tuple[int, str]:
        """Wait for the end; returns the exit code and what was complained about."""
        self.let_go()
        _, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, err.decode()


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):  # it ended by itself meanwhile
        os.kill(pid, signal.SIGKILL)


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def same_files(sweep: Path, other: Path, seed: int | None = None) -> list[str]:
    """Files of the tables that two sweeps hold, times apart; asserts that they are the same.

    Of the other one, the files of one seed alone if it is given.
    """
    first, second = _files(sweep), _files(other)
    if seed is not None:
        second = {name: data for name, data in second.items() if f"-{seed}-" in Path(name).stem}
    assert sorted(first) == sorted(second)
    assert [name for name in first if first[name] != second[name]] == []
    return sorted(first)


def _files(sweep: Path) -> dict[str, bytes]:
    timed = {"run_times", "aligner_timings"}
    return {
        str(path.relative_to(sweep)): path.read_bytes()
        for path in sweep.glob("*/*.parquet")
        if path.parent.name not in timed
    }
