"""A `generate` section becomes world and robots when the scenario is loaded."""

import json
from pathlib import Path

import pytest

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.pipeline.store import Store
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.errors import InputError

GENERATED = """
schema_version: 1
name: drawn
seed: 3
generate: {overlap: 0.4, world: {wall_height_m: 2.2, texture: {contrast: 0.5}}}
drive: {frames: 20}
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "drawn.yaml"
    path.write_text(GENERATED, encoding="utf-8")
    return path


def keys(scenario: AnyScenario, folder: Path) -> list[str]:
    return [stage.key for stage in EvaluatedRun.of(scenario, Store(folder)).stages()]


def test_the_loaded_scenario_holds_world_and_robots(path: Path) -> None:
    scenario = load_scenario(path)
    assert isinstance(scenario, Simulation)
    assert len(scenario.world.walls) > 10
    assert (scenario.world.wall_height_m, scenario.world.texture.contrast) == (2.2, 0.5)
    assert [robot.name for robot in scenario.robots] == ["R1", "R2"]
    assert scenario.generated is not None
    assert (scenario.generated.plan_seed, scenario.generated.overlap_asked) == (3, 0.4)
    assert scenario.generated.overlap == pytest.approx(0.4, abs=0.05)


def test_a_drawn_world_is_drawn_by_the_ray_caster_unless_another_is_named(path: Path) -> None:
    named = load_scenario(path, ["render.renderer=tiny"])
    assert isinstance(named, Simulation)
    assert named.render.renderer == "tiny"
    unnamed = load_scenario(path)
    assert isinstance(unnamed, Simulation)
    assert unnamed.render.renderer == "raycast"


def test_pictures_without_filter_have_their_own_errors_of_disparities(path: Path) -> None:
    """By the renderer, and not where the file says it."""
    sharp, coarse = (0.2, 6.0, 0.01, 0.002), (0.7, 3.0, 0.06, 0.003)
    said = "vision.stereo.plane_misfit_px"
    for overrides, expected in (
        ([], sharp),
        (["vision.stereo.half_px=7"], sharp),
        (["render.renderer=tiny"], coarse),
        (["render.renderer=egl"], coarse),
        (["render.renderer=tiny", f"{said}=0.3"], (0.3, 3.0, 0.06, 0.003)),
        (["render.renderer=tiny", "smooth.stray_m=0.005"], (0.7, 3.0, 0.06, 0.005)),
        ([f"{said}=0.4"], (0.4, 6.0, 0.01, 0.002)),
    ):
        scenario = load_scenario(path, overrides)
        assert isinstance(scenario, Simulation)
        stereo = scenario.vision.stereo
        found = stereo.plane_misfit_px, stereo.residual_correlation_px, stereo.sigma_floor_px
        assert (*found, scenario.smooth.stray_m) == expected, overrides


def test_the_resolved_scenario_is_a_scenario_with_the_same_keys(path: Path, tmp_path: Path) -> None:
    scenario = load_scenario(path)
    resolved = tmp_path / "scenario.json"
    resolved.write_text(json.dumps(scenario.resolved()))
    again = load_scenario(resolved)
    assert again == scenario
    assert keys(again, tmp_path) == keys(scenario, tmp_path)


def test_the_seed_draws_the_plan_unless_it_has_its_own(path: Path, tmp_path: Path) -> None:
    first, same, other = load_scenario(path), load_scenario(path), load_scenario(path, seed=4)
    assert first == same
    assert first.world != other.world
    fixed = [load_scenario(path, ["generate.plan_seed=7"], seed) for seed in (1, 2)]
    assert fixed[0].world == fixed[1].world
    assert fixed[0].robots == fixed[1].robots
    assert first.world != fixed[0].world
    assert keys(fixed[0], tmp_path)[0] != keys(fixed[1], tmp_path)[0]  # the start jitter differs


def test_an_override_changes_what_is_drawn(path: Path) -> None:
    apart = load_scenario(path, ["generate.overlap=0", "generate.robots=3"])
    assert apart.generated is not None
    assert apart.generated.overlap == 0
    assert len(apart.robots) == 3


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("generate.overlap=2", ["generate.overlap: is 2,", "[0, 1]"]),
        ("generate.overlap=lots", ["generate.overlap", "'lots'"]),
        ("generate.bogus=1", ["generate.bogus: unknown key", "rooms_a_side"]),
        ("generate.door_m=0.5", ["door_m: is 0.5"]),
        ("generate.loop_m=[90, 95]", ["generate.loop_m: no loop of 90 to 95 m"]),
        ("generate.plan_seed=-1", ["plan_seed"]),
        ("generate.world.walls=[]", ["world.walls", "are drawn"]),
        ("generate.world.bogus=1", ["world.bogus", "unknown key"]),
        ("generate.world.texture.posters=-1", ["texture", "posters: is -1", "[0, 100] posters"]),
        ("robots=[{name: a, start: [1, 1, 0], route: [[2, 2]]}]", ["no robots; leave it out"]),
        ("seed=x", ["seed", "'x'"]),
        ("drive=null", ["generate stands for"]),
    ],
)
def test_what_cannot_be_drawn_is_told_in_one_line(
    path: Path, override: str, words: list[str]
) -> None:
    with pytest.raises(InputError) as told:
        load_scenario(path, [override])
    assert "\n" not in str(told.value)
    for word in ["drawn.yaml", *words]:
        assert word in str(told.value)
