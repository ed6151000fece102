"""A stage's key changes with all that it depends on, and with nothing else."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grimp
import pytest
from tiny_scenario import TINY

from experiments import store as store_module
from experiments.methods.catalogue import find_method
from experiments.pipeline import plan
from experiments.scenario import load_scenario
from experiments.sources import imported_sources
from experiments.stages import align, drive, features, judge, log, slam
from experiments.store import Store, source_hash
from mapfusion.align.registry import ALIGNERS
from mapfusion.errors import InputError
from sim.renderer import egl_driver

STAGES = ["drive", "faces", "features", "observed", "log", "slam", "align", "judge"]


def keys(tmp_path: Path, *overrides: str) -> dict[str, tuple[str, ...]]:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    laid_out = plan(load_scenario(path, overrides), Store(tmp_path / "store"))
    found: dict[str, list[str]] = {stage: [] for stage in STAGES}
    for folder in laid_out.folders():
        found[folder.stage].append(folder.key)
    return {stage: tuple(own) for stage, own in found.items()}


def test_one_robot_s_own_noise_leaves_the_other_s_stages_alone(tmp_path: Path) -> None:
    before = keys(tmp_path)
    for override, stage in (
        ("odometry={scale_sigma: 0.1}", "log"),
        ("radiometry={gain: 0.3}", "features"),
    ):
        after = keys(tmp_path, f"robots.1.{override}")
        assert after[stage][0] == before[stage][0]
        assert after[stage][1] != before[stage][1]


def egl_works() -> bool:
    try:
        egl_driver()
    except InputError:
        return False
    return True


needs_egl = pytest.mark.skipif(not egl_works(), reason="this system has no EGL")
AFTER = {stage: STAGES[i:] for i, stage in enumerate(STAGES)}


@pytest.mark.parametrize(
    ("override", "changed"),
    [
        ("description=other", []),
        ("expect={}", []),
        ("evaluate.timing_repeats=2", []),
        ("evaluate.true_pair_radius_m=0.2", ["judge"]),
        ("merge.parameters.use_drift=false", ["judge"]),
        ("align.aligners.0.parameters={height: {floor_m: 0.02}}", ["align", "judge"]),
        ("align.aligners.0.time_limit_s=5", ["align", "judge"]),
        ("align.repetitions=3", ["align", "judge"]),
        ("align.refinement.gate_m=0.3", ["align", "judge"]),
        ("slam.filter.noise_scale=2", AFTER["slam"]),
        ("slam.min_count=2", AFTER["slam"]),
        ("evaluate.every=5", AFTER["slam"]),
        ("odometry.scale_sigma=0.1", AFTER["log"]),
        ("vision.tracks.min_length=4", AFTER["observed"]),
        ("vision.max_depth_m=4", AFTER["observed"]),
        ("vision.harris.max_corners=50", AFTER["features"]),
        ("camera.baseline_m=0.1", AFTER["features"]),
        ("radiometry.sigma_gray=3", AFTER["features"]),
        ("drive.frames=45", [stage for stage in STAGES if stage != "faces"]),
        ("tags=[ci]", []),
        ("robots.0.odometry={scale_sigma: 0.1}", AFTER["log"]),
        ("robots.0.radiometry={gain: 0.3}", AFTER["features"]),
        ("radiometry.gain=0.3", AFTER["features"]),
        ("robots.0.tire_friction=0.3", [stage for stage in STAGES if stage != "faces"]),
        ("world.texture.contrast=0.5", [stage for stage in STAGES if stage != "drive"]),
        pytest.param("render.renderer=egl", AFTER["features"], marks=needs_egl),
        ("world.wall_height_m=2", STAGES),
        ("seed=4", STAGES),
    ],
)
def test_a_setting_changes_the_keys_of_what_depends_on_it(
    tmp_path: Path, override: str, changed: list[str]
) -> None:
    before, after = keys(tmp_path), keys(tmp_path, override)
    assert [stage for stage in STAGES if before[stage] != after[stage]] == changed


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A small source tree that keys are made of, instead of the real one."""
    root = tmp_path / "source"
    (root / "package").mkdir(parents=True)
    (root / "package" / "a.py").write_text("1")
    (root / "package" / "robot.urdf").write_text("1")
    (root / "package" / "notes.txt").write_text("1")
    (root / "single.py").write_text("1")
    monkeypatch.setattr(store_module, "SOURCE_ROOT", root)
    source_hash.cache_clear()
    yield root
    source_hash.cache_clear()


