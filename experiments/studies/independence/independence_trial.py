"""What independence costs, for some seeds and sizes of teams: the tables, from the store.

What is measured is measured in this process, one piece after the other, when all else is done; each
piece is kept under a key of all it depends on, so an interrupted study goes on where it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import pandas as pd

from experiments.evaluation.evaluated_run import JudgedRun
from experiments.pipeline.store import Store, mending
from experiments.pipeline.tables import FLOAT, INT, TEXT, fields
from experiments.pipeline.tasks import OnProgress, run_tasks, tasks_of
from experiments.pipeline.workers import workers
from experiments.scenario.settings import AnyScenario
from experiments.studies.independence.recorded_teams import RecordedTeam, team_of
from experiments.studies.independence.strategies import STRATEGIES
from experiments.studies.independence.team_accounts import cost_rows, sent_rows
from experiments.studies.independence.team_errors import error_rows
from mapfusion.files import schema

_KEYS = {"scenario": TEXT, "seed": INT, "n_robots": INT, "strategy": TEXT, "iteration": INT}
# One row a strategy and iteration; the same, bit for bit, in every run. first_shared: the first
# evaluated iteration at which two maps have common ground, -1 for never; n_merged: robots whose
# maps became one. Errors are of that map and of these robots' paths, NaN where nothing was merged;
# fallback: as in the table `fusers` (else empty). sent: by all robots; most_sent: by one.
TEAMS = schema(
    "independence.teams",
    1,
    fields(
        **_KEYS,
        **dict.fromkeys(("first_shared", "n_merged"), INT),
        **dict.fromkeys(("landmark_rmse_m", "fitted_rmse_m", "gross_share"), FLOAT),
        **dict.fromkeys(("path_rmse_m", "sent_mb", "most_sent_mb"), FLOAT),
        fallback=TEXT,
    ),
)
# CPU time and memory, which differ from run to run and from machine to machine. Of all robots
# together: filter_s, smoothing_s; busiest_robot_s: of the one that works most. Peaks are of one
# robot, and of what is done for the team.
COSTS = schema(
    "independence.costs",
    1,
    fields(
        **_KEYS,
        **dict.fromkeys(("filter_s", "smoothing_s", "busiest_robot_s"), FLOAT),
        **dict.fromkeys(("alignment_s", "fusion_s", "robot_peak_mb", "team_peak_mb"), FLOAT),
    ),
)
_COLUMNS = list(_KEYS)


@dataclass(frozen=True)
class Independence:
    """The tables `TEAMS` and `COSTS`."""

    teams: pd.DataFrame
    costs: pd.DataFrame


def run_independence(
    scenarios: Sequence[AnyScenario],
    sizes: Sequence[int],
    store: Store,
    jobs: int,
    on_progress: OnProgress,
) -> Independence:
    """Make logs and maps, measure, and judge.

    Args:
        scenarios: of one name and different seeds.
        sizes: numbers of robots; each team is the first so many.
        store: where everything is kept.
        jobs: processes, for what is not measured.
        on_progress: is told label, done and total.

    Raises:
        InputError: what is recorded cannot be read, or its truth is not known.
    """
    teams, costs = [], []
    for scenario in scenarios:
        run = JudgedRun.of(scenario, store)
        make = partial(_tables, run, sizes, jobs, on_progress)
        own_teams, own_costs = mending(store, make)
        teams.append(own_teams.assign(scenario=scenario.name, seed=scenario.seed))
        costs.append(own_costs.assign(scenario=scenario.name, seed=scenario.seed))
    both = (pd.concat(tables, ignore_index=True) for tables in (teams, costs))
    return Independence(*both)


def _tables(
    run: JudgedRun, sizes: Sequence[int], jobs: int, on_progress: OnProgress
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Of one seed."""
    if logs := [robot.log for robot in run.pipeline.simulated]:
        run.execute(jobs, on_progress, logs)
    teams = [team_of(run, n_robots) for n_robots in sizes]
    for team in teams:
        team.run.execute(jobs, on_progress, team.estimates)
    stages = {stage.key: stage for team in teams for stage in team.measured}
    with workers(1) as this_process:
        run_tasks(list(tasks_of(stages.values(), run.store).values()), this_process, on_progress)
    made = [_rows(team) for team in teams]
    return pd.concat([each[0] for each in made]), pd.concat([each[1] for each in made])


def _rows(team: RecordedTeam) -> tuple[pd.DataFrame, pd.DataFrame]:
    errors, sent = (pd.DataFrame(list(rows)) for rows in (error_rows(team), sent_rows(team)))
    both = errors.merge(sent, "left", ["strategy", "iteration"])
    costs = pd.DataFrame(list(cost_rows(team)))
    return both.assign(n_robots=team.n_robots), costs.assign(n_robots=team.n_robots)


def at_the_end(found: Independence) -> pd.DataFrame:
    """One row a size of team and strategy: medians over seeds, at the last iteration.

    Columns: those of the tables; n_seeds; n_whole, at how many of them all robots' maps became one;
    robots_s and team_s, the sums of a team's own columns.
    """
    both = found.teams.merge(found.costs, "left", _COLUMNS)
    last = both[
        both["iteration"] == both.groupby(["seed", "n_robots"])["iteration"].transform("max")
    ]
    last = last.assign(
        robots_s=last["filter_s"] + last["smoothing_s"],
        team_s=last["alignment_s"] + last["fusion_s"],
        whole=last["n_merged"] == last["n_robots"],
    )
    order = [strategy.name for strategy in STRATEGIES]
    groups = last.groupby(["n_robots", "strategy"])
    numbers = [name for name in last.select_dtypes("number") if name not in (*_COLUMNS, "n_merged")]
    counts = {"n_seeds": groups.size(), "n_whole": groups["whole"].sum()}
    rows = pd.concat([pd.DataFrame(counts), groups[numbers].median()], axis=1).reset_index()
    place = rows["strategy"].map(order.index)
    return (
        rows.assign(place=place)
        .sort_values(["n_robots", "place"], ignore_index=True)
        .drop(columns="place")
    )
