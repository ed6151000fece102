"""The worlds of earlier runs and sweeps: robots with their maps by iteration, and the truth."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from experiments.judge.expectations import load_checked
from experiments.judge.judging import RobotFolders
from experiments.judge.pipeline import plan
from experiments.judge.result import STORE_FOLDER, require_result
from experiments.run.store import Store
from experiments.scenario.settings import Scenario
from experiments.scenario.suite import scenarios_of
from mapfusion.errors import InputError


@dataclass(frozen=True)
class MappedWorld:
    """One world and the robots that mapped it.

    Attributes:
        name: SCENARIO-SEED, or that of the result folder.
        seed: of its pictures: worlds of one seed hang some of them on the same walls.
        textures: key of the painted walls: equal ones mean the same world.
        repeats: the same few pictures hang all over it.
        robots: where each robot's log and maps lie, by name.
    """

    name: str
    seed: int
    textures: str
    repeats: bool
    robots: dict[str, RobotFolders]


class WorldSource(NamedTuple):
    """Where a world comes from: how messages call it, its scenario, and what keeps its maps."""

    label: str
    name: str
    scenario: Scenario
    store: Store


def sources_of(worlds: Sequence[str], seeds: Sequence[int], results: Path) -> list[WorldSource]:
    """What the words of a command stand for.

    Args:
        worlds: result folders of `run`; or scenario files, names or tags, for each seed, whose maps
            a sweep or a run left in the store of `results`.
        seeds: of the scenarios.
        results: folder.

    Raises:
        InputError: a word that is none of these.
    """
    found = []
    for word in worlds:
        path = Path(word)
        if path.is_dir():
            require_result(path)
            scenario = load_checked(path / "scenario.json")
            store = Store(path.resolve().parent / STORE_FOLDER)
            found.append(WorldSource(str(path), path.resolve().name, scenario, store))
            continue
        for file in scenarios_of([word]):
            for seed in seeds:
                scenario = load_checked(file, (), seed)
                name = f"{scenario.name}-{seed}"
                found.append(WorldSource(name, name, scenario, Store(results / STORE_FOLDER)))
    return found


def load_worlds(sources: Sequence[WorldSource]) -> tuple[Scenario, list[MappedWorld]]:
    """The first source's scenario, and the worlds of all of them.

    Raises:
        InputError: fewer than two seeds, not simulated, two of one world, or maps that are not in
            the store.
    """
    if len(sources) < 2:
        raise InputError("refusal: give two worlds or more: results, or scenarios with --seeds")
    worlds = [_world(source) for source in sources]
    for (one, first), (source, world) in itertools.combinations(
        zip(sources, worlds, strict=True), 2
    ):
        if world.textures == first.textures:
            raise InputError(f"{source.label}: the same world as {first.name}; give another seed's")
        if world.name == first.name:
            raise InputError(f"{source.label}: is named as {one.label} is; rename one of them")
    if len({world.seed for world in worlds}) < 2:
        raise InputError(
            f"refusal: all worlds have seed {worlds[0].seed}, and so some pictures in common; give "
            "those of another seed too"
        )
    return sources[0].scenario, worlds


def _world(source: WorldSource) -> MappedWorld:
    scenario = source.scenario
    if scenario.world is None:
        raise InputError(
            f"{source.label}: made from recorded logs; only simulated worlds surely differ"
        )
    planned = plan(scenario, source.store)
    for robot in planned.robots:
        if not (robot.log.finished and robot.slam.finished):
            raise InputError(
                f"{source.label}: the maps of {robot.name} are not in {source.store.root} (made by "
                "another version?); run its scenario again"
            )
    assert planned.faces is not None
    folders = {robot.name: robot.folders for robot in planned.robots}
    repeats = scenario.world.texture.posters > 0
    return MappedWorld(source.name, scenario.seed, planned.faces.key, repeats, folders)
