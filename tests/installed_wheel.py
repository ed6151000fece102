"""The wheel, installed into a fresh environment in another folder, does what the checkout does.

Installs all dependencies, minutes: `make wheel-test` runs it, not `make test`.
"""

import os
import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

from experiments.pipeline.stage import source_hash
from tests.helpers.tiny_scenario import TINY

ROOT = Path(__file__).parents[1]
PACKAGED = (
    "pyproject.toml",
    "README.md",
    "LICENSE",
    "mapfusion",
    "sim",
    "experiments",
    "scenarios",
)
PIN = re.compile(r"^[\w.-]+==[^\s;]+", re.MULTILINE)
# What reaches the installed program of this process: neither the checkout nor its kernels.
KEPT = {key: os.environ[key] for key in ("PATH", "HOME", "LANG") if key in os.environ}
PIP = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")


class Installed(NamedTuple):
    """An environment, and a folder that is empty at first, in which its programs are run."""

    environment: Path
    folder: Path
    cache: Path

    def run(self, program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        command = [str(self.environment / "bin" / program), *map(str, arguments)]
        settings = KEPT | {"XDG_CACHE_HOME": str(self.cache)}
        return subprocess.run(
            command, cwd=self.folder, env=settings, capture_output=True, text=True
        )

    def answer(self, program: str, *arguments: object) -> str:
        done = self.run(program, *arguments)
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel in a fresh environment, and what it says it needs, in the locked versions."""
    folders = [tmp_path_factory.mktemp(name) for name in ("wheel", "empty", "cache")]
    source, environment = folders[0] / "source", folders[0] / "environment"
    source.mkdir()  # a copy: what setuptools leaves beside the source, the next wheel would take in
    called("cp", "-a", *(ROOT / name for name in PACKAGED), source)
    called(*PIP, "wheel", "--no-deps", "--no-build-isolation", "-w", folders[0], source)
    (wheel,) = folders[0].glob("*.whl")
    pins = folders[0] / "pins.txt"
    pins.write_text("\n".join(PIN.findall((ROOT / "requirements.lock").read_text())))
    called(sys.executable, "-m", "venv", "--without-pip", environment)
    called(*PIP, "--python", environment / "bin" / "python", "install", "-c", pins, wheel)
    return Installed(environment, *folders[1:])


def called(*command: object) -> None:
    subprocess.run([*map(str, command)], check=True)


def test_it_is_the_same_program(installed: Installed) -> None:
    code = "import sim; from experiments.pipeline.stage import *; print(sim, source_hash())"
    told = installed.answer("python", "-c", code)
    assert str(installed.environment) in told
    assert source_hash() in told  # no file is missing, and none of other packages is among them
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    code = "import mapfusion; print(mapfusion.__version__)"
    assert installed.answer("python", "-c", code).strip() == version
    for start in (["mapfusion"], ["python", "-m", "experiments"]):
        assert installed.answer(*start, "--version") == f"mapfusion {version}\n"


def test_the_suite_is_there(installed: Installed) -> None:
    assert "quick" in installed.answer("mapfusion", "scenarios")
    copy = installed.folder / installed.answer("mapfusion", "scenarios", "--copy", "dark").strip()
    assert copy.read_bytes() == (ROOT / "scenarios" / "dark.yaml").read_bytes()


def test_a_bad_scenario_is_refused(installed: Installed) -> None:
    (installed.folder / "bad.yaml").write_text(TINY.replace("frames: 44", "frames: 1"))
    for start in ("first", "second"):  # the first reads the libraries from the disk
        started, worked = time.perf_counter(), os.times()
        done = installed.run("mapfusion", "run", "bad.yaml")
        took_s, ended = time.perf_counter() - started, os.times()
        work_s = ended.children_user + ended.children_system
        work_s -= worked.children_user + worked.children_system
        print(f"{start} bad scenario: {took_s:.1f} s, of the processor {work_s:.1f} s")  # noqa: T201
        assert done.returncode == 2
        assert re.fullmatch(r"mapfusion: bad\.yaml, line \d+: drive\.frames: .*\n", done.stderr)


def test_the_demo_runs_by_name_and_its_maps_align(installed: Installed) -> None:
    settings = ("drive.frames=40", "slam.filter.n_particles=10", "evaluate.every=20")
    installed.answer("mapfusion", "run", "quick", *(f"--set={each}" for each in settings))
    result = Path("results", "quick-0")
    maps = [result / "maps" / f"{robot}.parquet" for robot in ("R1", "R2")]
    assert "ransac" in installed.answer("mapfusion", "align", *maps)
    installed.answer("mapfusion", "report", result)
    assert (installed.folder / result / "report.html").stat().st_size > 0
