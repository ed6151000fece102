"""Refusal study: every aligner on maps with and without common ground.

The calibration counts false alarms of the test against chance: all correspondences of its maps are
false and independent, and every motion that two correspondences determine is tested.

Cases are pairs of maps with and without common ground. Their kinds (`refusal_rates`):
APART: maps of two worlds; they have no common landmark.
COMMON: maps of one world, at every evaluated iteration.
FEW: a COMMON pair with only the 20 true correspondences around one landmark: the hardest case that
    still counts as a missed merge.
REPEATED: an APART pair with a poster of world a in world b: the landmarks in a disc of common
    ground, as the partner robot saw them, at a random place in map b.
"""

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.evaluation.alignment_criteria import MERGEABLE_PAIRS
from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.metrics import load_checked
from experiments.evaluation.result import require_result
from experiments.evaluation.tables import table_path
from experiments.evaluation.truth import EvaluatedRobot, common_landmarks, load_robot, true_pairs
from experiments.pipeline.stages.slam import evaluated_iterations
from experiments.pipeline.stages.smooth import RobotFolders, latest_at, stored_maps
from experiments.pipeline.store import Store
from experiments.pipeline.tables import BOOL, FLOAT, INT, TEXT, fields, read_rows, write_rows
from experiments.pipeline.tasks import OnProgress
from experiments.pipeline.workers import workers
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.settings import AlignerEntry, AnyScenario, Simulation
from experiments.scenario.suite import parse_seeds, scenarios_of
from experiments.studies.refusal_rates import APART, COMMON, FEW, POSTER_RADII_M, REPEATED
from mapfusion.align.alignment import Alignment, Pairs
from mapfusion.align.correspondences import Correspondences, MatchParameters, match
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.errors import InputError
from mapfusion.files import schema
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, generator, kernel
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import (
    Acceptance,
    IndependentPairs,
    fewest_false_alarms,
    independent_pairs,
)
from mapfusion.verification.registration import Registration


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


N_PAIRS_OF_MAPS = 5000
N_CORRESPONDENCES = 40
SIZE_M = (13.0, 7.0)  # size of the hall in quick.yaml
N_WALLS = 8
STATED = (1e-3, 1e-2, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)


def points_on_walls(rng: np.random.Generator, n: int) -> Float:
    """Draw points, shape (n, 2), on random walls parallel to the axes."""
    corners = rng.uniform(0, SIZE_M, (N_WALLS, 2))
    length_m = rng.uniform(1.0, 6.0, N_WALLS)
    along_x = rng.random(N_WALLS) < 0.5
    wall = rng.integers(N_WALLS, size=n)
    offset = rng.random(n) * length_m[wall]
    return corners[wall] + np.where(along_x[wall, None], [1.0, 0.0], [0.0, 1.0]) * offset[:, None]


def calibrate(acceptance: Acceptance, rng: np.random.Generator, n_pairs: int) -> pd.DataFrame:
    """Return the table `calibration` for a number of random pairs of maps."""
    gates = np.array(sorted(acceptance.gates_m))
    bounds = np.log10(STATED)
    counts = np.zeros((n_pairs, len(STATED)), np.int64)
    for k in range(n_pairs):
        p_a, p_b = points_on_walls(rng, N_CORRESPONDENCES), points_on_walls(rng, N_CORRESPONDENCES)
        pairs = independent_pairs(p_a, p_b, np.zeros((N_CORRESPONDENCES, 4)))
        counts[k] = accepted_motions(pairs, gates, bounds)
    columns = {"stated": STATED, "motions_a_pair": counts.mean(axis=0)}
    columns |= {"n_accepted": np.count_nonzero(counts, axis=0), "n_pairs": n_pairs}
    return pd.DataFrame(columns)


@kernel
def accepted_motions(pairs: IndependentPairs, gates_m: Float, bounds_log10: Float) -> np.ndarray:
    """Count the motions of two correspondences with an NFA up to each bound, shape (S,)."""
    p_a, p_b = pairs.p_a, pairs.p_b
    counts = np.zeros(len(bounds_log10), np.int64)
    T_a_b = np.empty(3)
    two = np.empty(2, np.int64)
    for j in range(len(p_a)):
        for i in range(j):
            two[0], two[1] = i, j
            T_a_b[0], T_a_b[1], T_a_b[2] = fit_rigid(p_a, p_b, two)
            log10, _, _, _ = fewest_false_alarms(pairs, T_a_b, gates_m)
            for s in range(len(bounds_log10)):
                counts[s] += log10 <= bounds_log10[s]
    return counts


REPEATED_PER_WORLDS = 9  # posters in each pair of worlds
REPEATED_WORLDS = 35  # pairs of worlds with posters
# Pairs of maps from two worlds of different seeds; few, because they are similar.
MEETINGS_PER_WORLDS = 10
# Kind of a pair of maps from worlds of two kinds, without and with repetition.
CROSSED, CROSSED_REPEATING = "crossed", "crossed_repeating"

