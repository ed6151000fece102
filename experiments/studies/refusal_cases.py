"""Cases of the refusal study: pairs of maps with and without common ground.

APART: maps of two worlds; they have no common landmark.
COMMON: maps of one world, at every evaluated iteration.
FEW: a COMMON pair with only the 20 true correspondences around one landmark: the hardest case that
    still counts as a missed merge.
REPEATED: an APART pair with a poster of world a in world b: the landmarks in a disc of common
    ground, as the partner robot saw them, at a random place in map b.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.evaluation.criteria import MERGEABLE_PAIRS
from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.metrics import load_checked
from experiments.evaluation.result import require_result
from experiments.evaluation.truth import EvaluatedRobot, common_landmarks, load_robot, true_pairs
from experiments.pipeline.stages.robot_maps import RobotFolders, stored_maps
from experiments.pipeline.stages.slam import evaluated_iterations
from experiments.pipeline.store import Store
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.suite import parse_seeds
from experiments.scenario.settings import AlignerEntry, AnyScenario, Simulation
from experiments.scenario.suite import scenarios_of
from mapfusion.align.alignment import Alignment
from mapfusion.align.correspondences import Correspondences, MatchParameters, match
from mapfusion.align.refinement import Refinement
from mapfusion.errors import InputError
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.registration import Registration

APART, COMMON = "apart", "common"
FEW, REPEATED = "few", "repeated"
POSTER_RADII_M = (0.5, 1.0, 2.0)  # of a poster, a mural, and half a wall


@dataclass(frozen=True)
class Case:
    """Two maps with their correspondences and the truth.

    Attributes:
        ground: APART, COMMON, FEW or REPEATED.
        map_a: first map.
        map_b: second map.
        pairs: N correspondences.
        is_true: True for true correspondences, shape (N,).
        n_common: number of common landmarks.
        T_true: true T_a_b, shape (3,); NaN without a common world.
        poster_radius_m: radius of the poster; NaN without a poster.
    """

    ground: str
    map_a: LandmarkMap
    map_b: LandmarkMap
    pairs: Correspondences
    is_true: np.ndarray
    n_common: int
    T_true: Float
    poster_radius_m: float = np.nan

    def refined_estimate(
        self, entry: AlignerEntry, refinement: Refinement, rng: np.random.Generator
    ) -> Alignment:
        """Return the refined estimate of one aligner, without a verdict."""
        aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
        registration = Registration(aligner, refinement, verifier=None)
        return registration.register(self.map_a, self.map_b, self.pairs, rng).refined


def apart(map_a: LandmarkMap, map_b: LandmarkMap, matching: MatchParameters) -> Case:
    """Return the case of maps of two worlds."""
    pairs = match(map_a, map_b, matching)
    return Case(APART, map_a, map_b, pairs, np.zeros(len(pairs), bool), 0, np.full(3, np.nan))


def common(
    a: EvaluatedRobot, b: EvaluatedRobot, iteration: int, matching: MatchParameters, radius_m: float
) -> Case:
    """Return the case of maps of one world; they may have no common landmark yet."""
    (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
    pairs = match(map_a, map_b, matching)
    is_true = true_pairs(points_a, points_b, pairs.index_a, pairs.index_b, radius_m)
    n_common = common_landmarks(points_a, points_b, radius_m)
    T_true = se2.between(a.path.T_world_map, b.path.T_world_map)
    return Case(COMMON, map_a, map_b, pairs, is_true, n_common, T_true)


def few(case: Case, rng: np.random.Generator) -> Case | None:
    """Reduce a common case to 20 true correspondences around one of them; None with fewer."""
    true = np.flatnonzero(case.is_true)
    if len(true) <= MERGEABLE_PAIRS:
        return None
    position = case.map_a.position_m[case.pairs.index_a[true]]
    distance = np.linalg.norm(position - position[rng.integers(len(true))], axis=1)
    nearest = true[np.argsort(distance, kind="stable")[:MERGEABLE_PAIRS]]
    chosen = np.sort(np.concatenate([np.flatnonzero(~case.is_true), nearest]))
    return replace(case, ground=FEW, pairs=case.pairs[chosen], is_true=case.is_true[chosen])


def repeated(
    source: Case,
    other: LandmarkMap,
    radius_m: float,
    matching: MatchParameters,
    rng: np.random.Generator,
) -> Case | None:
    """Return map a of a common case with another world's map that contains a poster of map b.

    None if the common case has no true correspondence for the centre of the poster.
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
    """World and the robots that mapped it.

    Attributes:
        label: name in messages.
        name: SCENARIO-SEED, or the name of the result folder.
        scenario: its scenario; worlds of one seed have some pictures in common.
        textures: key of the textured walls; equal keys mean the same world.
        folders: folders of the log and maps of each robot, by name.
    """

    label: str
    name: str
    scenario: Simulation
    textures: str
    folders: dict[str, RobotFolders]

    @property
    def kind(self) -> str:
        """Name of the scenario; worlds of one kind differ in their seeds."""
        return self.scenario.name

    @property
    def repeats(self) -> bool:
        """True if some pictures occur in several places."""
        world = self.scenario.world
        return world.texture.posters > 0 or any(wall.look for wall in world.walls)

    @property
    def iterations(self) -> list[int]:
        """Iterations with stored maps."""
        return evaluated_iterations(self.scenario.drive.frames, self.scenario.evaluate.every)

    def maps(self, robot: str) -> Mapping[int, LandmarkMap]:
        """Return the maps of one robot by iteration, without the truth."""
        return stored_maps(self.folders[robot], viewing=True)

    def robots(self) -> list[EvaluatedRobot]:
        """Return the maps of all robots with the truth."""
        return [load_robot(each) for each in self.folders.values()]


