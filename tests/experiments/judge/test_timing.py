"""How aligners are timed: warmed, repeated, on maps of growing overlap."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from experiments.judge import result, tables
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.truth import PathTruth
from tests.helpers.made_up_maps import landmark_map

COMPILING_S = 50.0


class Clockwork:
    """An aligner whose first call on each maps takes long, as compilation does."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def align(self, map_a: Any, map_b: Any, pairs: Any, rng: np.random.Generator) -> Any:
        self.asked.append(len(map_a))
        call = self.asked.count(len(map_a)) - 1
        return SimpleNamespace(elapsed_s=COMPILING_S if call == 0 else float(call))


def grown(name: str, iterations: range) -> EvaluatedRobot:
    """A robot that has seen as many landmarks as frames."""
    points = np.random.default_rng(0).uniform(0, 50, (100, 3))
    maps = {k: landmark_map(points[:k], name) for k in iterations}
    truth = PathTruth(np.zeros((100, 3)), np.zeros(3))
    return EvaluatedRobot(name, maps, {k: points[:k] for k in iterations}, truth)


def test_compilation_does_not_count_and_first_and_last_maps_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clockwork()
    monkeypatch.setattr(result, "callable_aligner", lambda *_: clock)
    evaluate = SimpleNamespace(timing_points=3, timing_repeats=11, true_pair_radius_m=0.1)
    entry = SimpleNamespace(name="icp", method="icp", parameters={}, time_limit_s=1.0)
    align = SimpleNamespace(aligners=[entry])
    scenario = cast(Any, SimpleNamespace(seed=0, evaluate=evaluate, align=align))
    pair = {"robot_a": "R1", "robot_b": "R2", "iteration": 25, "index_a": 3, "index_b": 3}
    offered = tables.framed("correspondences", [pair | {"descriptor_distance": 0.1}])
    robots = grown("R1", range(5, 50, 5)), grown("R2", range(5, 30, 5))
    rows = result._time_pair(scenario, *robots, offered)
    assert [row["iteration"] for row in rows] == [5, 25, 45]
    assert [row["n_correspondences"] for row in rows] == [0, 1, 0]
    assert [row["n_common"] for row in rows] == [5, 25, 25]  # R2's log ended at 25
    assert clock.asked == [5] * 12 + [25] * 12 + [45] * 12
    for row in rows:
        times = [row[f"elapsed{end}_s"] for end in ("_low", "", "_high")]
        assert times == [2.0, 6.0, 10.0]  # of 1 to 11
