"""Every aligner on maps with and without common ground, each answer held against chance."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.judge.judging import load_robot
from experiments.methods.aligner_calls import callable_aligner
from experiments.run.stages.match import map_at
from experiments.run.stages.slam import evaluated_iterations
from experiments.run.tasks import OnProgress
from experiments.run.workers import workers
from experiments.scenario.randomness import generator
from experiments.scenario.settings import Simulation
from experiments.study.refusal import cases
from experiments.study.refusal import refusal_tables as results
from experiments.study.refusal.calibration import calibrate
from experiments.study.refusal.cases import Case
from experiments.study.refusal.stored_worlds import MappedWorld, WorldSource, load_worlds
from mapfusion import se2
from mapfusion.align.acceptance import Acceptance
from mapfusion.align.registration import Registration
from mapfusion.landmark_map import LandmarkMap

REPEATED_PER_WORLDS = 9  # posters hung in each pair of worlds
Rows = list[dict[str, Any]]


class Meeting(NamedTuple):
    """A robot of each of two worlds, at one iteration."""

    robot_a: str
    robot_b: str
    iteration: int


def run(
    sources: Sequence[WorldSource], output: Path, n_apart: int, jobs: int, on_progress: OnProgress
) -> Acceptance:
    """Write the tables `refusals` and `calibration` into a folder; returns the test they used.

    Args:
        sources: different worlds; the first one's scenario gives methods and iterations.
        output: folder.
        n_apart: pairs of maps without common ground, drawn from all there are.
        jobs: processes.
        on_progress: told (label, done, total).
    """
    scenario, worlds = load_worlds(sources)
    by_name = {world.name: world for world in worlds}
    drawn = _drawn_meetings(scenario, worlds, n_apart)
    done: dict[tuple[str, str], Rows] = {}
    with workers(jobs) as pool:
        for world in worlds:
            pool.submit((world.name, ""), common_rows, scenario, world)
        for (a, b), meetings in drawn.items():
            pool.submit((a, b), apart_rows, scenario, by_name[a], by_name[b], meetings)
        for names, rows in pool.completed():
            done[names] = rows
            on_progress("cross the worlds", len(done), len(worlds) + len(drawn))
    results.write(output, "refusals", [row for names in sorted(done) for row in done[names]])
    calibrated = calibrate(scenario.align.acceptance, generator(scenario.seed, "calibration"))
    results.write(output, "calibration", calibrated)
    return scenario.align.acceptance


def _iterations(scenario: Simulation) -> list[int]:
    return evaluated_iterations(scenario.drive.frames, scenario.evaluate.every)


def _drawn_meetings(
    scenario: Simulation, worlds: Sequence[MappedWorld], n: int
) -> dict[tuple[str, str], list[Meeting]]:
    """Drawn pairs of maps of worlds of different seeds, by pair of worlds; every such is there."""
    strangers = [(a, b) for a, b in itertools.combinations(worlds, 2) if a.seed != b.seed]
    possible = [
        ((a.name, b.name), Meeting(*meeting))
        for a, b in strangers
        for meeting in itertools.product(a.robots, b.robots, _iterations(scenario))
    ]
    order = generator(scenario.seed, "refusal").permutation(len(possible))[:n]
    meetings: dict[tuple[str, str], list[Meeting]] = {(a.name, b.name): [] for a, b in strangers}
    for k in np.sort(order):
        names, meeting = possible[k]
        meetings[names].append(meeting)
    return meetings


def common_rows(scenario: Simulation, world: MappedWorld) -> Rows:
    """COMMON and FEW pairs of one world; POSTERS of one whose pictures repeat."""
    robots = [load_robot(folders) for folders in world.robots.values()]
    matching, radius_m = scenario.align.match, scenario.evaluate.true_pair_radius_m
    rows = []
    for (a, b), iteration in itertools.product(
        itertools.combinations(robots, 2), _iterations(scenario)
    ):
        case = cases.common(a, b, iteration, matching, radius_m)
        if world.repeats:
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
    in_a = {name: load_robot(folders) for name, folders in world_a.robots.items()}
    in_b = {name: load_robot(folders) for name, folders in world_b.robots.items()}
    names = world_a.name, world_b.name
    rows = []
    for robot_a, robot_b, iteration in meetings:
        maps = map_at(in_a[robot_a].maps, iteration), map_at(in_b[robot_b].maps, iteration)
        rows += _answers(scenario, cases.apart(*maps, scenario.align.match), names, iteration)
    if len(in_a) >= 2:  # else no partner has seen what robot a saw
        last = _iterations(scenario)[-1]
        first, partner = list(in_a.values())[:2]
        matching, radius_m = scenario.align.match, scenario.evaluate.true_pair_radius_m
        source = cases.common(first, partner, last, matching, radius_m)
        others = [map_at(robot.maps, last) for robot in in_b.values()]
        for case in _posters(scenario, source, others, names):
            rows += _answers(scenario, case, names, last)
    return rows


def _posters(
    scenario: Simulation, source: Case, others: Sequence[LandmarkMap], names: tuple[str, str]
) -> Iterator[Case]:
    """Posters of one world in the other's maps."""
    n_sizes = len(cases.POSTER_RADII_M)
    for number in range(REPEATED_PER_WORLDS):
        rng = generator(scenario.seed, "poster", *names, number)
        other = others[number // n_sizes % len(others)]  # each robot meets each size
        radius_m = cases.POSTER_RADII_M[number % n_sizes]
        case = cases.repeated(source, other, radius_m, scenario.align.match, rng)
        if case is not None:
            yield case


def _answers(scenario: Simulation, case: Case, worlds: tuple[str, str], iteration: int) -> Rows:
    """One row an aligner: its refined alignment, judged."""
    settings = scenario.align
    maps = (case.map_a, case.map_b, case.pairs)
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
        _, refined, verdict = registration.register(*maps, rng)
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
