"""Commands where PyBullet, the extra `sim`, is not installed."""

import importlib.metadata
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from experiments.pipeline import stage
from experiments.pipeline.stage import library_versions
from experiments.pipeline.stages import align, drive, features, fuse, log, slam, smooth
from mapfusion.errors import install_command
from sim.world import World
from tests.helpers.tiny_scenario import assert_refused, command


@pytest.fixture
def no_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)  # its import fails


@pytest.mark.usefixtures("no_simulator")
@pytest.mark.parametrize(
    "words",
    [
        "run SCENARIO",
        "run SCENARIO --set render.renderer=raycast",  # PyBullet still moves the robots
        "run SCENARIO --set render.renderer=egl",
        "check SCENARIO",
        "record SCENARIO -o logs",
        "sweep SCENARIO --seeds 0,1",
        "study independence SCENARIO -o independence",
    ],
)
def test_what_simulates_is_refused_before_any_work(
    words: str,
    tiny_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    reply = command(capsys, *words.replace("SCENARIO", str(tiny_path)).split())
    assert_refused(reply, "PyBullet", install_command("sim"))
    assert len(reply.complaints) == 1
    assert not [*tmp_path.rglob("*.parquet")]


@pytest.mark.usefixtures("no_simulator")
@pytest.mark.parametrize("renderer", ["tiny", "egl"])
def test_a_world_without_it_is_an_input_error(renderer: Any) -> None:
    with pytest.raises(ValueError, match="pip install"):
        World(renderer)


@pytest.mark.usefixtures("no_simulator")
def test_stored_results_and_maps_need_none(
    tiny_path: Path, tiny_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = [tiny_result / "maps" / f"{robot}.parquet" for robot in ("R1", "R2")]
    aligned = command(capsys, "align", *maps, "--scenario", tiny_path, "--json")
    assert (aligned.code, bool(json.loads(aligned.out))) == (0, True)
    for words in (("report", tiny_result, "-o", tmp_path / "r.html"), ("statistics", tiny_result)):
        assert command(capsys, *words).code == 0


def test_only_keys_of_simulated_stages_contain_its_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Results of recordings stay valid when the simulator is installed later."""
    simulated = {drive.DRIVE_STAGE, drive.FACES_STAGE, features.FEATURES_STAGE}
    simulated |= {log.OBSERVED_STAGE, log.LOG_STAGE}
    kinds = {slam.SLAM_STAGE, smooth.SMOOTH_STAGE, fuse.FUSE_STAGE}
    kinds |= simulated | {align.MATCH_STAGE, align.ALIGNER_STAGE, align.ALIGN_STAGE}

    def keys(version: str) -> dict[stage.StageKind, str]:
        def versions(*, simulator: bool) -> dict[str, str]:
            return {"pybullet": version} if simulator else {}

        monkeypatch.setattr(stage, "library_versions", versions)
        return {kind: stage.Stage("", "", {}, kind.work).key for kind in kinds}

    one, other = keys("1"), keys("2")
    assert {kind for kind in kinds if one[kind] != other[kind]} == simulated


def test_versions_leave_out_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    version = importlib.metadata.version

    def without(name: str) -> str:
        if name == "pybullet":
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", without)
    library_versions.cache_clear()
    try:
        assert "pybullet" not in library_versions()
        assert "numpy" in library_versions()
    finally:
        library_versions.cache_clear()
