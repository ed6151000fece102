"""The wheel in fresh environments, one for each version of Python that is on this machine.

First without extras, as a user has it who aligns maps of recordings, then with `sim`. All
dependencies are installed, which takes minutes: `make wheel-test` runs it, not `make test`.
"""

import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from experiments.pipeline.stage import source_hash
from mapfusion.errors import install_command
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
    "docs",
)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MARKED = re.compile(r"Programming Language :: Python :: (3\.\d+)$")
VERSIONS = [found[1] for each in PROJECT["classifiers"] if (found := MARKED.match(each))]
PIN = re.compile(r"^[\w.-]+==[^\\\n]+", re.MULTILINE)  # with its marker
# What reaches the installed program of this process: neither the checkout nor its kernels.
KEPT = {key: os.environ[key] for key in ("PATH", "HOME", "LANG") if key in os.environ}
PIP = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
# Where there is no wheel of PyBullet, pip compiles it: as long as all else together.
COMPILE = bool(os.environ.get("COMPILE"))
MOST_MB, MOST_MB_WITH_SIM = 1200, 1500  # of an environment on the disk


class Installed(NamedTuple):
    """An environment with the wheel, and a folder in which its programs are run."""

    environment: Path
    wheel: Path
    pins: Path
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

    def install(self, *options: object, extra: str = "") -> None:
        target = f"{self.wheel}[{extra}]" if extra else self.wheel
        python = self.environment / "bin" / "python"
        called(*PIP, "--python", python, "install", "-c", self.pins, *options, target)

    @property
    def size_mb(self) -> int:
        told = subprocess.run(
            ["du", "-sm", self.environment], capture_output=True, text=True, check=True
        )
        return int(told.stdout.split()[0])


def called(*command: object) -> None:
    subprocess.run([*map(str, command)], check=True)


def interpreter(version: str) -> str | None:
    """Return a Python of this version that starts: on the path, or one of pyenv's."""
    name = f"python{version}"
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [shutil.which(name), *sorted(map(str, pyenv.glob(f"{version}.*/bin/{name}")))]
    for path in filter(None, found):  # a shim of pyenv's may be there for nothing
        if subprocess.run([path, "-c", ""], capture_output=True).returncode == 0:
            return path
    return None


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()  # a copy: what setuptools leaves beside the source, the next wheel would take in
    called("cp", "-a", *(ROOT / name for name in PACKAGED), source)
    called(*PIP, "wheel", "--no-deps", "--no-build-isolation", "-w", folder, source)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module", params=VERSIONS)
def installed(
    request: pytest.FixtureRequest, wheel: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Installed]:
    """The wheel in a fresh environment, and what it says it needs, in the locked versions."""
    python = interpreter(request.param)
    if python is None:
        pytest.skip(f"no Python {request.param} on this machine")
    folders = [tmp_path_factory.mktemp(name) for name in ("environment", "empty", "cache")]
    pins = wheel.with_name("pins.txt")
    pins.write_text("\n".join(PIN.findall((ROOT / "requirements.lock").read_text())))
    called(python, "-m", "venv", "--without-pip", folders[0])
    made = Installed(folders[0], wheel, pins, *folders[1:])
    made.install()
    yield made
    shutil.rmtree(folders[0])  # a gigabyte


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a result, logs and a recording of pictures that this checkout simulates."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "tiny.yaml").write_text(TINY)
    settings = {**os.environ, "PYTHONPATH": str(ROOT)}
    large = (
        "camera.width_px=640",
        "camera.height_px=480",
        "camera.focal_px=577",
        "drive.frames=12",
    )
    pictures = ("-o", "pictures", "--format", "kitti", *(f"--set={each}" for each in large))
    for command in (
        ("run", "tiny.yaml"),
        ("record", "tiny.yaml", "-o", "logs"),
        ("record", "tiny.yaml", *pictures),
    ):
        words = (sys.executable, "-m", "experiments", *command)
        subprocess.run(words, cwd=folder, env=settings, check=True, capture_output=True)
    return folder


def test_it_is_the_same_program(installed: Installed) -> None:
    code = "import sim; from experiments.pipeline.stage import *; print(sim, source_hash())"
    told = installed.answer("python", "-c", code)
    assert str(installed.environment) in told
    assert source_hash() in told  # no file is missing, and none of other packages is among them
    code = "import mapfusion; print(mapfusion.__version__)"
    assert installed.answer("python", "-c", code).strip() == PROJECT["version"]
    for start in (["mapfusion"], ["python", "-m", "experiments"]):
        assert installed.answer(*start, "--version") == f"mapfusion {PROJECT['version']}\n"


