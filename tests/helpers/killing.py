"""A command in a process group of its own, to be killed after any number of its files."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, Self

import pandas as pd

from tests.helpers.waiting import PATIENCE_S, wait_until

Victim = Literal["worker", "everything", "interrupted", "terminated"]
_SIGNALS = {
    "everything": signal.SIGKILL,
    "interrupted": signal.SIGINT,  # as Ctrl-C: all of the process group
    "terminated": signal.SIGTERM,  # as `kill`: the command's own process
}
# Read by every Python process that is started, so also by workers. A finished file is renamed to
# its name, which Python tells its audit hooks before it happens: none without a permit. What is
# started in the background hands down that Ctrl-C is ignored: here it counts.
_GATE = """
import pathlib, signal, sys, time

signal.signal(signal.SIGINT, signal.default_int_handler)
permits = pathlib.Path({permits!r})

def ask(event, arguments):
    if event != "os.rename" or not str(arguments[0]).endswith(".part"):
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


class Ended(NamedTuple):
    """Exit code of a command and its output on stdout and stderr."""

    code: int
    out: str
    err: str


class KilledCommand:
    """Runs one and the same command again and again until nothing is left; use in a `with` block.

    It makes as many files as it is let, however fast the machine is, until `finish` is called.
    """

    def __init__(self, arguments: Sequence[object], results: Path, jobs: int = 2) -> None:
        self._gate = tempfile.TemporaryDirectory()
        self._permits = Path(self._gate.name)
        text = _GATE.format(permits=self._gate.name)
        (self._permits / "sitecustomize.py").write_text(text, encoding="utf-8")
        self._command = [sys.executable, "-m", "experiments.cli.main", *map(str, arguments)]
        self._command += ["--jobs", str(jobs), "--results", str(results)]
        self.process = self._start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:  # a test that failed leaves nothing running
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.communicate()
        self._gate.cleanup()

    def _start(self) -> subprocess.Popen[str]:
        path = os.pathsep.join([self._gate.name, *filter(None, sys.path)])
        return subprocess.Popen(
            self._command,
            # the second: a process that is aborted says where its threads are
            env=os.environ | {"PYTHONPATH": path, "PYTHONFAULTHANDLER": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def go_on(self) -> None:
        """Start the same command again, once it has ended."""
        self.process = self._start()

    def kill_at_random(self, rng: random.Random, victims: Sequence[Victim]) -> list[Victim]:
        """Kill each in turn, after a few more files were made; starts the command again if needed.

        Returns:
            Those that were killed before the command came to its end.
        """
        killed: list[Victim] = []
        for victim in victims:
            if not self.makes(rng.randint(1, 6)):
                break
            self.kill(victim, rng)
            if victim != "worker":
                self.ended()
                self.go_on()
            killed.append(victim)
        return killed

    def makes(self, more: int, moment_s: float = 0.0) -> bool:
        """Let so many files be made, and time pass; whether the command has not ended by then."""
        for number in range(more):
            (self._permits / f"permit_{number}").touch()
        taken = wait_until(lambda: not any(self._permits.glob("permit_*")) or self._has_ended)
        assert taken, "it makes nothing any more"
        time.sleep(moment_s)
        return not self._has_ended

    def kill(self, victim: Victim, rng: random.Random) -> None:
        """Send the signal; a worker is waited for."""
        if victim == "worker":
            assert wait_until(self._has_workers_or_ended)
            for pid in rng.sample(self.workers(), 1) if self.workers() else ():
                _send(pid, signal.SIGKILL)
        elif victim == "terminated":
            _send(self.process.pid, _SIGNALS[victim])
        else:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, _SIGNALS[victim])

    def _has_workers_or_ended(self) -> bool:
        """Lets one file more be made where there are none: some come before the first worker."""
        if self.workers() or self._has_ended:
            return True
        if not any(self._permits.glob("permit_*")):
            (self._permits / "permit_0").touch()
        return False

    @property
    def _has_ended(self) -> bool:
        return self.process.poll() is not None

    def workers(self) -> list[int]:
        """Process ids of the workers: spawned by the command, or forked by its fork server."""
        started = {pid: _command_line(pid) for pid in _children(self.process.pid)}
        servers = [pid for pid, line in started.items() if b"forkserver" in line]
        spawned = [pid for pid, line in started.items() if b"spawn_main" in line]
        return [*spawned, *(pid for server in servers for pid in _children(server))]

    def let_go(self) -> None:
        """Let it make all that is left."""
        (self._permits / "unlimited").touch()

    def ended(self) -> Ended:
        """Wait until the command and all that it started have ended.

        Raises:
            AssertionError: they do not; says where their threads are.
        """
        try:
            out, err = self.process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGABRT)
            err = self.process.communicate(timeout=PATIENCE_S)[1]
            raise AssertionError(f"it does not end:\n{err}") from None
        return Ended(self.process.returncode, out, err)

    def finish(self) -> tuple[int, str]:
        """Wait for the end; returns the exit code and what was complained about."""
        self.let_go()
        ended = self.ended()
        return ended.code, ended.err


def _send(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):  # it ended by itself meanwhile
        os.kill(pid, number)


def _children(pid: int) -> list[int]:
    threads = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for path in threads for child in _read(path).split()]


def _command_line(pid: int) -> bytes:
    return _read(Path(f"/proc/{pid}/cmdline"))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:  # it ended by itself meanwhile
        return b""


def same_rows(sweep: Path, other: Path, seed: int) -> bool:
    """Return True if two sweeps agree on the runs of one seed, except for times."""
    timed = {"run_times", "aligner_timings"}
    names = [{path.parent.name for path in each.glob("*/*.parquet")} for each in (sweep, other)]
    both = (
        [_rows(each / name, seed) for name in sorted(names[0] - timed)] for each in (sweep, other)
    )
    return names[0] == names[1] and all(one.equals(two) for one, two in zip(*both, strict=True))


def _rows(table: Path, seed: int) -> pd.DataFrame:
    rows = pd.read_parquet(table)
    return rows[rows["seed"] == seed].reset_index(drop=True)
