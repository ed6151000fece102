"""A result names its renderer; a missing renderer gives one clear line."""

import json
from pathlib import Path

import pytest

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.result import provenance
from experiments.pipeline.store import Store
from experiments.scenario.loading import load_scenario
from sim import renderer
from sim.renderer import egl_driver
from tests.helpers.tiny_scenario import assert_refused, command


def test_results_record_the_renderer(tiny_result: Path) -> None:
    assert json.loads((tiny_result / "provenance.json").read_text())["renderer"] == "TinyRenderer"


def test_the_renderer_s_driver_is_in_the_record_and_in_the_key(
    tiny_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = load_scenario(tiny_path, ["render.renderer=egl"])
    keys = []
    for driver in ("llvmpipe 22", "llvmpipe 23"):
        monkeypatch.setattr(renderer, "egl_driver", lambda driver=driver: driver)
        laid_out = EvaluatedRun.of(scenario, Store(tmp_path))
        assert provenance(laid_out)["renderer"] == f"OpenGL by EGL ({driver})"
        keys.append(laid_out.pipeline.simulated[0].features.key)
    assert keys[0] != keys[1]


def test_without_egl_a_run_says_what_is_missing(
    tiny_path: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(renderer, "PLUGIN", "no_such_plug_in")
    egl_driver.cache_clear()
    try:
        arguments = ["--set", "render.renderer=egl", "--results", tmp_path, "--jobs", 1]
        reply = command(capsys, "run", tiny_path, *arguments)
    finally:
        egl_driver.cache_clear()
    assert_refused(reply, "render.renderer", "egl", "libegl1", "tiny needs nothing")


def test_an_unknown_renderer_lists_the_known(
    tiny_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(capsys, "run", tiny_path, "--set", "render.renderer=vulkan")
    assert_refused(reply, "render.renderer", "'tiny', 'egl' or 'raycast'", "'vulkan'")


def test_the_ray_caster_is_in_the_record_and_in_the_key(tiny_path: Path, tmp_path: Path) -> None:
    runs = [
        EvaluatedRun.of(load_scenario(tiny_path, [f"render.renderer={name}"]), Store(tmp_path))
        for name in ("tiny", "raycast")
    ]
    assert [provenance(run)["renderer"] for run in runs] == ["TinyRenderer", "our ray caster"]
    tiny, cast = (run.pipeline.simulated[0] for run in runs)
    assert tiny.features.key != cast.features.key
    assert "sim/rendering/walls.py" in cast.features.sources


def test_the_ray_caster_s_camera_stays_below_the_walls_upper_edge(
    tiny_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--set", "world.wall_height_m=0.6", "--set", "camera.mount_z_m=0.8"]
    reply = command(capsys, "run", tiny_path, "--set", "render.renderer=raycast", *arguments)
    assert_refused(reply, "render.renderer", "upper edge (0.6 m)", "camera.mount_z_m is 0.8")
    load_scenario(tiny_path, arguments[1::2])  # tiny looks over them
