"""Refusal study: every aligner on maps with and without common ground.

The calibration counts false alarms of the test against chance: all correspondences of its maps are
false and independent, and every motion that two correspondences determine is tested.
"""

import functools
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.evaluation.tables import table_path
from experiments.pipeline.stages.robot_maps import latest_at
from experiments.pipeline.tables import BOOL, FLOAT, INT, TEXT, fields, read_rows, write_rows
from experiments.pipeline.tasks import OnProgress
from experiments.pipeline.workers import workers
from mapfusion.geometry.numerics import generator
from experiments.scenario.settings import Simulation
from experiments.studies import refusal_cases
from experiments.studies.refusal_cases import Case, MappedWorld
from mapfusion.align.alignment import Pairs
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.files import schema
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.verification.false_alarms import (
    Acceptance,
    IndependentPairs,
    fewest_false_alarms,
    independent_pairs,
)

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
        met = [refusal_cases.common(a, b, iteration, matching, radius_m)]
        if not world.repeats:
            rng = generator(scenario.seed, "few", world.name, a.name, b.name, iteration)
            met += filter(None, [refusal_cases.few(met[0], rng)])
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
        rows += _answers(scenario, refusal_cases.apart(*maps, matching), worlds, iteration)
    if len(crossing.a.folders) < 2 or not crossing.hung:  # a poster needs a second robot in world a
        return rows
    in_a, in_b = ({robot.name: robot for robot in world.robots()} for world in worlds)
    last = min(world.iterations[-1] for world in worlds)
    first, partner, *_ = in_a.values()
    source = refusal_cases.common(
        first, partner, last, matching, scenario.evaluate.true_pair_radius_m
    )
    others = [latest_at(robot.maps, last) for robot in in_b.values()]
    for number in range(REPEATED_PER_WORLDS):
        each, size = divmod(
            number, len(refusal_cases.POSTER_RADII_M)
        )  # every robot with every size
        rng = generator(scenario.seed, "poster", crossing.a.name, crossing.b.name, number)
        other, radius_m = others[each % len(others)], refusal_cases.POSTER_RADII_M[size]
        case = refusal_cases.repeated(source, other, radius_m, matching, rng)
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
