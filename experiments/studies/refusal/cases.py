"""Cases of the refusal study: pairs of maps with and without common ground.

APART: of two worlds; no landmark is common, whatever the walls' geometry.
COMMON: of one world, at every evaluated iteration.
FEW: a COMMON pair of which only the 20 true correspondences around one landmark are left: the
    first corner of common ground, as hard as the bar for missed merges allows.
REPEATED: an APART pair, but a poster of world a hangs in world b too: the landmarks of a disc of
    common ground, as the partner robot saw them, put at a random place of map b.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.evaluation.alignment_errors import EvaluatedRobot
from experiments.evaluation.checks import load_checked
from experiments.evaluation.criteria import MERGEABLE_PAIRS
from experiments.evaluation.evaluated_run import JudgedRun
from experiments.evaluation.pair_evaluation import load_robot
from experiments.evaluation.result import require_result
from experiments.evaluation.truth import common_landmarks, true_pairs
from experiments.pipeline.stages.slam import RobotFolders, evaluated_iterations, stored_maps
from experiments.pipeline.store import Store
from experiments.scenario.seeds import parse_seeds
from experiments.scenario.settings import AnyScenario, Simulation
from experiments.scenario.suite import scenarios_of
from mapfusion.align.correspondences import Correspondences, MatchParameters, match
from mapfusion.errors import InputError
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap

APART, COMMON = "apart", "common"
FEW, REPEATED = "few", "repeated"
POSTER_RADII_M = (0.5, 1.0, 2.0)  # of a poster, a mural, and half a wall


@dataclass(frozen=True)
class Case:
    """Two maps with their correspondences, and what is true of them.

    Attributes:
        ground: APART, COMMON, FEW or REPEATED.
        n_common: landmarks of both maps that are one point of the world.
        T_true: (3,) NaN without a common world.
        poster_radius_m: NaN without a poster.
    """

    ground: str
    map_a: LandmarkMap
    map_b: LandmarkMap
    pairs: Correspondences
    is_true: np.ndarray
    n_common: int
    T_true: Float
    poster_radius_m: float = np.nan


def apart(map_a: LandmarkMap, map_b: LandmarkMap, matching: MatchParameters) -> Case:
    """Maps of two worlds."""
    pairs = match(map_a, map_b, matching)
    return Case(APART, map_a, map_b, pairs, np.zeros(len(pairs), bool), 0, np.full(3, np.nan))


def common(
    a: EvaluatedRobot, b: EvaluatedRobot, iteration: int, matching: MatchParameters, radius_m: float
) -> Case:
    """Maps of one world (which may have nothing in common yet)."""
    (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
    pairs = match(map_a, map_b, matching)
    is_true = true_pairs(points_a, points_b, pairs.index_a, pairs.index_b, radius_m)
    n_common = common_landmarks(points_a, points_b, radius_m)
    T_true = se2.between(a.path.T_world_map, b.path.T_world_map)
    return Case(COMMON, map_a, map_b, pairs, is_true, n_common, T_true)


def few(case: Case, rng: np.random.Generator) -> Case | None:
    """A common case with 20 true correspondences left, about one of them; None with fewer."""
    true = np.flatnonzero(case.is_true)
    if len(true) <= MERGEABLE_PAIRS:
        return None
    position = case.map_a.position_m[case.pairs.index_a[true]]
    distance = np.linalg.norm(position - position[rng.integers(len(true))], axis=1)
    nearest = true[np.argsort(distance, kind="stable")[:MERGEABLE_PAIRS]]
    kept = np.sort(np.concatenate([np.flatnonzero(~case.is_true), nearest]))
    return replace(case, ground=FEW, pairs=case.pairs[kept], is_true=case.is_true[kept])


def repeated(
    source: Case,
    other: LandmarkMap,
    radius_m: float,
    matching: MatchParameters,
    rng: np.random.Generator,
) -> Case | None:
    """Map a of a common case against another world's map in which a poster of map b hangs.

    None where the common case has no true correspondence to take the poster from.
    """
    true = np.flatnonzero(source.is_true)
    if not len(true) or not len(other):
        return None
    centre = source.map_b.position_m[source.pairs.index_b[rng.choice(true)]]
    apart_m = np.linalg.norm(source.map_b.position_m - centre, axis=1)
    poster = source.map_b[np.flatnonzero(apart_m <= radius_m)]
    hook = other.position_m[rng.integers(len(other))]
    turn = rng.uniform(-np.pi, np.pi)
    T_other_b = np.array([*(hook[:2] - se2.rotation(turn) @ centre[:2]), turn])
    hung = replace(
        poster,
        position_m=se2.transform_points(T_other_b, poster.position_m),
        covariance_m2=se2.transform_covariances(T_other_b, poster.covariance_m2),
    )
    columns = ("position_m", "covariance_m2", "count", "source_observation", "descriptor")
    both = {name: np.concatenate([getattr(other, name), getattr(hung, name)]) for name in columns}
    viewing = None
    if other.viewing is not None and hung.viewing is not None:
        viewing = other.viewing.joined(hung.viewing, turn)
    case = apart(source.map_a, replace(other, viewing=viewing, **both), matching)
    return replace(case, ground=REPEATED, poster_radius_m=radius_m)


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
