"""Aligners that are a class in a Python file, `FILE.py:CLASS`."""

from pathlib import Path

import numpy as np
import pytest

from experiments.plugins import discovery
from experiments.plugins.discovery import Kind, callable_aligner, find_method, make_method
from experiments.scenario.loading import load_scenario
from experiments.scenario.suite import with_aligners
from mapfusion.align.correspondences import Correspondences
from mapfusion.errors import InputError
from tests.helpers.made_up_maps import landmark_map
from tests.helpers.tiny_scenario import TINY

CODE = """
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapfusion.align.alignment import supported


@dataclass(frozen=True)
class Shift:
    by_m: float = 1.0
    randomised = False

    def find(self, pairs, rng):
        T_a_b = np.array([self.by_m, 0.0, 0.0])
        return supported(pairs, np.ones(len(pairs), dtype=bool), T_a_b)


class Ending:
    randomised = False

    def find(self, pairs, rng):
        raise SystemExit(3)
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(CODE)
    return path


def test_its_class_is_made_with_its_parameters(file: Path) -> None:
    method = find_method(f"{file}:Shift")
    assert method.kind is Kind.PLUG_IN
    assert make_method(f"{file}:Shift", by_m=2.0).by_m == 2.0
    with pytest.raises(ValueError, match=r"parameters: Shift: by: unknown; known: by_m"):
        make_method(f"{file}:Shift", by=2.0)


def test_it_runs_in_a_process_of_its_own(file: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 5, (10, 3))
    maps = landmark_map(points, name="a"), landmark_map(points - [1.0, 0.0, 0.0], name="b")
    pairs = Correspondences(np.arange(10), np.arange(10), np.zeros(10))
    shift = callable_aligner(f"{file}:Shift", {"by_m": 1.0}, 30.0)
    found = shift.align(*maps, pairs, np.random.default_rng(0))
    assert (found.status, found.T_a_b.tolist()) == ("accepted", [1.0, 0.0, 0.0])
    ending = callable_aligner(f"{file}:Ending", {}, 30.0)
    failed = ending.align(*maps, pairs, np.random.default_rng(0))
    assert failed.status == "failed"
    assert "raised SystemExit: 3 (mine.py:" in failed.reason


def test_stored_estimates_depend_on_its_content(file: Path) -> None:
    origins = [find_method(f"{file}:Shift").origin()]
    file.write_text(CODE.replace("1.0", "2.0"))
    discovery.fingerprint.cache_clear()
    origins.append(find_method(f"{file}:Shift").origin())
    assert origins[0]["files"] != origins[1]["files"]
    assert all(origin["files"] for origin in origins)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "mine.py:Shiftt",
            r"mine\.py: has no class Shiftt; there: Shift, Ending; did you mean Shift\?",
        ),
        ("other.py:Shift", r"other\.py: no such file \(expected FILE\.py:CLASS"),
        ("mine.py", r"mine\.py: name the class too, as in mine\.py:MyAligner"),
        ("broken.py:Shift", r"raised SyntaxError: .*broken\.py, line 1"),
    ],
)
def test_a_wrong_name_is_one_clear_line(
    file: Path, name: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(file.parent)
    Path("broken.py").write_text("class Shift(")
    with pytest.raises(InputError, match=message) as refused:
        with_aligners(None, (), [name])
    assert len(str(refused.value).splitlines()) == 1


def test_a_path_is_relative_to_the_scenario_s_file_or_to_the_working_folder(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = tmp_path / "own.yaml"
    scenario.write_text(
        TINY.replace("method: svd}", "method: svd}\n    - {name: mine, method: mine.py:Shift}")
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    entries = {entry.name: entry.method for entry in load_scenario(scenario).align.aligners}
    assert entries["mine"] == f"{file}:Shift"
    overrides = with_aligners(scenario, ["align.repetitions=3"], ["svd", "../mine.py:Shift"])
    chosen = load_scenario(scenario, overrides)
    assert chosen.align.repetitions == 3
    assert [entry.name for entry in chosen.align.aligners] == ["svd", "Shift"]
    assert Path(chosen.align.aligners[1].method.partition(":")[0]).samefile(file)
    assert chosen.merge.aligner == "svd"  # the scenario's ransac is not among them


def test_bounds_of_other_aligners_are_dropped(tmp_path: Path) -> None:
    scenario = tmp_path / "own.yaml"
    scenario.write_text(f"{TINY}  ransac.scatter_m: {{max: 1}}\n  svd.scatter_m: {{max: 1}}\n")
    chosen = load_scenario(scenario, with_aligners(scenario, (), ["svd", "icp"]))
    assert set(chosen.expect) == {"path_rmse_m", "svd.scatter_m"}
