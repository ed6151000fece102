"""Tests of `experiments.pipeline.stage`."""

import ast
import copy
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import grimp
import numpy as np
import pytest
from pydantic_core import to_jsonable_python

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.pipeline import stage as stage_module
from experiments.pipeline.stage import (
    PACKAGES,
    SOURCE_ROOT,
    Job,
    RecordedLog,
    Stage,
    imported_sources,
    in_dependency_order,
    use_kernel_cache,
)
from experiments.pipeline.stages.pipeline import build_pipeline
from experiments.pipeline.store import Store
from experiments.plugins.discovery import find_method
from experiments.scenario.loading import load_scenario, scenario_of
from experiments.scenario.settings import Simulation
from mapfusion.align.aligners import ALIGNERS
from mapfusion.errors import InputError
from mapfusion.fusion.fusers import FUSERS
from mapfusion.robot_log import Observations, RobotLog, write_log
from sim.renderer import egl_driver
from tests.helpers.tiny_scenario import TINY

# Which stages are told of a setting, by the longest beginning of its path. A stage's own settings
# are in its key, and the keys of the stages before it.
TOLD = {
    "schema_version": "",
    "name": "",
    "description": "",
    "tags": "",
    "seed": "drive faces features observed log slam aligner",
    "world": "drive faces",
    "world.walls.look": "faces",
    "world.walls.mirrored": "faces",
    "world.texture": "faces",
    "robots.name": "drive features observed log fuse",
    "robots.start": "drive",
    "robots.route": "drive",
    "robots.loop": "drive",
    "robots.tire_friction": "drive",
    "robots.odometry": "log",
    "robots.radiometry": "features",
    "drive": "drive",
    "drive.frames": "drive observed smooth match aligner fuse",
    "render": "features",
    "camera": "features observed",
    "radiometry": "features",
    "odometry": "log",
    "attitude": "observed",
    "vision": "observed",
    "vision.harris": "features",
    "vision.stereo": "features",
    "vision.descriptor": "features",
    "vision.usurf": "features",
    "slam": "slam",
    "slam.filter.motion": "slam smooth fuse",
    "slam.noise": "slam",
    "slam.filter.noise_floor_m": "slam smooth fuse",
    "slam.min_count": "slam smooth fuse",
    "smooth": "smooth",
    "smooth.stray_m": "smooth fuse",
    "align.match": "match",
    "align.aligners": "aligner",
    "align.refinement": "match aligner judge",
    "align.acceptance": "match aligner judge",
    "align.evidence": "match aligner judge",
    "align.repetitions": "aligner",
    "merge": "judge fuse",
    "merge.aligner": "judge",  # fusing begins from that aligner's stage
    "merge.fuser": "",
    "fuse": "smooth match aligner fuse",
    "fuse.fusers": "fuse",
    "evaluate.every": "slam match aligner",
    "evaluate.true_pair_radius_m": "judge",
    "evaluate.timing_points": "",
    "evaluate.timing_repeats": "",
    "keep": "features observed",
    "keep.clouds_every": "slam",
    "expect": "",
}
NO_OTHER_VALUE = {
    "schema_version",  # there is one
    # sections that are absent; those of the first robot are there, and changed
    "generated",
    "team",
    "robots.1.odometry",
    "robots.1.radiometry",
    # others name it, or its parameters are this method's
    "align.aligners.0.name",
    "align.aligners.0.method",
    "merge.aligner",
    "merge.fuser",
    # names that there are
    *(f"fuse.fusers.{i}" for i in range(len(FUSERS))),
}
WORDS = ("motion", "informed", "label", "descriptor", "solved", "ransac", "svd")
WORDS += ("orb", "other", "raycast", "pixels", "drop", "stated")


def stages_of(scenario: Simulation) -> list[Stage]:
    """In the scenario's order: done they are in another, the aligner that merges first."""
    found = EvaluatedRun.of(scenario, Store(Path("nowhere"))).stages()
    return in_dependency_order([*(s for s in found if s.name not in ("aligner", "fuse")), *found])