def test_it_is_no_larger_than_promised_and_has_no_tool_of_ours(installed: Installed) -> None:
    print(f"{installed.environment}: {installed.size_mb} MB without extras")  # noqa: T201
    assert installed.size_mb <= MOST_MB
    names = {path.name for path in installed.environment.glob("lib/*/site-packages/*")}
    assert not names & {"pybullet_data", "pytest", "playwright", "pyright", "IPython", "notebook"}


def test_the_suite_is_there(installed: Installed) -> None:
    assert "quick" in installed.answer("mapfusion", "scenarios")
    for name in installed.answer("mapfusion", "scenarios", "--copy", "dark").split():
        copied = installed.folder / name
        assert copied.read_bytes().startswith((ROOT / "scenarios" / copied.name).read_bytes())


def test_the_manual_is_there(installed: Installed) -> None:
    pages = [*(ROOT / "docs").glob("*.md")]
    (there,) = installed.environment.glob("lib/*/site-packages/experiments/docs")
    assert str(there) in installed.answer("mapfusion", "docs")
    assert all((there / page.name).read_bytes() == page.read_bytes() for page in pages)
    assert {each.suffix for each in there.iterdir()} == {".md"}
    shown = installed.answer("mapfusion", "docs", "formats")
    assert shown.strip() == (there / "formats.md").read_text().strip()


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


@pytest.mark.parametrize("command", ["run quick", "record quick -o logs", "sweep quick --seeds 0"])
def test_a_simulation_asks_for_the_simulator(installed: Installed, command: str) -> None:
    done = installed.run("mapfusion", *command.split())
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert install_command("sim") in done.stderr


def test_logs_become_maps_that_are_aligned_and_merged(installed: Installed, recorded: Path) -> None:
    maps = [f"{robot}.parquet" for robot in ("R1", "R2")]
    for name in maps:
        log = recorded / "logs" / Path(name).stem
        installed.answer("mapfusion", "slam", log, "-o", name)
    assert "ransac" in installed.answer("mapfusion", "align", *maps)
    # what both robots see is less than a room
    accepted = "align.evidence.least_ratio=1"
    installed.answer("mapfusion", "merge", *maps, "--set", accepted, "-o", "fused.parquet")
    assert (installed.folder / "fused.parquet").is_file()


def test_a_recording_is_imported(installed: Installed, recorded: Path) -> None:
    folder = recorded / "pictures" / "R1"
    command = ("import", "kitti", folder, "--odometry", "images", "-o", "imported")
    installed.answer("mapfusion", *command)
    assert [*(installed.folder / "imported").rglob("observations.parquet")]


def test_recorded_logs_are_run(installed: Installed, recorded: Path) -> None:
    logs = [str(recorded / "logs" / robot) for robot in ("R1", "R2")]
    text = f"schema_version: 1\nname: recorded\nlogs: {logs}\nevaluate: {{every: 40}}\n"
    (installed.folder / "recorded.yaml").write_text(text)
    installed.answer("mapfusion", "run", "recorded.yaml")
    assert [*(installed.folder / "results" / "recorded-0" / "figures").glob("*.png")]


def test_stored_results_are_shown(installed: Installed, recorded: Path) -> None:
    result = recorded / "results" / "tiny-3"
    installed.answer("mapfusion", "report", result, "-o", "report.html", "--figures")
    assert (installed.folder / "report.html").stat().st_size > 0
    installed.answer("mapfusion", "statistics", result, "-o", "statistics")
    installed.answer("mapfusion", "export", result, "--format", "tum", "-o", "paths")
    assert "errors" in installed.answer("mapfusion", "inspect", result)


def test_with_the_simulator_a_world_is_simulated(installed: Installed) -> None:
    try:
        installed.install(*(() if COMPILE else ("--only-binary=pybullet",)), extra="sim")
    except subprocess.CalledProcessError:
        if COMPILE:
            raise
        pytest.skip("no wheel of PyBullet for this Python; COMPILE=1 compiles it")
    print(f"{installed.environment}: {installed.size_mb} MB with `sim`")  # noqa: T201
    assert installed.size_mb <= MOST_MB_WITH_SIM
    settings = ("drive.frames=40", "slam.filter.n_particles=10", "evaluate.every=20")
    installed.answer("mapfusion", "run", "quick", *(f"--set={each}" for each in settings))
    result = Path("results", "quick-0")
    maps = [result / "maps" / f"{robot}.parquet" for robot in ("R1", "R2")]
    assert "ransac" in installed.answer("mapfusion", "align", *maps)
    installed.answer("mapfusion", "report", result)
    assert (installed.folder / result / "report.html").stat().st_size > 0
