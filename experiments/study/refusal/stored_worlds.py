"""The worlds of earlier runs and sweeps: robots with their maps by iteration, and the truth."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from experiments.judge.expectations import load_checked
from experiments.judge.judged_run import JudgedRun
from experiments.judge.result import require_result
from experiments.run.stages.slam import RobotFolders
from experiments.run.store import Store
from experiments.scenario.settings import AnyScenario, Simulation
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
    scenario: AnyScenario
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
            store = Store.of(path.resolve().parent)
            found.append(WorldSource(str(path), path.resolve().name, scenario, store))
            continue
        for file in scenarios_of([word]):
            for seed in seeds:
                scenario = load_checked(file, (), seed)
                name = f"{scenario.name}-{seed}"
                found.append(WorldSource(name, name, scenario, Store.of(results)))
    return found


def load_worlds(sources: Sequence[WorldSource]) -> tuple[Simulation, list[MappedWorld]]:
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
    first = sources[0].scenario
    assert isinstance(first, Simulation)  # else `_world` has refused it
    return first, worlds


def _world(source: WorldSource) -> MappedWorld:
    scenario = source.scenario
    if not isinstance(scenario, Simulation):
        raise InputError(
            f"{source.label}: made from recorded logs; only simulated worlds surely differ"
        )
    judged = JudgedRun.of(scenario, source.store)
    for robot in judged.pipeline.simulated:
        if not all(source.store.folder(stage).finished for stage in (robot.log, robot.slam)):
            raise InputError(
                f"{source.label}: the maps of {robot.name} are not in {source.store.root} (made by "
                "another version?); run its scenario again"
            )
    faces = judged.pipeline.simulated[0].features.before["faces"]
    folders = {robot.name: judged.robot_folders(robot) for robot in judged.pipeline.robots}
    repeats = scenario.world.texture.posters > 0
    return MappedWorld(source.name, scenario.seed, faces.key, repeats, folders)