@pytest.fixture(scope="module")
def resolved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The tiny scenario with every setting written out, also those that are off by default."""
    path = tmp_path_factory.mktemp("scenario") / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    data = load_scenario(path).resolved()
    for name in ("odometry", "radiometry"):
        data["robots"][0][name] = copy.deepcopy(data[name])
    data["world"]["walls"][0]["look"] = "room"
    data["world"]["texture"]["poster_width_m"] = [0.5, 4.0]
    data["align"]["aligners"][0]["parameters"] = {"gate_m": 0.25}
    data["fuse"]["every"] = 2 * data["evaluate"]["every"]
    data["expect"] = {"path_rmse_m": {"min": 0.0, "max": 1.0}}
    return data


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all settings."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from leaves(inner, (*path, key))
    else:
        yield path


def others(value: Any) -> list[Any]:
    """Values that may be right in place of this one."""
    if isinstance(value, bool) or value is None:
        return [not value, 1, 0.5, [0, 1]]
    if isinstance(value, int):
        return [value + 1, value - 1, value * 2, value // 2]
    if isinstance(value, float):
        return [value * 1.01 + 1e-3, value * 0.99, value + 0.01, value / 2]
    return [word for word in (*WORDS, f"{value}x") if word != value]


def changed(resolved: dict[str, Any], path: tuple[Any, ...]) -> Simulation | None:
    """The scenario with one setting changed; None where no other value is allowed here."""
    for other in others(_at(resolved, path)):
        data = copy.deepcopy(resolved)
        _at(data, path[:-1])[path[-1]] = other
        try:
            scenario = scenario_of(data, "changed")
            assert isinstance(scenario, Simulation)
            if scenario.resolved() != resolved:
                return scenario
        except InputError:
            continue
    return None


def _at(data: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        data = data[key]
    return data


def told_of(path: tuple[Any, ...]) -> set[str]:
    parts = [part for part in path if isinstance(part, str)]
    for n in range(len(parts), 0, -1):
        if ".".join(parts[:n]) in TOLD:
            return set(TOLD[".".join(parts[:n])].split())
    raise AssertionError(f"{path}: say in TOLD which stages read this setting")


def test_every_setting_is_in_the_keys_of_the_stages_that_read_it_and_of_no_other(
    resolved: dict[str, Any],
) -> None:
    scenario = scenario_of(resolved, "tiny")
    assert isinstance(scenario, Simulation)
    before = stages_of(scenario)
    stuck = []
    for path in leaves(resolved):
        try:
            other = changed(resolved, path)
            after = None if other is None else stages_of(other)
        except InputError:
            after = None
        if after is None:
            stuck.append(path)
            continue
        pairs = list(zip(before, after, strict=True))
        told = {a.name for a, b in pairs if _settings(a) != _settings(b)}
        assert told == told_of(path), path
        for a, b in pairs:
            upstream = any(
                x.key != y.key for x, y in zip(a.before.values(), b.before.values(), strict=True)
            )
            assert (a.key != b.key) == (_settings(a) != _settings(b) or upstream), (path, a.name)
    assert {".".join(map(str, path)) for path in stuck} <= NO_OTHER_VALUE


def _settings(stage: Stage) -> Any:
    return to_jsonable_python(stage.settings)


def work(settings: Any, job: Job) -> None:
    """Do the work of the made-up stages: none."""


work.__module__ = "experiments.pipeline.stage"  # a key covers the source of the harness alone


def made_up(name: str = "one", settings: Any = None, **more: Any) -> Stage:
    return Stage(name, name, settings or {}, work, **more)


def test_settings_in_another_order_are_the_same() -> None:
    one, other = {"a": 1, "b": [1, 2]}, {"b": [1, 2], "a": 1}
    assert made_up(settings=one).key == made_up(settings=other).key
    assert made_up(settings={"b": [2, 1], "a": 1}).key != made_up(settings=one).key
    assert made_up("two", one).key != made_up("one", one).key


def test_source_libraries_and_stages_before_it_are_in_the_key(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, other = made_up(), made_up(settings={"a": 1})
    befores: list[dict[str, Stage]] = [{}, {"x": first}, {"x": other}, {"y": first}]
    assert len({made_up("two", before=before).key for before in befores}) == 4
    monkeypatch.setattr(stage_module, "library_versions", lambda **_: {"numpy": "0.0"})
    assert made_up().key != first.key
    monkeypatch.undo()
    monkeypatch.setattr(stage_module, "source_hash", lambda _: "other")
    assert made_up().key != first.key


def test_recorded_logs_are_known_by_their_content(tmp_path: Path) -> None:
    (tmp_path / "frames.parquet").write_bytes(b"1")
    before = RecordedLog(tmp_path).key
    (tmp_path / "frames.parquet").write_bytes(b"2")
    assert RecordedLog(tmp_path).key != before
    (tmp_path / "frames.parquet").write_bytes(b"1")
    assert RecordedLog(tmp_path).key == before


def test_a_recorded_log_that_has_changed_is_read_again(tmp_path: Path) -> None:
    """Though one process lays out many runs of the same log."""
    nothing, path = Observations(np.empty((0, 3)), np.empty((0, 3, 3))), tmp_path / "x.yaml"
    path.write_text("schema_version: 1\nname: x\nlogs: [log]\n", encoding="utf-8")
    found = []
    for n_frames in (4, 5):
        times_s, still = np.arange(float(n_frames)), np.zeros((n_frames, 3))
        write_log(tmp_path / "log", RobotLog("R1", True, times_s, still, np.empty(0), nothing))
        (robot,) = build_pipeline(load_scenario(path)).robots
        found.append((robot.n_frames, robot.log.key))
    (before, old_key), (after, new_key) = found
    assert (before, after) == (4, 5)
    assert new_key != old_key


# The folder of whose modules it lies in.
WITH_A_ROBOT = {"drive", "faces", "features", "observed", "log"}
OWN_METHODS = ("opencv", "kiss_matcher", *ALIGNERS)
# the verdict on every method seeks its rivals with the clique
BUILDS_ON = {
    "icp": {"impicp"},
    "impicp": {"icp"},
    "ransac": {"ransac_mahalanobis"},
    "ransac_mahalanobis": {"ransac"},
    "clique": set(OWN_METHODS),
    "opencv": {"kiss_matcher"},  # one module of methods of other libraries
    "kiss_matcher": {"opencv"},
}


def reached(*modules: str, without: frozenset[str] = frozenset()) -> set[str]:
    """Modules of ours that these import, by another package's reading of the imports."""
    graph: Any = grimp.build_graph("mapfusion", "sim", "experiments")
    found, todo = set[str](), list(modules)
    while todo:
        name = todo.pop()
        if name not in found | without:
            found.add(name)
            todo += graph.find_modules_directly_imported_by(name)
    return found


