"""Every aligner on maps with and without common ground, each answer held against chance."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.judge.errors import EvaluatedRobot
from experiments.judge.judging import load_robot
from experiments.methods.aligner_calls import callable_aligner
from experiments.run.stages.map_batches import map_at
from experiments.run.stages.slam import evaluated_iterations
from experiments.run.workers import workers
from experiments.scenario.randomness import generator
from experiments.scenario.settings import Simulation
from experiments.study.refusal import cases
from experiments.study.refusal import refusal_tables as results
from experiments.study.refusal.calibration import calibrate
from experiments.study.refusal.cases import Case
from experiments.study.refusal.stored_worlds import Source, World, load_worlds
from mapfusion import se2
from mapfusion.align.acceptance import Acceptance
from mapfusion.align.registration import Registration

REPEATED_PER_WORLDS = 9  # posters hung in each pair of worlds


class Meeting(NamedTuple):
    """A robot of each of two worlds, at one iteration."""

    robot_a: str
    robot_b: str
    iteration: int


def run(
    sources: Sequence[Source],
    output: Path,
    n_apart: int,
    jobs: int,
    on_progress: Callable[[str, int, int], None],
) -> Acceptance:
    """Write the tables `refusals` and `calibration` into a folder; returns the test they used.

    Args:
        sources: different worlds; the first one's scenario gives methods and iterations.
        output: folder.
        n_apart: pairs of maps without common ground, drawn from all there are.
        jobs: processes.
        on_progress: told (stage, done, total).
    """
    scenario, worlds = load_worlds(sources)
    drawn = _drawn_meetings(scenario, worlds, n_apart)
    done: dict[Any, list[dict[str, Any]]] = {}
    with workers(jobs) as pool:
        for world in worlds:
            pool.submit((world.name, ""), common_rows, scenario, world)
        for (i, j), meetings in drawn.items():
            tag = (worlds[i].name, worlds[j].name)
            pool.submit(tag, apart_rows, scenario, worlds[i], worlds[j], meetings)
        total = len(worlds) + len(drawn)
        for tag, rows in pool.completed():
            done[tag] = rows
            on_progress("refusal", len(done), total)
    ordered = [row for tag in sorted(done) for row in done[tag]]
    results.write(output, "refusals", ordered)
    rng = generator(scenario.seed, "calibration")
    calibrated = calibrate(scenario.align.acceptance, rng)
    results.write(output, "calibration", calibrated)
    return scenario.align.acceptance


def _iterations(scenario: Simulation) -> list[int]:
    return evaluated_iterations(scenario.drive.frames, scenario.evaluate.every)


def _drawn_meetings(
    scenario: Simulation, worlds: Sequence[World], n: int
) -> dict[tuple[int, int], list[Meeting]]:
    """Drawn pairs of maps of worlds of different seeds, by pair of worlds; every such is there."""
    strangers = [
        (i, j)
        for i, j in itertools.combinations(range(len(worlds)), 2)
        if worlds[i].seed != worlds[j].seed
    ]
    possible = [
        ((i, j), Meeting(a, b, iteration))
        for i, j in strangers
        for a in worlds[i].robots
        for b in worlds[j].robots
        for iteration in _iterations(scenario)
    ]
    order = generator(scenario.seed, "refusal").permutation(len(possible))[:n]
    meetings = {pair: [] for pair in strangers}
    for k in np.sort(order):
        pair, meeting = possible[k]
        meetings[pair].append(meeting)
    return meetings


def common_rows(scenario: Simulation, world: World) -> list[dict[str, Any]]:
    """COMMON and FEW pairs of one world; POSTERS of one whose pictures repeat."""
    robots = [load_robot(folders) for folders in world.robots.values()]
    rows = []
    for a, b in itertools.combinations(robots, 2):
        for iteration in _iterations(scenario):
            rng = generator(scenario.seed, "few", world.name, a.name, b.name, iteration)
            case = _common(scenario, a, b, iteration)
            fewer = None if world.repeats else cases.few(case, rng)
            if world.repeats:
                case = replace(case, ground=cases.POSTERS)
            for entry in (case, fewer):
                if entry is not None:
                    rows += _answers(scenario, entry, (world.name, world.name), iteration)
    return rows


def apart_rows(
    scenario: Simulation, world_a: World, world_b: World, meetings: Sequence[Meeting]
) -> list[dict[str, Any]]:
    """APART and REPEATED pairs of two worlds."""
    in_a = {name: load_robot(folders) for name, folders in world_a.robots.items()}
    in_b = {name: load_robot(folders) for name, folders in world_b.robots.items()}
    names = world_a.name, world_b.name
    rows = []
    for robot_a, robot_b, iteration in meetings:
        maps = map_at(in_a[robot_a].maps, iteration), map_at(in_b[robot_b].maps, iteration)
        rows += _answers(scenario, cases.apart(*maps, scenario.align.match), names, iteration)
    for iteration, case in _posters(scenario, list(in_a.values()), list(in_b.values()), names):
        rows += _answers(scenario, case, names, iteration)
    return rows


def _posters(
    scenario: Simulation,
    in_a: Sequence[EvaluatedRobot],
    in_b: Sequence[EvaluatedRobot],
    names: tuple[str, str],
) -> Iterator[tuple[int, Case]]:
    """Posters of one world in the other, at the end of the runs."""
    if len(in_a) < 2:  # no partner has seen what robot a saw
        return
    iteration = _iterations(scenario)[-1]
    source = _common(scenario, in_a[0], in_a[1], iteration)
    for number in range(REPEATED_PER_WORLDS):
        rng = generator(scenario.seed, "poster", *names, number)
        # each robot meets each size
        other = map_at(in_b[number // len(cases.POSTER_RADII_M) % len(in_b)].maps, iteration)
        radius_m = cases.POSTER_RADII_M[number % len(cases.POSTER_RADII_M)]
        case = cases.repeated(source, other, radius_m, scenario.align.match, rng)
        if case is not None:
            yield iteration, case


def _common(scenario: Simulation, a: EvaluatedRobot, b: EvaluatedRobot, iteration: int) -> Case:
    radius_m = scenario.evaluate.true_pair_radius_m
    return cases.common(a, b, iteration, scenario.align.match, radius_m)


def _answers(
    scenario: Simulation, case: Case, worlds: tuple[str, str], iteration: int
) -> list[dict[str, Any]]:
    """One row an aligner: its refined alignment, judged."""
    settings = scenario.align
    names = {
        "ground": case.ground,
        "poster_radius_m": case.poster_radius_m,
        "world_a": worlds[0],
        "robot_a": case.map_a.name,
        "world_b": worlds[1],
        "robot_b": case.map_b.name,
        "iteration": iteration,
    }
    rows = []
    for entry in settings.aligners:
        rng = generator(scenario.seed, *map(str, names.values()), entry.name)
        aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
        registration = Registration(aligner, settings.refinement, settings.acceptance)
        _, refined, verdict = registration.register(case.map_a, case.map_b, case.pairs, rng)
        error = refined.T_a_b - case.T_true
        rows.append(
            names
            | {
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
        )
    return rows
