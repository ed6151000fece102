"""Every aligner on maps with and without common ground, each answer held against chance."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.tables import table_path
from experiments.methods.aligner_calls import callable_aligner
from experiments.run.frames import BOOL, FLOAT, INT, TEXT, fields, read_rows, write_rows
from experiments.run.stages.match import map_at
from experiments.run.stages.slam import evaluated_iterations
from experiments.run.tasks import OnProgress
from experiments.run.workers import workers
from experiments.scenario.randomness import generator
from experiments.scenario.settings import Simulation
from experiments.study.refusal import cases
from experiments.study.refusal.calibration import N_PAIRS_OF_MAPS, calibrate
from experiments.study.refusal.cases import Case
from experiments.study.refusal.stored_worlds import MappedWorld
from mapfusion import se2
from mapfusion.align.registration import Registration
from mapfusion.storage import schema

REPEATED_PER_WORLDS = 9  # posters hung in each pair of worlds

# In `FOLDER/tables/`.
TABLES = {
    # One row per (pair of maps, aligner); errors are NaN for maps of two worlds.
    "refusals": schema(
        "refusal.refusals",
        1,
        fields(
            ground=TEXT,  # apart, common, posters, few or repeated (see cases.py)
            poster_radius_m=FLOAT,  # NaN without a poster
            **dict.fromkeys(("world_a", "robot_a", "world_b", "robot_b"), TEXT),
            iteration=INT,
            aligner=TEXT,
            **dict.fromkeys(("n_correspondences", "n_true", "n_common"), INT),
            n_inliers=INT,  # of the refined alignment: what a threshold on support would go by
            accepted=BOOL,
            log10_false_alarms=FLOAT,
            refined_translation_error_m=FLOAT,
            refined_rotation_error_rad=FLOAT,
        ),
    ),
    # The test itself on made-up maps of walls with random pairs, over every motion of two pairs.
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


def read(folder: Path, name: str) -> pd.DataFrame:
    """Read the table of that name; raises InputError that names the file."""
    return read_rows(table_path(folder, name), TABLES[name])


def run(
    worlds: Sequence[MappedWorld], output: Path, n_apart: int, jobs: int, on_progress: OnProgress
) -> float:
    """Write the tables into a folder; returns the number of false alarms that was accepted.

    The first world's scenario gives methods and iterations; `n_apart` pairs of maps without common
    ground are drawn from all there are.
    """
    scenario = worlds[0].scenario
    crossings = _crossings(scenario, worlds, n_apart)
    done: dict[tuple[str, str], Rows] = {}
    with workers(jobs) as pool:
        for world in worlds:
            pool.submit((world.name, ""), common_rows, scenario, world)
        for a, b, meetings in crossings:
            pool.submit((a.name, b.name), apart_rows, scenario, a, b, meetings)
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


def _iterations(scenario: Simulation) -> list[int]:
    return evaluated_iterations(scenario.drive.frames, scenario.evaluate.every)


def _crossings(
    scenario: Simulation, worlds: Sequence[MappedWorld], n: int
) -> list[tuple[MappedWorld, MappedWorld, list[Meeting]]]:
    """All pairs of worlds of different seeds, with n of their pairs of maps drawn from all."""
    strangers = [
        (a, b) for a, b in itertools.combinations(worlds, 2) if a.scenario.seed != b.scenario.seed
    ]
    possible = [
        (number, meeting)
        for number, (a, b) in enumerate(strangers)
        for meeting in itertools.product(a.folders, b.folders, _iterations(scenario))
    ]
    order = generator(scenario.seed, "refusal").permutation(len(possible))[:n]
    drawn = [possible[k] for k in np.sort(order)]
    return [
        (a, b, [meeting for pair, meeting in drawn if pair == number])
        for number, (a, b) in enumerate(strangers)
    ]


def common_rows(scenario: Simulation, world: MappedWorld) -> Rows:
    """COMMON and FEW pairs of one world; POSTERS of one whose pictures repeat."""
    matching, radius_m = scenario.align.match, scenario.evaluate.true_pair_radius_m
    rows: Rows = []
    for (a, b), iteration in itertools.product(
        itertools.combinations(world.robots(), 2), _iterations(scenario)
    ):
        case = cases.common(a, b, iteration, matching, radius_m)
        if world.scenario.world.texture.posters:  # the same few pictures hang all over it
            met = [replace(case, ground=cases.POSTERS)]
        else:
            rng = generator(scenario.seed, "few", world.name, a.name, b.name, iteration)
            met = [case, cases.few(case, rng)]
        for entry in filter(None, met):
            rows += _answers(scenario, entry, (world.name, world.name), iteration)
    return rows


def apart_rows(
    scenario: Simulation, world_a: MappedWorld, world_b: MappedWorld, meetings: Sequence[Meeting]
) -> Rows:
    """APART and REPEATED pairs of two worlds."""
    in_a, in_b = ({robot.name: robot for robot in w.robots()} for w in (world_a, world_b))
    names, matching = (world_a.name, world_b.name), scenario.align.match
    rows: Rows = []
    for robot_a, robot_b, iteration in meetings:
        maps = map_at(in_a[robot_a].maps, iteration), map_at(in_b[robot_b].maps, iteration)
        rows += _answers(scenario, cases.apart(*maps, matching), names, iteration)
    if len(in_a) < 2:  # no partner has seen what robot a saw
        return rows
    last = _iterations(scenario)[-1]
    first, partner, *_ = in_a.values()
    source = cases.common(first, partner, last, matching, scenario.evaluate.true_pair_radius_m)
    others = [map_at(robot.maps, last) for robot in in_b.values()]
    for number in range(REPEATED_PER_WORLDS):
        each, size = divmod(number, len(cases.POSTER_RADII_M))  # each robot meets each size
        rng = generator(scenario.seed, "poster", *names, number)
        other, radius_m = others[each % len(others)], cases.POSTER_RADII_M[size]
        case = cases.repeated(source, other, radius_m, matching, rng)
        if case is not None:
            rows += _answers(scenario, case, names, last)
    return rows


def _answers(scenario: Simulation, case: Case, worlds: tuple[str, str], iteration: int) -> Rows:
    """One row an aligner: its refined alignment, judged."""
    settings = scenario.align
    names: dict[str, Any] = {"ground": case.ground, "poster_radius_m": case.poster_radius_m}
    names |= {"world_a": worlds[0], "robot_a": case.map_a.name}
    names |= {"world_b": worlds[1], "robot_b": case.map_b.name, "iteration": iteration}
    rows = []
    for entry in settings.aligners:
        rng = generator(scenario.seed, *map(str, names.values()), entry.name)
        aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
        registration = Registration(aligner, settings.refinement, settings.judge)
        _, refined, verdict = registration.register(case.map_a, case.map_b, case.pairs, rng)
        error = refined.T_a_b - case.T_true
        found = {
            "aligner": entry.name,
            "n_correspondences": len(case.pairs),
            "n_true": int(case.is_true.sum()),
            "n_common": case.n_common,
            "n_inliers": int(refined.inlier.sum()),
            "accepted": verdict.accepted,
            "log10_false_alarms": verdict.log10_false_alarms,
            "refined_translation_error_m": np.hypot(error[0], error[1]),
            "refined_rotation_error_rad": float(se2.wrap(error[2])),
        }
        rows.append(names | found)
    return rows