def test_keys_cover_all_the_source_a_stage_runs(resolved: dict[str, Any]) -> None:
    scenario = scenario_of(resolved, "tiny")
    assert isinstance(scenario, Simulation)
    for stage in stages_of(scenario):
        covered = {part.removesuffix(".py").replace("/", ".") for part in stage.sources}
        by_name = frozenset({"mapfusion.align.aligners"})  # stands for whatever it is asked for
        expected = reached(stage.work.__module__, *stage.loads, without=by_name)
        packages = {name for name in expected if f"{name}.__init__" in covered or "." not in name}
        assert expected - packages <= covered, stage.name
        assert "experiments.scenario.loading" not in covered, stage.name
        assert ("sim/p3at.urdf" in stage.sources) == (stage.name in WITH_A_ROBOT)


@pytest.mark.parametrize("name", OWN_METHODS)
def test_a_method_s_sources_are_what_its_module_imports(name: str) -> None:
    module = find_method(name).target.partition(":")[0]
    files = {part.removesuffix(".py").replace("/", ".") for part in imported_sources(module)}
    assert module in files
    assert files == reached(module) - {"mapfusion", "mapfusion.align"}


def test_one_method_s_source_is_not_in_another_s_key(resolved: dict[str, Any]) -> None:
    """The source of a method is in the keys of its own stages and of the match stage only."""
    data = copy.deepcopy(resolved)
    data["align"]["aligners"] = [{"name": name, "method": name} for name in OWN_METHODS]
    scenario = scenario_of(data, "tiny")
    assert isinstance(scenario, Simulation)
    (pair,) = build_pipeline(scenario).pairs
    aligners, match = pair.filtered.aligners, pair.filtered.match
    for name in OWN_METHODS:
        own = find_method(name).target.partition(":")[0].replace(".", "/") + ".py"
        elsewhere = {other for other, stage in aligners.items() if own in stage.sources}
        assert elsewhere == {name} | BUILDS_ON.get(name, set())
        assert (own in match.sources) == (name == "clique")


def egl_works() -> bool:
    try:
        egl_driver()
    except InputError:
        return False
    return True


@pytest.mark.skipif(not egl_works(), reason="this system has no EGL")
def test_the_renderer_is_in_the_key(resolved: dict[str, Any]) -> None:
    data = copy.deepcopy(resolved)
    data["render"]["renderer"] = "egl"
    scenario, other = scenario_of(resolved, "tiny"), scenario_of(data, "tiny")
    assert isinstance(scenario, Simulation)
    assert isinstance(other, Simulation)
    pairs = zip(stages_of(scenario), stages_of(other), strict=True)
    assert {a.name for a, b in pairs if a.key == b.key} == {"drive", "faces"}


