"""How long each aligner takes: serial, warmed, repeated (figure 6)."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.judge import tables
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.judged_run import JudgedRun
from experiments.judge.truth import common_landmarks
from experiments.methods.aligner_calls import callable_aligner
from experiments.scenario.randomness import generator
from experiments.scenario.settings import AnyScenario
from mapfusion.align.correspondences import match

_WARM_UP_RUNS = 1  # compilation and caches


def measure_aligners(run: JudgedRun, robots: Sequence[EvaluatedRobot]) -> None:
    """Time every aligner on each pair's maps of growing overlap; a table already there is kept.

    Serially, when all else is done: nothing else may be running.
    """
    by_name = {robot.name: robot for robot in robots}
    for pair in run.pipeline.pairs:
        path = run.store.path(pair.estimates) / "aligner_timings.parquet"
        if not path.is_file():
            rows = _time_pair(run.scenario, by_name[pair.a.name], by_name[pair.b.name])
            tables.write(path, "aligner_timings", rows)


def _time_pair(scenario: AnyScenario, a: EvaluatedRobot, b: EvaluatedRobot) -> list[dict[str, Any]]:
    settings, iterations = scenario.evaluate, np.array(sorted({*a.maps, *b.maps}))
    spread = np.linspace(0, len(iterations) - 1, settings.timing_points)
    aligners = {
        entry.name: callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
        for entry in scenario.align.aligners
    }
    rows = []
    for iteration in iterations[np.unique(spread.round().astype(int))].tolist():
        (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
        pairs = match(map_a, map_b, scenario.align.match)
        maps = {
            "robot_a": a.name,
            "robot_b": b.name,
            "iteration": iteration,
            "n_correspondences": len(pairs),
            "n_common": common_landmarks(points_a, points_b, settings.true_pair_radius_m),
        }
        for name, aligner in aligners.items():
            rngs = (
                generator(scenario.seed, "timing", name, repeat)
                for repeat in range(_WARM_UP_RUNS + settings.timing_repeats)
            )
            elapsed = [aligner.align(map_a, map_b, pairs, rng).elapsed_s for rng in rngs]
            low, median, high = np.percentile(elapsed[_WARM_UP_RUNS:], [10, 50, 90])
            times = {"elapsed_s": median, "elapsed_low_s": low, "elapsed_high_s": high}
            rows.append({**maps, "aligner": name, **times})
    return rows
