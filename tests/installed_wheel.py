"""The wheel, installed into a fresh environment in another folder, does what the checkout does.

Installs all dependencies, minutes: `make wheel-test` runs it, not `make test`.
"""

import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.run.code_version import source_hash
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
Run = Callable[..., subprocess.CompletedProcess[str]]


def checked(*command: object, **options: object) -> None:
    subprocess.run([*map(str, command)], check=True, **options)


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with the wheel, and what it says it needs in the locked versions."""
    folder = tmp_path_factory.mktemp("wheel")
    source = (
        folder / "source"
    )  # a copy: setuptools leaves folders that the next wheel would take in
    source.mkdir()
    for name in PACKAGED:
        checked("cp", "-a", ROOT / name, source)
    pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
    checked(*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", folder, source)
    shutil.rmtree(source)
    (wheel,) = folder.glob("*.whl")
    pins = folder / "pins.txt"
    pins.write_text("\n".join(PIN.findall((ROOT / "requirements.lock").read_text())))
    checked(sys.executable, "-m", "venv", "--without-pip", folder / "env")
    into = ("--python", folder / "env" / "bin" / "python")
    checked(*pip, *into, "install", "-c", pins, wheel)
    return folder / "env"


@pytest.fixture(scope="module")
def run(environment: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a program of the environment, in one folder that is empty at first."""
    folder = tmp_path_factory.mktemp("empty")
    cache = str(tmp_path_factory.mktemp("cache"))

    def run(program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        command = [str(environment / "bin" / program), *map(str, arguments)]
        settings = KEPT | {"XDG_CACHE_HOME": cache, "PWD": str(folder)}
        return subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True)

    run.folder = folder
    return run


def succeeded(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_is_the_same_program(run: Run, environment: Path) -> None:
    code = "import sim; from experiments.run.code_version import *; print(sim, source_hash())"
    told = succeeded(run("python", "-c", code))
    assert str(environment) in told
    assert source_hash() in told  # no file is missing, and none of other packages is among them
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    code = "import mapfusion; print(mapfusion.__version__)"
    assert succeeded(run("python", "-c", code)).strip() == version
    assert succeeded(run("mapfusion", "--version")).split() == ["mapfusion", version]
    assert succeeded(run("python", "-m", "experiments", "--version")).split()[-1] == version


def test_the_suite_is_there(run: Run) -> None:
    assert "quick" in succeeded(run("mapfusion", "scenarios"))
    copy = run.folder / succeeded(run("mapfusion", "scenarios", "--copy", "dark")).strip()
    assert copy.read_bytes() == (ROOT / "scenarios" / "dark.yaml").read_bytes()


def test_a_bad_scenario_is_refused(run: Run) -> None:
    (run.folder / "bad.yaml").write_text(TINY.replace("frames: 44", "frames: 1"))
    run("mapfusion", "run", "bad.yaml")  # reads the libraries from the disk
    started = time.perf_counter()
    done = run("mapfusion", "run", "bad.yaml")
    print(f"a bad scenario is refused after {time.perf_counter() - started:.1f} s")  # noqa: T201
    assert done.returncode == 2
    assert re.fullmatch(r"mapfusion: bad\.yaml: drive\.frames: .*\n", done.stderr)


def test_it_runs_aligns_and_reports(run: Run) -> None:
    (run.folder / "tiny.yaml").write_text(TINY)
    succeeded(run("mapfusion", "run", "tiny.yaml"))
    result = Path("results", "tiny-3")
    maps = [result / "maps" / f"{robot}.parquet" for robot in ("R1", "R2")]
    assert "ransac" in succeeded(run("mapfusion", "align", *maps))
    succeeded(run("mapfusion", "report", result))
    assert (run.folder / result / "report.html").stat().st_size > 0


def test_the_demo_runs_by_name(run: Run) -> None:
    settings = ("drive.frames=40", "slam.filter.n_particles=10", "evaluate.every=20")
    succeeded(run("mapfusion", "run", "quick", *(f"--set={each}" for each in settings)))
    assert (run.folder / "results" / "quick-0" / "tables" / "errors.parquet").is_file()
