"""Tests of `experiments.evaluation.evaluated_run`."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import evaluated_run
from experiments.evaluation.evaluated_run import AlignerTiming
from experiments.evaluation.truth import EvaluatedRobot, MapPair, PathTruth
from mapfusion.align.correspondences import Correspondences
from tests.helpers.made_up_maps import landmark_map

COMPILING_S = 50.0


class Clockwork:
    """Aligner whose first call takes long, like compilation."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def align(self, map_a: Any, map_b: Any, pairs: Any, rng: np.random.Generator) -> Any:
        self.asked.append(len(map_a))
        call = self.asked.count(len(map_a)) - 1
        return SimpleNamespace(elapsed_s=COMPILING_S if len(self.asked) == 1 else float(call))


def grown(name: str, iterations: range) -> EvaluatedRobot:
    """Return a robot that has as many landmarks as frames."""
    points = np.random.default_rng(0).uniform(0, 50, (100, 3))
    maps = {k: landmark_map(points[:k], name) for k in iterations}
    truth = PathTruth(np.zeros((100, 3)), np.zeros(3))
    return EvaluatedRobot(name, maps, {k: points[:k] for k in iterations}, truth)


def met_at(k: int, a: EvaluatedRobot, b: EvaluatedRobot) -> MapPair:
    """Return a pair of maps; there is one correspondence at iteration 25, else none."""
    (map_a, points_a), (map_b, points_b) = a.at(k), b.at(k)
    pairs = np.arange(3, 4 if k == 25 else 3)
    offered = Correspondences(pairs, pairs, np.full(len(pairs), 0.1))
    return MapPair(a, b, k, (map_a, map_b), (points_a, points_b), offered, [], pd.DataFrame())


def test_timings_exclude_compilation_and_include_the_first_and_last_maps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clocks = {"icp": Clockwork(), "svd": Clockwork()}
    monkeypatch.setattr(evaluated_run, "callable_aligner", lambda method, *_: clocks[method])
    evaluate = SimpleNamespace(timing_points=3, timing_repeats=11, true_pair_radius_m=0.1)
    entries = [
        SimpleNamespace(name=name, method=name, parameters={}, time_limit_s=1.0) for name in clocks
    ]
    align = SimpleNamespace(aligners=entries)
    scenario = cast(Any, SimpleNamespace(seed=0, evaluate=evaluate, align=align))
    robots = grown("R1", range(5, 50, 5)), grown("R2", range(5, 30, 5))
    timing = AlignerTiming.of(scenario, [met_at(k, *robots) for k in range(5, 50, 5)])
    # Each aligner was compiled before the timing.
    assert [clock.asked for clock in clocks.values()] == [[5, 45], [5, 45]]
    rows = timing.rows()
    assert [row["iteration"] for row in rows[::2]] == [5, 25, 45]
    assert [row["aligner"] for row in rows] == ["icp", "svd"] * 3
    assert [row["n_correspondences"] for row in rows[::2]] == [0, 1, 0]
    assert [row["n_common"] for row in rows[::2]] == [5, 25, 25]  # R2's log ended at 25
    # The first aligner has a further call that loads the maps into the caches.
    assert clocks["icp"].asked[2:] == [5] * 12 + [25] * 12 + [45] * 12
    assert clocks["svd"].asked[2:] == [5] * 11 + [25] * 11 + [45] * 11
    times = [[row[f"elapsed{end}_s"] for end in ("_low", "", "_high")] for row in rows]
    of_eleven = np.array([1.0, 5.0, 9.0])  # percentiles of 0 to 10
    first_calls = [2, 1, 1, 0, 2, 1]
    np.testing.assert_allclose(times, of_eleven + np.array(first_calls)[:, None])
