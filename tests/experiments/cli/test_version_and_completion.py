"""Version, `python -m`, shell completion and manual."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from experiments.cli.main import app
from experiments.cli.options import (
    complete_aligner,
    complete_format,
    complete_scenario_or_tag,
    complete_setting,
)
from experiments.plugins.discovery import known_methods
from experiments.reports import result_export
from experiments.scenario.settings import DEFAULT_ALIGNERS
from experiments.scenario.suite import chosen_aligners, entries
from experiments.scenario.yaml_files import SHIPPED
from mapfusion.datasets.formats import EXPORTERS
from mapfusion.errors import DISTRIBUTION
from tests.helpers.tiny_scenario import assert_refused, command

ROOT = Path(__file__).parents[3]
MANUAL = ROOT / "experiments" / "docs"  # a link to docs/
PAGES = sorted(page for page in MANUAL.glob("*.md") if page.stem != "index")


def asked(*arguments: str, **settings: str) -> str:
    """Run `python -m experiments` in the project's root."""
    started = [sys.executable, "-m", "experiments", *arguments]
    environment = os.environ | settings
    told = subprocess.run(started, cwd=ROOT, env=environment, capture_output=True, text=True)
    return f"{told.stdout}{told.stderr}".strip()


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    reply = command(capsys, "--version")
    assert (reply.code, reply.out) == (0, f"mapfusion {version}\n")
    assert asked("--version") == f"mapfusion {version}"


def test_texts_name_our_distribution_and_pages_that_exist() -> None:
    """`pip install mapfusion` would install another project's package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == DISTRIBUTION
    extras, pages = set(project["optional-dependencies"]), {each.stem for each in PAGES}
    folders = [ROOT / name for name in ("mapfusion", "sim", "experiments", "scenarios", "docs")]
    for path in (path for folder in folders for path in folder.rglob("*.*")):
        if path.suffix not in (".py", ".md", ".yaml", ".j2"):
            continue
        text = path.read_text(encoding="utf-8")
        installed = re.findall(r"pip install\s+'?(mapfusion[\w-]*)", text)
        asked = re.findall(r"\bmapfusion(-\w+)?\[(\w+)\]", text)
        assert set(installed) <= {DISTRIBUTION}, path
        assert {f"mapfusion{end}" for end, _ in asked} <= {DISTRIBUTION}, path
        assert {extra for _, extra in asked} <= extras, path
        assert set(re.findall(r"`mapfusion docs\s+([a-z_]+)`", text)) <= pages, path
        assert path.suffix == ".md" or "experiments/docs" not in text, path


def test_the_manual_is_listed_and_shown(capsys: pytest.CaptureFixture[str]) -> None:
    listed = command(capsys, "docs").out
    assert str(MANUAL) in listed
    assert not re.search(r"^\W*index\b", listed, re.MULTILINE)
    for page in PAGES:
        assert page.stem in listed
        assert command(capsys, "docs", page.stem).out.strip() == page.read_text("utf-8").strip()
    assert_refused(command(capsys, "docs", "formatz"), "formatz", "did you mean formats?")
    assert_refused(command(capsys, "docs", "../../README"), "no such page")


def test_the_citation_is_of_this_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def completed(line: str) -> list[str]:
    """Return the shell's completions of a command line."""
    words = len(line.split(" ")) - 1
    shell = {"COMP_WORDS": line, "COMP_CWORD": f"{words}", "_MAPFUSION_COMPLETE": "complete_bash"}
    return asked(**shell).split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("mapfusion sce", ["scenarios"]),
        ("mapfusion run qu", ["quick"]),
        ("mapfusion run ful", ["full"]),
        ("mapfusion align a b --aligner cli", ["clique"]),
    ],
)
def test_the_shell_completes_commands_and_names(line: str, offered: list[str]) -> None:
    assert completed(line) == offered


def test_completed_names_are_those_that_commands_take() -> None:
    context = typer.Context(typer.main.get_command(app), info_name="export")
    assert complete_format(context, "") == [*result_export._FILES, result_export._RERUN]
    context.info_name = "record"
    assert complete_format(context, "ros") == [name for name in EXPORTERS if name.startswith("ros")]
    keys = complete_setting("slam.filter.n_")
    assert keys == ["slam.filter.n_particles="]
    tags = {tag for entry in entries() for tag in entry["tags"]}
    assert set(complete_scenario_or_tag("")) == tags | {
        path.stem for path in SHIPPED.glob("*.yaml")
    }


def test_listed_aligners_are_those_that_commands_take(capsys: pytest.CaptureFixture[str]) -> None:
    listed = command(capsys, "scenarios", "--aligners").out
    names = {entry.name for entry in DEFAULT_ALIGNERS} | set(known_methods())
    for name in names:
        assert re.search(rf"^{name} ", listed, re.MULTILINE), name
    assert set(complete_aligner("")) == names
    assert {entry.name for entry in chosen_aligners(sorted(names))} == names


def test_the_page_of_commands_lists_each_once() -> None:
    page = (MANUAL / "commands.md").read_text(encoding="utf-8")
    commands = re.findall(r"^\| `(mapfusion [^`]+)`", page, re.MULTILINE)
    assert len(commands) > 15
    assert sorted(commands) == sorted(set(commands))


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
