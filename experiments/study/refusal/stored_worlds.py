"""The worlds of earlier runs and sweeps: robots with their maps by iteration, and the truth."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.judge.errors import EvaluatedRobot
from experiments.judge.expectations import load_checked
from experiments.judge.judged_run import JudgedRun
from experiments.judge.judging import load_robot
from experiments.judge.result import require_result
from experiments.run.stages.slam import RobotFolders, evaluated_iterations
from experiments.run.stages.snapshots import stored_maps
from experiments.run.store import Store
from experiments.scenario.seeds import parse_seeds
from experiments.scenario.settings import AnyScenario, Simulation
from experiments.scenario.suite import scenarios_of
from mapfusion.errors import InputError
from mapfusion.landmark_map import LandmarkMap


@dataclass(frozen=True)
class MappedWorld:
    """One world and the robots that mapped it.

    Attributes:
        label: how messages call it.
        name: SCENARIO-SEED, or that of the result folder.
        scenario: what it was made from; worlds of one seed have some of their pictures in common.
        textures: key of the painted walls: equal ones mean the same world.
        folders: where each robot's log and maps lie, by name.
    """

    label: str
    name: str
    scenario: Simulation
    textures: str
    folders: dict[str, RobotFolders]

    @property
    def kind(self) -> str:
        """The scenario's name: worlds of one kind differ in their seeds."""
        return self.scenario.name

    @property
    def repeats(self) -> bool:
        """Whether some of its pictures are found in several places."""
        world = self.scenario.world
        return world.texture.posters > 0 or any(wall.look for wall in world.walls)

    @property
    def iterations(self) -> list[int]:
        """At which its maps were kept."""
        return evaluated_iterations(self.scenario.drive.frames, self.scenario.evaluate.every)

    def maps(self, robot: str) -> Mapping[int, LandmarkMap]:
        """One robot's maps by iteration, without the truth."""
        return stored_maps(self.folders[robot])

    def robots(self) -> list[EvaluatedRobot]:
        """All robots' maps joined with the truth."""
        return [load_robot(each) for each in self.folders.values()]


def worlds_of(words: Sequence[str], seeds: Sequence[int], results: Path) -> list[MappedWorld]:
    """The worlds that the words of a command stand for, all different.

    A word is a result folder of `run`; or a scenario file, name or tag, for each of the seeds (or
    of its own, as in full@0..9), whose maps a sweep or a run left in the store of `results`.

    Raises:
        InputError: a word that is none of these, fewer than two seeds, not simulated, two of one
            world, or maps that are not in the store.
    """
    worlds = [world for word in words for world in _worlds(word, seeds, results)]
    if len(worlds) < 2:
        raise InputError("refusal: give two worlds or more: results, or scenarios with --seeds")
    for first, world in itertools.combinations(worlds, 2):
        # two scenarios may drive through one world of a seed; worlds of one seed are never crossed
        if world.textures == first.textures and world.kind == first.kind:
            raise InputError(f"{world.label}: the same world as {first.name}; give another seed's")
        if world.name == first.name:
            raise InputError(f"{world.label}: is named as {first.label} is; rename one of them")
    if len({world.scenario.seed for world in worlds}) < 2:
        what = f"all worlds have seed {worlds[0].scenario.seed}, and so some pictures in common"
        raise InputError(f"refusal: {what}; give those of another seed too")
    return worlds


def _worlds(word: str, seeds: Sequence[int], results: Path) -> Iterator[MappedWorld]:
    path = Path(word)
    if path.is_dir():
        require_result(path)
        scenario, folder = load_checked(path / "scenario.json"), path.resolve()
        yield _world(str(path), folder.name, scenario, Store.of(folder.parent))
        return
    name, _, own_seeds = word.partition("@")
    of_word = parse_seeds(own_seeds) if own_seeds else seeds
    for file, seed in itertools.product(scenarios_of([name]), of_word):
        scenario = load_checked(file, (), seed)
        name = f"{scenario.name}-{seed}"
        yield _world(name, name, scenario, Store.of(results))


def _world(label: str, name: str, scenario: AnyScenario, store: Store) -> MappedWorld:
    if not isinstance(scenario, Simulation):
        raise InputError(f"{label}: made from recorded logs; only simulated worlds surely differ")
    judged = JudgedRun.of(scenario, store)
    for robot in judged.pipeline.simulated:
        if not all(store.folder(stage).finished for stage in (robot.log, robot.slam)):
            what = f"the maps of {robot.name} are not in {store.root} (made by another version?)"
            raise InputError(f"{label}: {what}; run its scenario again")
    faces = judged.pipeline.simulated[0].features.before["faces"]
    folders = {robot.name: judged.robot_folders(robot) for robot in judged.pipeline.robots}
    return MappedWorld(label, name, scenario, faces.key, folders)