def test_a_stage_is_declared_once_and_stays(resolved: dict[str, Any]) -> None:
    """The same declaration gives the same key; a key is not carried over to a changed copy."""
    first = made_up(settings={"a": 1})
    assert first.key == made_up(settings={"a": 1}).key
    assert replace(first, settings={"a": 2}).key != first.key


FILES = {
    "ours/__init__.py": "",
    "ours/start.py": "import numpy\nfrom ours import by_package, nested, spelled\n",
    "ours/by_package.py": "def late():\n    import ours.by_name\n",
    "ours/by_name.py": "from ours.by_module import number as renamed\n",
    "ours/nested.py": """
class Late:
    with open(__file__):
        for _ in ():
            pass
        else:
            try:
                pass
            except OSError:
                if True:
                    import ours.by_handler
    match 1:
        case 1:
            import ours.by_case
""",
    "ours/spelled.py": """import os
from ours import (  # not only this
    by_comment as one,  # ours.unused
    by_bracket,
)
from ours.kit import name, other
import numpy as np, ours.by_comma as last
""",
    "ours/by_comment.py": "",
    "ours/by_bracket.py": "",
    "ours/by_comma.py": "",
    "ours/kit/__init__.py": "",
    "ours/kit/other.py": "",
    "ours/by_handler.py": "",
    "ours/by_case.py": "",
    "ours/by_module.py": "from ours import start  # a circle\nnumber = 1\n",
    "ours/unused.py": "",
    "ours/robot.urdf": "",
}


@pytest.fixture(autouse=True)
def _nothing_read_yet() -> Iterator[None]:
    """The caches hold what a process has read; files change in a test alone."""
    _forget()
    yield
    _forget()


def _forget() -> None:
    for name in dir(stage_module):
        clear = getattr(getattr(stage_module, name), "cache_clear", None)
        if clear is not None:
            clear()


def test_every_import_of_ours_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "numpy.py").write_text("")  # beside ours, as where packages are installed
    deep = tmp_path / "ours" / "whole" / "within" / "deep.py"
    deep.parent.mkdir(parents=True)
    deep.write_text("from ours import unused\n")
    (tmp_path / "ours" / "whole" / "__init__.py").touch()
    monkeypatch.setattr(stage_module, "SOURCE_ROOT", tmp_path)
    monkeypatch.setattr(stage_module, "PACKAGES", ("ours",))
    found = stage_module.imported_sources("ours.start")
    assert set(found) == set(FILES) - {"ours/unused.py", "ours/__init__.py"}
    expected = {"ours/unused.py", "ours/robot.urdf"}
    expected |= {f"ours/whole/{name}" for name in ("__init__.py", "within/deep.py")}
    assert set(stage_module.imported_sources("ours.whole")) == expected


def test_statements_are_found_as_python_finds_them() -> None:
    for package in stage_module.PACKAGES:
        for path in (stage_module.SOURCE_ROOT / package).rglob("*.py"):
            name = path.relative_to(stage_module.SOURCE_ROOT).as_posix()
            if name not in stage_module._FINDS_BY_NAME:
                found = stage_module.imports_of(stage_module.SOURCE_ROOT, name)
                assert set(found) == _parsed_imports(path), name


def _parsed_imports(path: Path) -> set[str]:
    """Files of ours that a file imports, by Python's own parser."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            found.update(*(_candidates(alias.name)[:1] for alias in node.names))
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inside, whole = (
                    _candidates(m) for m in (f"{node.module}.{alias.name}", node.module)
                )
                found.update((inside or whole)[:1])
    return found


def _candidates(module: str) -> list[str]:
    path = module.replace(".", "/")
    files = (f"{path}.py", f"{path}/__init__.py")
    ours = module.split(".")[0] in stage_module.PACKAGES
    return [file for file in files if ours and (stage_module.SOURCE_ROOT / file).is_file()]


@pytest.mark.parametrize(
    ("file", "matters"),
    [
        ("ours/a.py", True),
        ("ours/new.py", True),
        ("ours/within/deep/er.py", True),
        ("ours/robot.urdf", True),
        ("single.py", True),
        ("ours/notes.txt", False),
        ("other.py", False),
    ],
)
def test_the_hash_is_of_all_source_and_of_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, matters: bool
) -> None:
    monkeypatch.setattr(stage_module, "SOURCE_ROOT", tmp_path)
    (tmp_path / "ours").mkdir()
    for name in ("ours/a.py", "ours/robot.urdf", "ours/notes.txt", "single.py"):
        (tmp_path / name).write_text("1")

    def found() -> str:
        _forget()
        return stage_module.source_hash(("ours", "single.py"))

    before = found()
    assert found() == before
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text("2")
    changed = found()
    assert (changed != before) == matters
    if matters and file != "single.py":
        (tmp_path / file).rename(tmp_path / "ours" / f"moved{Path(file).suffix}")
        assert found() not in (before, changed)


KERNELS = {
    "callee": "@njit(cache=True)\ndef callee(x):\n    return x + 1\n",
    "caller": "from mapfusion.callee import callee\n"
    "@njit(cache=True)\ndef caller(x):\n    return 2 * callee(x)\n",
    "apart": "@njit(cache=True)\ndef apart(x):\n    return 3 * x\n",
}
CALL = """
import importlib, json
from experiments.pipeline.stage import use_kernel_cache
use_kernel_cache()
told = {}
for name in ("caller", "apart"):
    kernel = getattr(importlib.import_module("mapfusion." + name), name)
    told[name] = kernel(10), bool(kernel.stats.cache_hits)