def worlds_of(words: Sequence[str], seeds: Sequence[int], results: Path) -> list[MappedWorld]:
    """Return the different worlds that the words of a command name.

    A word is a result folder of `run`, or a scenario (file, name or tag) with maps in the store of
    `results`. Scenarios use all seeds, or their own as in full@0..9.

    Raises:
        InputError: a word is unknown, there are fewer than two seeds, a world is not simulated or
            occurs twice, or maps are not in the store.
    """
    worlds: list[MappedWorld] = []
    for word in words:
        path = Path(word)
        if path.is_dir():
            require_result(path)
            scenario, folder = load_checked(path / "scenario.json"), path.resolve()
            worlds.append(_world(str(path), folder.name, scenario, Store.of(folder.parent)))
            continue
        name, _, own_seeds = word.partition("@")
        of_word = parse_seeds(own_seeds) if own_seeds else seeds
        for file, seed in itertools.product(scenarios_of([name]), of_word):
            scenario = load_checked(file, (), seed)
            run_name = f"{scenario.name}-{seed}"
            worlds.append(_world(run_name, run_name, scenario, Store.of(results)))
    if len(worlds) < 2:
        raise InputError("refusal: give two worlds or more: results, or scenarios with --seeds")
    for first, world in itertools.combinations(worlds, 2):
        # Two scenarios may share the world of a seed; worlds of one seed are never combined.
        if world.textures == first.textures and world.kind == first.kind:
            raise InputError(f"{world.label}: the same world as {first.name}; give another seed's")
        if world.name == first.name:
            raise InputError(f"{world.label}: is named as {first.label} is; rename one of them")
    if len({world.scenario.seed for world in worlds}) < 2:
        what = f"all worlds have seed {worlds[0].scenario.seed}, and so some pictures in common"
        raise InputError(f"refusal: {what}; give those of another seed too")
    return worlds


def _world(label: str, name: str, scenario: AnyScenario, store: Store) -> MappedWorld:
    """Return the world of a scenario, whose maps must be in the store."""
    if not isinstance(scenario, Simulation):
        raise InputError(f"{label}: made from recorded logs; only simulated worlds surely differ")
    run = EvaluatedRun.of(scenario, store)
    for robot in run.pipeline.simulated:
        if not all(store.folder(stage).finished for stage in (robot.log, robot.slam)):
            what = f"the maps of {robot.name} are not in {store.root} (made by another version?)"
            raise InputError(f"{label}: {what}; run its scenario again")
    faces = run.pipeline.simulated[0].features.before["faces"]
    folders = {robot.name: run.robot_folders(robot) for robot in run.pipeline.robots}
    return MappedWorld(label, name, scenario, faces.key, folders)
