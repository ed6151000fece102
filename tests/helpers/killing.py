"""A sweep in a process group of its own, to be killed at random moments."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

Victim = Literal["worker", "everything"]
_PATIENCE_S = 900  # kernels may have to be compiled, on a busy machine


class KilledSweep:
    """Runs one and the same sweep again and again until nothing is left; use in a `with` block."""

    def __init__(self, arguments: Sequence[object], results: Path, jobs: int = 2) -> None:
        self._results = results
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

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            self._command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def kill_at_random(self, rng: random.Random, victims: Sequence[Victim]) -> list[Victim]:
        """Kill each in turn, after a few more files were made; starts the sweep again if needed.

        Returns:
            Those that were killed before the sweep came to its end.
        """
        killed: list[Victim] = []
        for victim in victims:
            if not self._wait_for_files(rng.randint(1, 6)):
                break
            if victim == "worker":
                workers = self.workers()
                if not workers:
                    continue
                _kill(rng.choice(workers))
            else:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.communicate()
                self.process = self._start()
            killed.append(victim)
        return killed

    def _wait_for_files(self, more: int) -> bool:
        wanted = self._n_files() + more
        deadline = time.monotonic() + _PATIENCE_S
        while self._n_files() < wanted:
            if self.process.poll() is not None:
                return False
            assert time.monotonic() < deadline
            time.sleep(0.02)
        return True

    def _n_files(self) -> int:
        return sum(1 for _ in self._results.rglob("*.parquet"))

    def workers(self) -> list[int]:
        """Process ids of the Dask workers."""
        children = Path(f"/proc/{self.process.pid}/task").glob("*/children")
        pids = [int(pid) for path in children for pid in path.read_text().split()]
        return [pid for pid in pids if b"spawn_main" in _command_line(pid)]

    def finish(self) -> tuple[int, str]:
        """Wait for the end; returns the exit code and what was complained about."""
        _, err = self.process.communicate(timeout=_PATIENCE_S)
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