print(json.dumps(told))
"""


class Source:
    """A copy of ours with three kernels more, in an environment of its own."""

    def __init__(self, folder: Path) -> None:
        self._root, self.cache = folder / "source", folder / "cache"
        for package in PACKAGES:
            unwanted = shutil.ignore_patterns("__pycache__")
            shutil.copytree(SOURCE_ROOT / package, self._root / package, ignore=unwanted)
        for name in KERNELS:
            self.restore(name)

    def write(self, module: str, text: str) -> None:
        """Put a module of kernels in place."""
        path = self._root / "mapfusion" / f"{module}.py"
        path.write_text("from numba import njit\n" + text, encoding="utf-8")

    def restore(self, module: str) -> None:
        """Put a module of kernels in place as it was first, its time of change included."""
        self.write(module, KERNELS[module])
        os.utime(self._root / "mapfusion" / f"{module}.py", (1e9, 1e9))

    def called(self) -> dict[str, list[object]]:
        """Return the kernels' values for 10, and whether each kernel was in the cache."""
        left_out = {"NUMBA_CACHE_DIR", "PYTHONPATH"}
        environment = {name: value for name, value in os.environ.items() if name not in left_out}
        environment["XDG_CACHE_HOME"] = str(self.cache)
        # Python tells versions of a module apart by size and whole seconds; tests are faster
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        asked = partial(subprocess.run, [sys.executable, "-c", CALL], cwd=self._root)
        told = asked(env=environment, capture_output=True, text=True, check=True)
        return json.loads(told.stdout)

    @property
    def versions(self) -> list[Path]:
        """The folders of kernels, one for each version of the source."""
        return list((self.cache / "mapfusion" / "kernels").iterdir())


@pytest.fixture
def source(tmp_path: Path) -> Source:
    """Called once."""
    source = Source(tmp_path)
    assert source.called() == {"caller": [22, False], "apart": [30, False]}
    return source


def test_kernels_are_compiled_once(source: Source) -> None:
    assert source.called() == {"caller": [22, True], "apart": [30, True]}
    assert len(source.versions) == 1


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(source: Source) -> None:
    source.write("callee", KERNELS["callee"].replace("x + 1", "x + 2"))
    assert source.called() == {"caller": [24, False], "apart": [30, False]}
    source.restore("callee")
    assert source.called() == {"caller": [22, True], "apart": [30, True]}


def test_the_versions_used_last_are_kept(source: Source) -> None:
    (first,) = source.versions
    for age in range(20):
        old = first.with_name(f"old{age}")
        old.mkdir()
        os.utime(old, (1e9 - age, 1e9 - age))
    source.called()
    kept = {path.name for path in source.versions}
    assert kept == {first.name, *(f"old{age}" for age in range(7))}


def test_a_folder_chosen_by_the_user_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "chosen")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    use_kernel_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == "chosen"
    assert not list(tmp_path.iterdir())


def test_kernels_of_experiments_call_none_of_experiments() -> None:
    """The name of the folder says nothing of the source of `experiments`."""
    found = 0
    for path in (SOURCE_ROOT / "experiments").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        ours = {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("experiments")
            for alias in node.names
        }
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and "kernel" in map(
                ast.unparse, node.decorator_list
            ):
                found += 1
                used = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
                assert not used & ours, f"{path}: {node.name}"
    assert found
