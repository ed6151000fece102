"""The README: its length, links and pictures, and every block of code in it."""

import re
import shlex
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.main import get_command

from experiments.cli.main import app
from experiments.reports.run_screen import closing_lines
from mapfusion.errors import TellingWarning
from mapfusion.landmark_map import read_map
from tests.helpers.tiny_scenario import command

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", README, re.DOTALL)
COMMANDS = [
    shlex.split(line)[1:]
    for kind, block in BLOCKS
    if not kind
    for line in block.splitlines()
    if line.startswith("mapfusion ")
]
INLINE = re.findall(r"`(mapfusion [^`]+)`", README)


def test_it_is_short() -> None:
    assert len(README.splitlines()) <= 120
    assert len(README.split()) <= 1200


def test_its_links_and_pictures_exist() -> None:
    for link in re.findall(r"\]\(([^)#]+)", README):
        assert (ROOT / link).is_file(), link
    assert sum(file.stat().st_size for file in (ROOT / "docs" / "pictures").iterdir()) < 300_000


def test_what_is_installed_is_this_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [line for kind, block in BLOCKS if not kind for line in block.splitlines()]
    installed = [line.split("#")[0].split()[-1].strip("'") for line in lines if "pip" in line]
    assert len(installed) == 2
    for wanted in installed:
        name, _, extra = wanted.rstrip("]").partition("[")
        assert name == project["name"]
        assert not extra or extra in project["optional-dependencies"]


@pytest.mark.parametrize("words", [*COMMANDS, *(shlex.split(each)[1:] for each in INLINE)])
def test_commands_and_options_exist(words: list[str]) -> None:
    """Parse each command line without running it."""
    group = get_command(app)
    context = typer.Context(group)
    while True:
        name, each, words = group.resolve_command(context, words)  # type: ignore[attr-defined]
        assert each is not None
        if not hasattr(each, "commands"):
            break
        group, context = each, typer.Context(each, parent=context)
    each.make_context(name, list(words), parent=context)


def test_own_maps_are_aligned_and_merged_also_by_an_own_aligner(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    maps, aligner = (block for kind, block in BLOCKS if kind == "python")
    with warnings.catch_warnings():
        warnings.simplefilter("error", TellingWarning)
        exec(compile(maps, "README", "exec"), {})
    (tmp_path / "mine.py").write_text(aligner)
    assert len(read_map(tmp_path / "fused.parquet")) == 60
    (tmp_path / "fused.parquet").unlink()
    used = re.match(r"Use T_a_b = \((.*) m, (.*) m, (.*) rad\)", capsys.readouterr().out)
    assert used is not None
    # south is rounded to 0.1 m: 30 landmarks leave some millimetres
    np.testing.assert_allclose([float(each) for each in used.groups()], [2, 1, 0], atol=0.02)
    inline = [shlex.split(each)[1:] for each in INLINE]
    own = [words for words in [*inline, *COMMANDS] if words[0] in ("align", "merge")]
    assert [words[0] for words in own] == ["align", "merge", "align"]
    for words in own:
        reply = command(capsys, *words)
        assert reply.code == 0, reply.err
    assert re.search(r"^Nearest +accepted +(2\.0|1\.9)\d+ +(1\.0|0\.9)\d+", reply.out, re.MULTILINE)
    assert len(read_map(tmp_path / "fused.parquet")) == 60
    for name in ("fused.png", "aligned.html"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_scenarios_run_as_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Runs are planned only: the suite's scenarios take minutes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(next(b for k, b in BLOCKS if k == "python" and "class" in b))
    for words in (words for words in COMMANDS if words[0] in ("scenarios", "run")):
        more = ["--dry-run"] if words[0] == "run" and "--dry-run" not in words else []
        reply = command(capsys, *words, *more)
        assert reply.code == 0, reply.err
        if words[:2] == ["run", "rooms_high"]:
            assert "4 robots" in reply.out
            assert "Estimate: " in reply.out


def test_a_run_ends_as_shown(tiny_result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = next(block for kind, block in BLOCKS if kind == "text").splitlines()
    advice, opening = shown
    own, opens = closing_lines(tiny_result)
    forms = (
        r"Method to use: \w+\. It was right in \d+\s% of (\d+ alignments of )?\d+ pairs of "
        r"maps with common ground, median error [\d.]+\sm and [\d.]+\srad\..* One run is a "
        r"hint; a sweep over seeds decides\."
    )
    for line in (advice, own):
        assert re.fullmatch(forms, line), line
    assert opening.split()[:5] == opens.split()[:5]
    assert opens.endswith(f"{tiny_result} --open")