# In `FOLDER/tables/`.
TABLES = {
    # One row per (pair of maps, aligner); errors are NaN for maps of two worlds.
    "refusals": schema(
        "refusal.refusals",
        3,
        fields(
            kind=TEXT,  # scenario of both worlds; crossed or crossed_repeating, of two
            repeats=BOOL,  # pictures of either world occur in several places
            ground=TEXT,  # apart, common, few or repeated (see cases.py)
            poster_radius_m=FLOAT,  # NaN without a poster
            **dict.fromkeys(("world_a", "robot_a", "world_b", "robot_b"), TEXT),
            iteration=INT,
            aligner=TEXT,
            **dict.fromkeys(("n_correspondences", "n_true", "n_common"), INT),
            n_inliers=INT,  # of the refined alignment
            status=TEXT,  # the verdict on the refined alignment
            accepted=BOOL,
            beats_chance=BOOL,  # passes the test against chance
            log10_false_alarms=FLOAT,
            refined_translation_error_m=FLOAT,
            refined_rotation_error_rad=FLOAT,
        ),
    ),
    # Test against chance on random maps of walls, over every motion of two correspondences
    "calibration": schema(
        "refusal.calibration",
        1,
        fields(
            stated=FLOAT,  # expected number of false alarms accepted
            motions_a_pair=FLOAT,  # mean number of motions accepted on a pair of maps
            n_accepted=INT,  # pairs of maps with at least one
            n_pairs=INT,
        ),
    ),
}

Rows = list[dict[str, Any]]
Meeting = tuple[str, str, int]  # a robot of each of two worlds, at one iteration


class Crossing(NamedTuple):
    """Two worlds of different seeds and the pairs of their maps.

    Attributes:
        a: world of the first map of each pair.
        b: world of the second map.
        meetings: pairs of maps.
        hung: True if posters of a are placed in b.
    """

    a: MappedWorld
    b: MappedWorld
    meetings: list[Meeting]
    hung: bool


class PairsDrawn(NamedTuple):
    """Numbers of pairs of maps to evaluate.

    Attributes:
        n_apart: pairs from worlds of different seeds, for each kind of world, and as many from
            worlds of two kinds.
        every: step between evaluated iterations of a run, counted back from the last one; maps of
            neighbouring iterations are similar.
    """

    n_apart: int
    every: int = 1


def read(folder: Path, name: str) -> pd.DataFrame:
    """Read a table by name; raises InputError that names the file."""
    return read_rows(table_path(folder, name), TABLES[name])


def run(
    worlds: Sequence[MappedWorld],
    output: Path,
    drawn: PairsDrawn,
    jobs: int,
    on_progress: OnProgress,
) -> float:
    """Write the tables into a folder, and return the accepted number of false alarms.

    The scenario of the first world gives the aligners.
    """
    scenario = worlds[0].scenario
    crossings = crossings_of(worlds, drawn.n_apart, generator(scenario.seed, "refusal"))
    done: dict[tuple[str, str], Rows] = {}
    with workers(jobs) as pool:
        for world in worlds:
            pool.submit((world.name, ""), common_rows, scenario, world, drawn.every)
        for each in crossings:
            pool.submit((each.a.name, each.b.name), apart_rows, scenario, each)
        for names, rows in pool.completed():
            done[names] = rows
            on_progress("cross the worlds", len(done), len(worlds) + len(crossings))
    acceptance, rng = scenario.align.acceptance, generator(scenario.seed, "calibration")
    made = {
        "refusals": [row for names in sorted(done) for row in done[names]],
        "calibration": calibrate(acceptance, rng, N_PAIRS_OF_MAPS),
    }
    for name, rows in made.items():
        write_rows(table_path(output, name), TABLES[name], rows)
    return acceptance.false_alarms


