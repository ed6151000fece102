"""The worlds of earlier runs: robots with their maps at each evaluated iteration, and the truth."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from experiments.pipeline import plan
from experiments.result import STORE_FOLDER, require_result
from experiments.scenario import Scenario
from experiments.stages.judge import RobotFolders
from experiments.store import Store
from mapfusion.errors import InputError


@dataclass(frozen=True)
class World:
    """One world and the robots that mapped it.

    Attributes:
        name: of the result folder.
        textures: key of the painted walls: equal ones mean the same world.
        robots: where each robot's log and maps lie, by name.
    """

    name: str
    textures: str
    robots: dict[str, RobotFolders]


def load_worlds(results: Sequence[Path]) -> tuple[Scenario, list[World]]:
    """The first result's scenario, and the worlds of all of them.

    Raises:
        InputError: fewer than two, not results of simulations, two of one world, or maps that are
            no longer in the store.
    """
    if len(results) < 2:
        raise InputError("refusal: give two results or more, of different worlds")
    scenarios = [_scenario(result) for result in results]
    worlds = [_world(path, scenario) for path, scenario in zip(results, scenarios, strict=True)]
    by_textures: dict[str, World] = {}
    for path, world in zip(results, worlds, strict=True):
        if world.textures in by_textures:
            other = by_textures[world.textures].name
            raise InputError(f"{path}: the same world as {other}; give another seed's result")
        by_textures[world.textures] = world
    return scenarios[0], worlds


def _scenario(result: Path) -> Scenario:
    require_result(result)
    path = result / "scenario.json"
    try:
        return Scenario.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except (ValidationError, ValueError) as error:
        raise InputError(f"{path}: not a scenario of this version; make it with `run`") from error


def _world(result: Path, scenario: Scenario) -> World:
    if scenario.world is None:
        raise InputError(f"{result}: made from recorded logs; only simulated worlds surely differ")
    planned = plan(scenario, Store(result.resolve().parent / STORE_FOLDER))
    for robot in planned.robots:
        if not (robot.log.finished and robot.slam.finished):
            raise InputError(
                f"{result}: the maps of {robot.name} are not in {result.parent / STORE_FOLDER} "
                "(made by another version?); run its scenario again"
            )
    assert planned.faces is not None
    folders = {robot.name: robot.folders for robot in planned.robots}
    return World(result.name, planned.faces.key, folders)
