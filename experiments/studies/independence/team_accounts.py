"""What a team's way to one map costs and sends: the sums over robots, pairs and iterations.

Everything is that of the map at an iteration, from the beginning on. A robot's own work is its
filter, which runs on, and the smoothing that was asked for; the team's is aligning all pairs of
maps and fusing them.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.pipeline.tables import read_rows
from experiments.studies.independence.measured_work import COSTS_FILE, WORK_COSTS
from experiments.studies.independence.pair_costs import ALIGNMENT
from experiments.studies.independence.recorded_teams import RecordedTeam
from experiments.studies.independence.robot_costs import FILTER, SENT, SENT_FILE, SMOOTHING
from experiments.studies.independence.strategies import STRATEGIES, Strategy
from experiments.studies.independence.team_costs import FUSION

_MB = 1e6


def cost_rows(team: RecordedTeam) -> Iterator[dict[str, Any]]:
    """CPU time and peak memory of each strategy at each iteration."""
    robots = [_costs(team.folder(stage)) for stage in team.by_robot.values()]
    pairs = [_costs(team.folder(stage)) for stage in team.by_pair]
    fusers = {name: _costs(team.folder(stage)) for name, stage in team.by_fuser.items()}
    for strategy in STRATEGIES:
        for k in team.iterations:
            own = [_robot_costs(costs, strategy, team.iterations, k) for costs in robots]
            asked = strategy.asked(team.iterations, k)
            aligned = pd.concat([_of(costs, ALIGNMENT, asked) for costs in pairs])
            fused = _of(fusers[strategy.fuser], FUSION, asked)
            filtered, smoothed = (pd.concat(parts) for parts in zip(*own, strict=True))
            busiest = max(float(each["cpu_s"].sum()) for each in map(pd.concat, own))
            yield {
                "strategy": strategy.name,
                "iteration": k,
                "filter_s": filtered["cpu_s"].sum(),
                "smoothing_s": smoothed["cpu_s"].sum(),
                "busiest_robot_s": busiest,
                "alignment_s": aligned["cpu_s"].sum(),
                "fusion_s": fused["cpu_s"].sum(),
                "robot_peak_mb": pd.concat([filtered, smoothed])["peak_mb"].max(),
                "team_peak_mb": pd.concat([aligned, fused])["peak_mb"].max(),
            }


def sent_rows(team: RecordedTeam) -> Iterator[dict[str, Any]]:
    """What robots have to send for each strategy at each iteration."""
    sent = [read_rows(team.folder(stage) / SENT_FILE, SENT) for stage in team.by_robot.values()]
    for strategy in STRATEGIES:
        for k in team.iterations:
            asked = strategy.asked(team.iterations, k)
            own_mb = []
            for rows in sent:
                what = rows[rows["what"] == strategy.sends]
                when = _own_iterations(what["iteration"], asked)
                own_mb.append(float(what[what["iteration"].isin(when)]["n_bytes"].sum()) / _MB)
            about = {"strategy": strategy.name, "iteration": k}
            yield about | {"sent_mb": sum(own_mb), "most_sent_mb": max(own_mb)}


def _robot_costs(
    costs: pd.DataFrame, strategy: Strategy, iterations: tuple[int, ...], k: int
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The rows of the filter up to an iteration, and of the smoothing that was asked for."""
    filtered = _of(costs, FILTER, _own_iterations(costs["iteration"], [k]))
    asked = strategy.asked(iterations, k) if strategy.smooths else []
    return filtered, _of(costs, SMOOTHING, _own_iterations(costs["iteration"], asked))


def _own_iterations(known: pd.Series, asked: list[int]) -> list[int]:
    """A robot's own: one whose log ended earlier has done and sent its last by then."""
    last = int(known.max())
    return sorted({min(k, last) for k in asked})


def _costs(folder: Path) -> pd.DataFrame:
    return read_rows(folder / COSTS_FILE, WORK_COSTS)


def _of(costs: pd.DataFrame, work: str, iterations: list[int]) -> pd.DataFrame:
    return costs[(costs["work"] == work) & costs["iteration"].isin(iterations)]