@pytest.mark.parametrize(
    ("file", "matters"),
    [
        ("package/a.py", True),
        ("package/new.py", True),
        ("package/robot.urdf", True),
        ("single.py", True),
        ("package/notes.txt", False),
        ("other.py", False),
    ],
)
def test_changed_source_gives_a_new_key(source: Path, file: str, matters: bool) -> None:
    def key() -> str:
        source_hash.cache_clear()
        return Store(source).stage("stage", {}, [], ("package", "single.py")).key

    before = key()
    assert key() == before
    (source / file).write_text("2")
    assert (key() != before) == matters


def test_moved_source_gives_a_new_key(source: Path) -> None:
    before = source_hash(("package",))
    (source / "package" / "a.py").rename(source / "package" / "b.py")
    source_hash.cache_clear()
    assert source_hash(("package",)) != before


def test_library_versions_and_stages_before_it_are_in_the_key(
    source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(source)
    first = store.stage("one", {}, [], ())
    other = store.stage("one", {"a": 1}, [], ())
    after = {store.stage("two", {}, before, ()).key for before in ([], [first], [other])}
    assert len(after) == 3
    before = store.stage("two", {}, [], ()).key
    monkeypatch.setattr(store_module, "library_versions", lambda: {"numpy": "0.0"})
    assert store.stage("two", {}, [], ()).key != before


def test_imported_logs_are_known_by_their_content(tmp_path: Path) -> None:
    def key() -> str:
        return Store(tmp_path).imported("log", tmp_path).key

    (tmp_path / "frames.parquet").write_bytes(b"1")
    before = key()
    (tmp_path / "frames.parquet").write_bytes(b"2")
    assert key() != before
    (tmp_path / "frames.parquet").write_bytes(b"1")
    assert key() == before


# Settings are in the key by value, and how files get to disk does not change what is in them.
NOT_RESULTS = {"experiments.scenario", "experiments.store", "experiments.metrics"}
# Reads which files there are; what a name stands for is in the key as the method's target.
NOT_RESULTS |= {"experiments.sources", "mapfusion.align.registry"}
# Shape checks and error texts: they refuse, they compute nothing.
REFUSING = {"mapfusion.arguments", "mapfusion.errors"}
OWN_METHODS = ("opencv", "kiss_matcher", *ALIGNERS)
BUILDS_ON = {"icp": {"impicp"}, "ransac": {"ransac_mahalanobis"}}


def reached(*modules: str, without: set[str] = NOT_RESULTS) -> set[str]:
    """Modules of ours that these import, by another package's reading of the imports."""
    graph: Any = grimp.build_graph("mapfusion", "sim", "experiments")
    found, todo = set[str](), list(modules)
    while todo:
        name = todo.pop()
        if name not in found | without:
            found.add(name)
            todo += graph.find_modules_directly_imported_by(name)
    return found


@pytest.mark.parametrize(
    ("module", "sources"),
    [
        ("drive", drive.SOURCES),
        ("features", features.SOURCES + drive.SOURCES),
        ("log", log.SOURCES + features.SOURCES + drive.SOURCES),
        ("slam", slam.SOURCES),
        ("judge", judge.SOURCES + align.match_sources() + slam.SOURCES),
        # the methods' own source follows below
        ("align", slam.SOURCES + align.match_sources() + align.aligner_sources(find_method("svd"))),
    ],
)
def test_keys_cover_all_the_source_a_stage_runs(module: str, sources: tuple[str, ...]) -> None:
    """`sources` are the stage's own and those of stages before it, whose keys are in its key."""
    covered = [part.removesuffix(".py").replace("/", ".") for part in sources]
    missing = {
        name
        for name in reached(f"experiments.stages.{module}") - REFUSING
        if not any(name == part or name.startswith(f"{part}.") for part in covered)
    }
    assert not missing


@pytest.mark.parametrize("name", OWN_METHODS)
def test_a_method_s_sources_are_what_its_module_imports(name: str) -> None:
    module = find_method(name).target.partition(":")[0]
    files = {part.removesuffix(".py").replace("/", ".") for part in imported_sources(module)}
    packages = {name for name in files if name.endswith(".__init__")}
    assert module in files
    assert files - packages == reached(module, without=set()) - {"mapfusion", "mapfusion.align"}


def test_one_method_s_source_is_not_in_another_s_key() -> None:
    for name in OWN_METHODS:
        own = find_method(name).target.partition(":")[0].replace(".", "/") + ".py"
        elsewhere = {
            other
            for other in OWN_METHODS
            if own in align.aligner_sources(find_method(other)) + align.match_sources()
        }
        assert elsewhere == {name} | BUILDS_ON.get(name, set())


def test_sources_of_no_module_are_an_error() -> None:
    with pytest.raises(ValueError, match=r"mapfusion\.nothing: no module"):
        imported_sources("mapfusion.nothing")
