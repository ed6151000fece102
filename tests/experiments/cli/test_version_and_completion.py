"""What any command offers: its version, `python -m`, completion in the shell."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.helpers.tiny_scenario import command

ROOT = Path(__file__).parents[3]


def asked(*arguments: str, **settings: str) -> str:
    """What `python -m experiments` answers, started in the root."""
    started = [sys.executable, "-m", "experiments", *arguments]
    environment = os.environ | settings
    told = subprocess.run(started, cwd=ROOT, env=environment, capture_output=True, text=True)
    return f"{told.stdout}{told.stderr}".strip()


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    reply = command(capsys, "--version")
    assert (reply.code, reply.out) == (0, f"mapfusion {version}\n")
    assert asked("--version") == f"mapfusion {version}"


def test_the_citation_is_of_this_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def test_the_shell_completes_commands() -> None:
    told = asked(COMP_WORDS="mapfusion sce", COMP_CWORD="1", _MAPFUSION_COMPLETE="complete_bash")
    assert told.split() == ["scenarios"]


@pytest.mark.parametrize(
    ("module", "slow"),
    [
        ("experiments.cli.main", "numpy numba scipy pandas cv2 matplotlib pydantic"),
        ("experiments.scenario.suite, sim.plan_generator", "numba scipy pandas cv2 pyarrow"),
        ("experiments.reports.inspect", "numba scipy.linalg pandas cv2 mapfusion.vision"),
        ("experiments.scenario.loading", "numba scipy.special scipy.linalg pandas matplotlib"),
    ],
)
def test_a_command_imports_no_library_that_it_does_not_use(module: str, slow: str) -> None:
    code = f"import sys, {module}; print([m for m in {slow.split()} if m in sys.modules])"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"
