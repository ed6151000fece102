"""What is compiled beforehand is what runs need, and only where little is compiled."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.evaluation.evaluated_run import JudgedRun
from experiments.pipeline import rehearsal
from experiments.pipeline.code_version import SOURCE_ROOT, kernel_folder
from experiments.pipeline.store import Store
from experiments.scenario.settings import Recording, Simulation
from tests.helpers.tiny_scenario import TINY

# Kernels by their module, name and types, that have been called: after the rehearsals, and after a
# run as well.
CALLED = """
import gc, json, sys
from pathlib import Path
from experiments.pipeline.code_version import use_kernel_cache
use_kernel_cache()
from numba.core.dispatcher import Dispatcher
from experiments.evaluation.result import run_scenario
from experiments.pipeline.rehearsal import rehearse_maps, rehearse_pictures
from experiments.scenario.loading import load_scenario

def called():
    kernels = (each for each in gc.get_objects() if isinstance(each, Dispatcher))
    ours = [k for k in kernels if k.py_func.__module__.startswith(("mapfusion.", "sim."))]
    return [(k.py_func.__module__, k.py_func.__name__, str(s)) for k in ours for s in k.signatures]

folder = Path(sys.argv[1])
scenario = load_scenario(folder / "tiny.yaml", ["render.renderer=raycast"])
rehearse_pictures(scenario)
rehearse_maps(scenario)
rehearsed = called()
run_scenario(scenario, folder, 1, lambda *_: None)
print(json.dumps([rehearsed, called()]))
"""


def test_what_a_run_calls_has_been_rehearsed(tmp_path: Path) -> None:
    usual = TINY.partition("  aligners:")[0] + TINY[TINY.index("evaluate:") :]  # all aligners
    (tmp_path / "tiny.yaml").write_text(usual.replace("proposal: motion", ""), encoding="utf-8")
    asked = [sys.executable, "-W", "ignore", "-c", CALLED, str(tmp_path)]
    told = subprocess.run(asked, cwd=SOURCE_ROOT, capture_output=True, text=True, check=True)
    rehearsed, needed = (set(map(tuple, each)) for each in json.loads(told.stdout))
    assert len(needed) > 60
    missed = sorted(needed - rehearsed)
    assert len(missed) <= 0.05 * len(needed), missed


def labels(scenario: Simulation | Recording, results: Path) -> list[str]:
    """Names of the rehearsals that a run of nothing would begin with."""
    run = JudgedRun.of(scenario, Store.of(results))
    return [task.name for task in rehearsal.rehearsals(scenario, run.tasks.values())]


def compiled(root: Path, *packages: str) -> None:
    """As if the kernels of these had been compiled."""
    for package in packages:
        for path in (SOURCE_ROOT / package).rglob("*.py"):
            folder = kernel_folder(root, path)
            folder.mkdir(parents=True)
            (folder / "kernel.nbi").touch()


def test_rehearsed_is_what_is_not_compiled(
    tiny: Simulation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "kernels"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(root))
    assert labels(tiny, tmp_path) == ["rehearsal/pictures", "rehearsal/maps"]
    compiled(root, "sim", "mapfusion/vision")
    assert labels(tiny, tmp_path) == ["rehearsal/maps"]
    compiled(root, *(f"mapfusion/{name}" for name in ("align", "fastslam", "smoother")))
    assert labels(tiny, tmp_path) == []  # what is missing is compiled as it is met
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "others"))
    compiled(tmp_path / "others", "mapfusion/vision")
    assert labels(tiny, tmp_path) == ["rehearsal/maps"]  # TinyRenderer needs none of the caster's


def test_nothing_is_rehearsed_where_little_is_left_to_do(
    tiny: Simulation, tiny_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    assert rehearsal.rehearsals(tiny, []) == []
    recorded = Recording(schema_version=1, name="recorded", logs=[str(tiny_log)])
    assert labels(recorded, tmp_path) == []
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    assert labels(tiny, tmp_path) == []
