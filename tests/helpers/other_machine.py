"""Processes as on another machine: an environment, a copy of the source and a home of their own."""

import contextlib
import os
import shutil
import signal
import subprocess
import sysconfig
import venv
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from experiments.pipeline.stage import PACKAGES, SOURCE_ROOT
from tests.helpers.waiting import wait_until

# What such a process is told of this one's environment.
_INHERITED = ("PATH", "LANG")


class OtherMachine:
    """Libraries are those of the tests, as nothing can be downloaded; all else is its own."""

    def __init__(self, folder: Path, **environment: str) -> None:
        """Into an empty folder; `environment` is what its processes are told further."""
        self.source, self.home = folder / "source", folder / "home"
        self.home.mkdir(parents=True)
        for package in PACKAGES:
            unwanted = shutil.ignore_patterns("__pycache__")
            shutil.copytree(SOURCE_ROOT / package, self.source / package, ignore=unwanted)
        self.prefix = folder / "environment"
        venv.create(self.prefix, symlinks=True)
        libraries = sysconfig.get_path("purelib")
        own = sysconfig.get_path("purelib", "venv", {"base": str(self.prefix)})
        # a path file that such a path leads to is not read: no way back to the tests' own source
        (Path(own) / "libraries.pth").write_text(f"{self.source}\n{libraries}\n", encoding="utf-8")
        inherited = {name: os.environ[name] for name in _INHERITED if name in os.environ}
        self._environment = inherited | {"HOME": str(self.home)} | environment

    @contextlib.contextmanager
    def running(self, *commands: Sequence[str], ready: Callable[[], bool]) -> Iterator[None]:
        """`python -m COMMAND` in the machine's home, for a `with` block, once they are ready."""
        python = str(self.prefix / "bin" / "python")
        with contextlib.ExitStack() as stack:
            log = stack.enter_context((self.home / "log.txt").open("ab"))
            started = [
                subprocess.Popen(
                    [python, "-m", *command],
                    cwd=self.home,
                    env=self._environment,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,  # with all that it starts
                )
                for command in commands
            ]
            for process in started:
                stack.callback(_end, process)
            wait_until(lambda: ready() or any(each.poll() is not None for each in started))
            assert ready(), (self.home / "log.txt").read_text()
            yield


def _end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
