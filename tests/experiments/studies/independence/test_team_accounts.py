"""Sums over robots, pairs and iterations, worked out by hand."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from experiments.pipeline.tables import write_rows
from experiments.studies.independence.independence_trial import STRATEGIES, cost_rows, sent_rows
from experiments.studies.independence.measured_work import (
    ALIGNMENT,
    COSTS_FILE,
    FILTER,
    FILTER_MAP,
    FUSION,
    LOG,
    SENT,
    SENT_FILE,
    SMOOTHED_MAP,
    SMOOTHING,
    WORK_COSTS,
)

ITERATIONS = (10, 20, 30)
FIRST, LAST = 10, 30


@dataclass
class MadeUpTeam:
    """Where stages would have left their tables."""

    root: Path
    iterations: tuple[int, ...] = ITERATIONS
    by_robot: dict[str, str] = field(default_factory=dict)
    by_pair: list[str] = field(default_factory=list)
    by_fuser: dict[str, str] = field(default_factory=dict)

    def folder(self, stage: str) -> Path:
        return self.root / stage


def costs(team: MadeUpTeam, stage: str, *rows: tuple[int, str, float, float]) -> None:
    names = ("iteration", "work", "cpu_s", "peak_mb")
    made = [dict(zip(names, row, strict=True)) for row in rows]
    write_rows(team.folder(stage) / COSTS_FILE, WORK_COSTS, made)


@pytest.fixture
def team(tmp_path: Path) -> MadeUpTeam:
    """Two robots, of which the second stands still, its log at an end, from iteration 20 on."""
    made = MadeUpTeam(tmp_path)
    made.by_robot, made.by_pair = {"R1": "r1", "R2": "r2"}, ["p"]
    filtered = [(10, FILTER, 1.0, 5.0), (20, FILTER, 2.0, 6.0), (30, FILTER, 3.0, 7.0)]
    smoothed = [(10, SMOOTHING, 10.0, 8.0), (20, SMOOTHING, 20.0, 9.0), (30, SMOOTHING, 40.0, 4.0)]
    costs(made, "r1", *filtered, *smoothed)
    costs(
        made,
        "r2",
        *[(10, FILTER, 0.5, 1.0), (20, FILTER, 0.7, 1.0)],
        *[(10, SMOOTHING, 5.0, 2.0), (20, SMOOTHING, 6.0, 30.0)],
    )
    costs(made, "p", *((k, ALIGNMENT, k / 100, 3.0) for k in ITERATIONS))
    for n, fuser in enumerate(dict.fromkeys(strategy.fuser for strategy in STRATEGIES)):
        made.by_fuser[fuser] = fuser
        costs(made, fuser, *((k, FUSION, 1000.0 * n + k, 100.0 * n + k) for k in ITERATIONS))
    for stage, iterations in (("r1", ITERATIONS), ("r2", ITERATIONS[:2])):
        rows = [
            {"iteration": k, "what": what, "n_bytes": k * size}
            for k in iterations
            for what, size in ((FILTER_MAP, 1_000_000), (SMOOTHED_MAP, 3_000_000), (LOG, 9_000_000))
        ]
        write_rows(tmp_path / stage / SENT_FILE, SENT, rows)
    return made


def by_key(rows: Any) -> dict[tuple[str, int], dict[str, float]]:
    return {(row["strategy"], row["iteration"]): row for row in rows}


def numbers(row: dict[str, float], *names: str) -> list[float]:
    return [pytest.approx(row[name]) for name in names]


def test_costs_are_added_up_once_for_each_time_something_is_done(team: MadeUpTeam) -> None:
    rows = by_key(cost_rows(team))
    assert len(rows) == 4 * 3
    own, peaks = ("filter_s", "smoothing_s", "busiest_robot_s"), ("robot_peak_mb", "team_peak_mb")
    shared = ("alignment_s", "fusion_s")
    # the paper's robots do not smooth
    assert numbers(rows["filters", LAST], *own, *shared) == [3.7, 0.0, 3.0, 0.3, 30.0]
    assert numbers(rows["filters", LAST], *peaks) == [7.0, 30.0]
    # each smooths once, the second at its end, and the filter's time is of the whole way
    assert numbers(rows["once", LAST], *own, *shared) == [3.7, 46.0, 43.0, 0.3, 1030.0]
    assert numbers(rows["once", LAST], *peaks) == [30.0, 130.0]
    # the first three times, the second twice: it has nothing new to smooth at the third
    assert numbers(rows["anew", LAST], *own, *shared) == [3.7, 81.0, 73.0, 0.6, 3060.0]
    assert numbers(rows["anew", LAST], *peaks) == [30.0, 130.0]
    assert numbers(rows["together", LAST], *shared) == [0.3, 2030.0]
    # at the first time it is the same whether once or anew
    once, anew = (dict(rows[name, FIRST], strategy="") for name in ("once", "anew"))
    assert once == anew


def test_what_is_sent_again_counts_again(team: MadeUpTeam) -> None:
    rows = by_key(sent_rows(team))
    names = ("sent_mb", "most_sent_mb")
    assert numbers(rows["filters", LAST], *names) == [30.0 + 20.0, 30.0]
    assert numbers(rows["once", LAST], *names) == [150.0, 90.0]
    assert numbers(rows["anew", LAST], *names) == [3.0 * (60 + 30), 180.0]
    # a log is sent once, whole
    assert numbers(rows["together", LAST], *names) == [450.0, 270.0]
    assert numbers(rows["together", FIRST], *names) == [180.0, 90.0]
