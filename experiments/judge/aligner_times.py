"""How long each aligner takes: serial, warmed, repeated (figure 6)."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.judge import tables
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.truth import common_landmarks
from experiments.methods.aligner_calls import callable_aligner
from experiments.scenario.randomness import generator
from experiments.scenario.settings import AnyScenario
from mapfusion.align.correspondences import match

_WARM_UP_RUNS = 1  # compilation and caches


def time_aligners(scenario: AnyScenario, a: EvaluatedRobot, b: EvaluatedRobot, path: Path) -> None:
    """Time every aligner on a pair's maps of growing overlap; a table already there is kept."""
    if not path.is_file():
        tables.write(path, "aligner_timings", _time_pair(scenario, a, b))


def _time_pair(scenario: AnyScenario, a: EvaluatedRobot, b: EvaluatedRobot) -> list[dict[str, Any]]:
    iterations = sorted(set(a.maps) | set(b.maps))
    spread = np.linspace(0, len(iterations) - 1, scenario.evaluate.timing_points)
    aligners = [
        (entry.name, callable_aligner(entry.method, entry.parameters, entry.time_limit_s))
        for entry in scenario.align.aligners
    ]
    rows = []
    for iteration in (iterations[i] for i in sorted(set(spread.round().astype(int).tolist()))):
        (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
        pairs = match(map_a, map_b, scenario.align.match)
        n_common = common_landmarks(points_a, points_b, scenario.evaluate.true_pair_radius_m)
        for name, aligner in aligners:
            elapsed = [
                aligner.align(
                    map_a, map_b, pairs, generator(scenario.seed, "timing", name, repeat)
                ).elapsed_s
                for repeat in range(_WARM_UP_RUNS + scenario.evaluate.timing_repeats)
            ][_WARM_UP_RUNS:]
            low, median, high = np.percentile(elapsed, [10, 50, 90])
            rows.append(
                {
                    "robot_a": a.name,
                    "robot_b": b.name,
                    "iteration": iteration,
                    "aligner": name,
                    "n_correspondences": len(pairs),
                    "n_common": n_common,
                    "elapsed_s": median,
                    "elapsed_low_s": low,
                    "elapsed_high_s": high,
                }
            )
    return rows