def crossings_of(worlds: Sequence[MappedWorld], n: int, rng: np.random.Generator) -> list[Crossing]:
    """Draw pairs of worlds of different seeds, and pairs of maps from each.

    There are up to n pairs of maps of each kind, and n of different kinds. Posters are placed in
    pairs of worlds without repetition.
    """
    strangers = [
        (a, b) for a, b in itertools.combinations(worlds, 2) if a.scenario.seed != b.scenario.seed
    ]
    hung = _drawn(
        [k for k, pair in enumerate(strangers) if not _repeats(*pair)], REPEATED_WORLDS, rng
    )
    meetings: dict[int, list[Meeting]] = {k: [] for k in hung}
    kinds = [_kind(a, b) for a, b in strangers]
    for kind in sorted(set(kinds)):
        of_kind = [k for k, name in enumerate(kinds) if name == kind]
        met = _drawn(of_kind, -(-n // MEETINGS_PER_WORLDS), rng)
        possible: list[tuple[int, Meeting]] = []
        for k in met:
            a, b = strangers[k]
            both = sorted({*a.iterations} & {*b.iterations})
            possible += [(k, each) for each in itertools.product(a.folders, b.folders, both)]
        for place in _drawn(range(len(possible)), n, rng):
            k, meeting = possible[place]
            meetings.setdefault(k, []).append(meeting)
    return [Crossing(*strangers[k], meetings[k], k in hung) for k in sorted(meetings)]


def _drawn(items: Sequence[int], n: int, rng: np.random.Generator) -> list[int]:
    """Draw at most n of the items, in their order."""
    return [items[k] for k in np.sort(rng.permutation(len(items))[:n])]


def _kind(a: MappedWorld, b: MappedWorld) -> str:
    """Return the kind of pairs of maps from two worlds."""
    if a.kind == b.kind:
        return a.kind
    return CROSSED_REPEATING if _repeats(a, b) else CROSSED


def _repeats(a: MappedWorld, b: MappedWorld) -> bool:
    """Return True if either world contains repetitions."""
    return a.repeats or b.repeats


def common_rows(scenario: Simulation, world: MappedWorld, every: int) -> Rows:
    """Return rows of COMMON pairs of one world, and of FEW ones if it has no repetition."""
    matching, radius_m = scenario.align.match, scenario.evaluate.true_pair_radius_m
    rows: Rows = []
    for (a, b), iteration in itertools.product(
        itertools.combinations(world.robots(), 2), world.iterations[::-1][::every][::-1]
    ):
        met = [common(a, b, iteration, matching, radius_m)]
        if not world.repeats:
            rng = generator(scenario.seed, "few", world.name, a.name, b.name, iteration)
            met += filter(None, [few(met[0], rng)])
        for case in met:
            rows += _answers(scenario, case, (world, world), iteration)
    return rows


def apart_rows(scenario: Simulation, crossing: Crossing) -> Rows:
    """Return rows of APART and REPEATED pairs of two worlds."""
    worlds, matching = (crossing.a, crossing.b), scenario.align.match
    of_a, of_b = functools.cache(crossing.a.maps), functools.cache(crossing.b.maps)
    rows: Rows = []
    for robot_a, robot_b, iteration in crossing.meetings:
        maps = latest_at(of_a(robot_a), iteration), latest_at(of_b(robot_b), iteration)
        rows += _answers(scenario, apart(*maps, matching), worlds, iteration)
    if len(crossing.a.folders) < 2 or not crossing.hung:  # a poster needs a second robot in world a
        return rows
    in_a, in_b = ({robot.name: robot for robot in world.robots()} for world in worlds)
    last = min(world.iterations[-1] for world in worlds)
    first, partner, *_ = in_a.values()
    source = common(first, partner, last, matching, scenario.evaluate.true_pair_radius_m)
    others = [latest_at(robot.maps, last) for robot in in_b.values()]
    for number in range(REPEATED_PER_WORLDS):
        each, size = divmod(number, len(POSTER_RADII_M))  # every robot with every size
        rng = generator(scenario.seed, "poster", crossing.a.name, crossing.b.name, number)
        other, radius_m = others[each % len(others)], POSTER_RADII_M[size]
        case = repeated(source, other, radius_m, matching, rng)
        if case is not None:
            rows += _answers(scenario, case, worlds, last)
    return rows


def _answers(
    scenario: Simulation, case: Case, worlds: tuple[MappedWorld, MappedWorld], iteration: int
) -> Rows:
    """Return one row per aligner: its refined alignment and the verdict."""
    settings = scenario.align
    names: dict[str, Any] = {"kind": _kind(*worlds), "repeats": _repeats(*worlds)}
    names |= {"ground": case.ground, "poster_radius_m": case.poster_radius_m}
    names |= {"world_a": worlds[0].name, "robot_a": case.map_a.name}
    names |= {"world_b": worlds[1].name, "robot_b": case.map_b.name, "iteration": iteration}
    bound = np.log10(settings.acceptance.false_alarms)
    pairs = Pairs(case.map_a, case.map_b, case.pairs)
    verifier = settings.verifier.on(
        pairs
    )  # evidence is computed once, for answers that beat chance
    rows = []
    for entry in settings.aligners:
        rng = generator(scenario.seed, *map(str, names.values()), entry.name)
        refined = case.refined_estimate(entry, settings.refinement, rng)
        verdict = verifier.verify(refined)
        error = refined.T_a_b - case.T_true
        found = {
            "aligner": entry.name,
            "n_correspondences": len(case.pairs),
            "n_true": int(case.is_true.sum()),
            "n_common": case.n_common,
            "n_inliers": int(refined.inlier.sum()),
            "status": str(verdict.status),
            "accepted": verdict.accepted,
            "beats_chance": bool(verdict.log10_false_alarms <= bound),
            "log10_false_alarms": verdict.log10_false_alarms,
            "refined_translation_error_m": np.hypot(error[0], error[1]),
            "refined_rotation_error_rad": float(se2.wrap(error[2])),
        }
        rows.append(names | found)
    return rows
