"""Study of the cost of independence: separate maps that are fused, beside one joint smoother.

Costs are measured in this process, one piece after the other, when all other work is done. Each
piece is kept under a key of everything it depends on, so an interrupted study continues.

Robots of a team of three are also robots of a team of five: they drove in the same world and are
visible in each other's pictures. Only the use of their logs differs, so logs are taken as recorded.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.map_errors import (
    EvaluatedFusion,
    GivenMap,
    SmoothedRobot,
    first_shared_iteration,
)
from experiments.evaluation.path_errors import STATISTICS, PlacedPath, team_ate_m
from experiments.evaluation.tables import UNKNOWN
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.align import AlignerSettings, MatchSettings
from experiments.pipeline.stages.fuse import FuseSettings, read_fusions
from experiments.pipeline.stages.slam import SlamSettings
from experiments.pipeline.stages.smooth import SmoothSettings
from experiments.pipeline.store import Store, retry_damaged
from experiments.pipeline.tables import FLOAT, INT, TEXT, fields, read_rows
from experiments.pipeline.tasks import OnProgress, run_tasks, tasks_of
from experiments.pipeline.workers import workers
from experiments.scenario.settings import AnyScenario, Recording, Scenario
from experiments.studies import measured_work
from mapfusion.errors import InputError
from mapfusion.files import schema
from mapfusion.fusion.fusers import REFERENCE, USUAL, make_fuser
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import IDENTITY

_KEYS = {"scenario": TEXT, "seed": INT, "n_robots": INT, "strategy": TEXT, "iteration": INT}
# One row per strategy and iteration; equal bit for bit in every run. first_shared: first evaluated
# iteration at which two maps have common ground, -1 for never; n_merged: number of robots in the
# merged map. Errors are those of this map and of these robots' paths, NaN without a merged map;
# fallback: as in the table `fusers` (else empty). sent: by all robots; most_sent: by one robot.
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
# CPU time and memory, which differ between runs and machines. filter_s and smoothing_s are sums
# over robots; busiest_robot_s is that of the robot with the most work. Peaks are those of one
# robot, and of the work for the team.
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
_TEAM_LABEL = "measure the team's work"
_LEAST = 2  # robots in a team
_MB = 1e6
_Paths = Mapping[str, Mapping[int, Float]]  # (T, 3) by robot and iteration


@dataclass(frozen=True)
class Strategy:
    """A team's strategy to obtain one map.

    Attributes:
        name: name in tables.
        label: name in figures and on the screen.
        fuser: fuser that makes the map.
        sends: message that each robot sends.
        often: True if messages are sent at every fused iteration up to the given one; False if only
            at the given iteration, as if the drive ended there.
    """

    name: str
    label: str
    fuser: str
    sends: str
    often: bool = False

    def asked(self, iterations: tuple[int, ...], at: int) -> list[int]:
        """Return the iterations with messages and fusion, for the map of iteration `at`."""
        return [k for k in iterations if k <= at] if self.often else [at]


STRATEGIES = (
    Strategy("filters", "filters alone, fused once", "kalman-drift", measured_work.FILTER_MAP),
    Strategy("once", "smoothed alone, fused once", USUAL, measured_work.SMOOTHED_MAP),
    Strategy("anew", "smoothed alone, fused anew", USUAL, measured_work.SMOOTHED_MAP, often=True),
    Strategy("together", "all logs in one smoother", REFERENCE, measured_work.LOG),
)
FUSERS = tuple(dict.fromkeys(strategy.fuser for strategy in STRATEGIES))


def team_sizes(text: str | None, scenario: AnyScenario) -> list[int]:
    """Parse numbers of robots such as `3,5`; None means all robots of the scenario.

    Raises:
        InputError: the text is no list of numbers, or asks for more robots than there are.
    """
    names = scenario.logs if isinstance(scenario, Recording) else scenario.robots
    there = len(names)
    if there < _LEAST:
        raise InputError(f"{scenario.name}: has one robot; independence is of two and more")
    if text is None:
        return [there]
    parts = text.split(",")
    sizes = sorted({int(part) for part in parts if part.strip().isdecimal()})
    if len(sizes) < len(parts) or not _LEAST <= sizes[0] <= sizes[-1] <= there:
        wanted = f"expected different numbers of robots from {_LEAST} to {there}, as 2,{there}"
        raise InputError(f"--robots {text}: {wanted}; {scenario.name} has {there} robots")
    return sizes


@dataclass(frozen=True)
class RecordedTeam:
    """A team's stages: those that make its maps, and those that measure their cost."""

    run: EvaluatedRun

    @property
    def n_robots(self) -> int:
        """Number of robots."""
        return len(self.run.pipeline.robots)

    @property
    def iterations(self) -> tuple[int, ...]:
        """Iterations at which maps are fused."""
        return self._fuse_settings(USUAL).iterations

    @property
    def estimates(self) -> list[Stage]:
        """Stages that must be finished, in any number of processes, before measurements."""
        pipeline = self.run.pipeline
        smoothed = [robot.smooth for robot in pipeline.robots]
        both = ((pair.filtered, pair.smoothed) for pair in pipeline.pairs)
        return [*smoothed, *(each.estimates for pair in both for each in pair)]

    @property
    def measured(self) -> list[Stage]:
        """Stages that measure, to be run one after the other."""
        return [*self.by_robot.values(), *self.by_pair, *self.by_fuser.values()]

    @cached_property
    def by_robot(self) -> Mapping[str, Stage]:
        """Measurement of each robot's own work."""
        found = dict[str, Stage]()
        for robot in self.run.pipeline.robots:
            filtered, smoothed = robot.slam.settings, robot.smooth.settings
            assert isinstance(filtered, SlamSettings)
            assert isinstance(smoothed, SmoothSettings)
            found[robot.name] = Stage(
                "robot_costs",
                "measure the robots' work",
                measured_work.RobotCostSettings(filtered, smoothed),
                measured_work.measure_robot,
                measured_work.ROBOT_WRITES,
                {"log": robot.log, "slam": robot.slam, "smooth": robot.smooth},
            )
        return found

    @cached_property
    def by_pair(self) -> list[Stage]:
        """Measurement of the alignment of each pair of maps."""
        found = list[Stage]()
        for pair in self.run.pipeline.pairs:
            aligned = next(iter(pair.smoothed.aligners.values()))
            matched, settings = pair.smoothed.match.settings, aligned.settings
            assert isinstance(matched, MatchSettings)
            assert isinstance(settings, AlignerSettings)
            # the batches of iterations in which the aligner ran do not change its cost
            settings = replace(settings, iterations=())
            inputs = {"log_a": pair.a.log, "slam_a": pair.a.slam, "smooth_a": pair.a.smooth}
            inputs |= {"log_b": pair.b.log, "slam_b": pair.b.slam, "smooth_b": pair.b.smooth}
            found.append(
                Stage(
                    "pair_costs",
                    _TEAM_LABEL,
                    measured_work.PairCostSettings(matched.match, settings, self.iterations),
                    measured_work.measure_pair,
                    (measured_work.COSTS_FILE,),
                    inputs,
                    loads=aligned.loads,
                )
            )
        return found

    @cached_property
    def by_fuser(self) -> Mapping[str, Stage]:
        """Measurement of fusion by each fuser."""
        return {
            name: Stage(
                "team_costs",
                _TEAM_LABEL,
                self._fuse_settings(name),
                measured_work.measure_team,
                measured_work.TEAM_WRITES,
                stage.before,
                loads=stage.loads,
            )
            for name, stage in self.run.pipeline.fusers.items()
        }

    def _fuse_settings(self, fuser: str) -> FuseSettings:
        settings = self.run.pipeline.fusers[fuser].settings
        assert isinstance(settings, FuseSettings)
        return settings

    def folder(self, stage: Stage) -> Path:
        """Return the folder of a stage."""
        return self.run.store.path(stage)


def team_of(run: EvaluatedRun, n_robots: int) -> RecordedTeam:
    """Return the first robots of a run as a team; their logs must exist.

    Raises:
        InputError: the truth of recorded logs is not known.
    """
    scenario, robots = run.scenario, run.pipeline.robots[:n_robots]
    merge = scenario.merge
    chosen = [entry for entry in scenario.align.aligners if entry.name == merge.aligner]
    changed = {
        "align": scenario.align.model_copy(update={"aligners": chosen, "repetitions": 1}),
        "fuse": scenario.fuse.model_copy(update={"fusers": list(FUSERS)}),
        "merge": merge.model_copy(update={"fuser": USUAL}),
        "expect": {},
    }
    inherited = {name: value for name, value in scenario if name in Scenario.model_fields}
    logs = [str(run.store.path(robot.log)) for robot in robots]
    recorded = Recording(**inherited | changed, logs=logs)
    if reason := recorded.why_no_truth():
        raise InputError(f"scenario {scenario.name}: {reason}; its errors are unknown")
    return RecordedTeam(EvaluatedRun.of(recorded, run.store))


def cost_rows(team: RecordedTeam) -> Iterator[dict[str, Any]]:
    """Yield CPU time and peak memory of each strategy at each iteration.

    They are sums from the first iteration on, over robots, pairs and iterations. A robot's own work
    is its filter and the smoothing that the strategy asks for. The team's work is to align all
    pairs of maps and to fuse them.
    """

    def costs_of(stage: Stage) -> pd.DataFrame:
        return read_rows(team.folder(stage) / measured_work.COSTS_FILE, measured_work.WORK_COSTS)

    robots = [costs_of(stage) for stage in team.by_robot.values()]
    pairs = [costs_of(stage) for stage in team.by_pair]
    fusers = {name: costs_of(stage) for name, stage in team.by_fuser.items()}
    for strategy in STRATEGIES:
        for k in team.iterations:
            requested = strategy.asked(team.iterations, k)
            smoothed_at = requested if make_fuser(strategy.fuser).smoothed else []
            own = []  # rows of the filter, and of the smoothing that was asked for, by robot
            for costs in robots:
                filtered = _of(
                    costs, measured_work.FILTER, _own_iterations(costs["iteration"], [k])
                )
                at = _own_iterations(costs["iteration"], smoothed_at)
                own.append((filtered, _of(costs, measured_work.SMOOTHING, at)))
            aligned = pd.concat([_of(costs, measured_work.ALIGNMENT, requested) for costs in pairs])
            fused = _of(fusers[strategy.fuser], measured_work.FUSION, requested)
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
    """Yield the sizes of the robots' messages for each strategy at each iteration."""
    sent = [
        read_rows(team.folder(stage) / measured_work.SENT_FILE, measured_work.SENT)
        for stage in team.by_robot.values()
    ]
    for strategy in STRATEGIES:
        for k in team.iterations:
            requested = strategy.asked(team.iterations, k)
            own_mb = []
            for rows in sent:
                what = rows[rows["what"] == strategy.sends]
                when = _own_iterations(what["iteration"], requested)
                own_mb.append(float(what[what["iteration"].isin(when)]["n_bytes"].sum()) / _MB)
            row = {"strategy": strategy.name, "iteration": k}
            yield row | {"sent_mb": sum(own_mb), "most_sent_mb": max(own_mb)}


def _own_iterations(available: pd.Series, requested: list[int]) -> list[int]:
    """Limit iterations to a robot's own: its log may end before those of others."""
    last = int(available.max())
    return sorted({min(k, last) for k in requested})


def _of(costs: pd.DataFrame, work: str, iterations: list[int]) -> pd.DataFrame:
    """Return the rows of one kind of work at some iterations."""
    return costs[(costs["work"] == work) & costs["iteration"].isin(iterations)]


def error_rows(team: RecordedTeam) -> Iterator[dict[str, Any]]:
    """Yield errors of map and paths of each strategy; NaN where no two maps were merged."""
    run, names = team.run, list(team.by_robot)
    robots = run.load_robots()
    filter_paths = dict[str, Mapping[int, Float]]()
    for stage in team.by_robot.values():
        filter_paths |= measured_work.read_paths(team.folder(stage))
    smoothed = run.load_smoothed(robots)
    first = first_shared_iteration(robots, run.scenario.evaluate.true_pair_radius_m)
    about = {"first_shared": UNKNOWN if first is None else first}
    errors_of: dict[tuple[str, int], dict[str, Any]] = {}
    for fuser, stage in team.by_fuser.items():
        folder = team.folder(stage)
        anew = measured_work.read_paths(folder)
        for k, fusion in read_fusions(folder, names).items():
            beside = smoothed if make_fuser(fuser).smoothed else [None] * len(robots)
            given = [GivenMap.at(*both, k) for both in zip(robots, beside, strict=True)]
            judgement = EvaluatedFusion(fuser, k, fusion, given)
            fused = judgement.fusion
            row = {"n_merged": len(fused.members), "fallback": judgement.fallback}
            if len(fused.members) >= 2:
                paths = []
                for place in map(int, fused.members):
                    truth, T_first_map = robots[place].path, fused.T_first_map[place]
                    poses = anew.get(robots[place].name, {}).get(k)
                    if poses is not None:  # estimated by the fuser, in the fused frame
                        T_first_map = IDENTITY
                    else:
                        poses = _given_path(given[place], smoothed[place], filter_paths, k)
                    true_poses = truth.T_map_robot[: len(poses)]
                    paths.append(PlacedPath(poses, true_poses, T_first_map, truth.T_world_map))
                fit = judgement.fit
                row |= {
                    "n_landmarks": len(fused.landmarks),
                    "landmark_rmse_m": fit.frame_rmse_m,
                    "fitted_rmse_m": fit.rmse_m,
                    "gross_share": fit.gross_share,
                    "path_rmse_m": STATISTICS["rmse"](team_ate_m(paths)),
                }
            errors_of[fuser, k] = row
    for strategy in STRATEGIES:
        for k in team.iterations:
            row = {"strategy": strategy.name, "iteration": k} | about
            yield row | errors_of[strategy.fuser, k]


def _given_path(
    given: GivenMap, smoothed: SmoothedRobot, filter_paths: _Paths, iteration: int
) -> Float:
    """Return the path of a map given to the fuser, shape (T, 3): of the smoother or the filter."""
    for k, landmarks in smoothed.maps.items():
        if given.landmarks is landmarks:
            return smoothed.paths[k]
    filter_path = filter_paths[given.robot.name]
    return filter_path[max(k for k in filter_path if k <= iteration)]


@dataclass(frozen=True)
class Independence:
    """Tables `TEAMS` and `COSTS`."""

    teams: pd.DataFrame
    costs: pd.DataFrame


def run_independence(
    scenarios: Sequence[AnyScenario],
    sizes: Sequence[int],
    store: Store,
    jobs: int,
    on_progress: OnProgress,
) -> Independence:
    """Make logs and maps, measure their cost, and evaluate them.

    Args:
        scenarios: scenarios of one name and different seeds.
        sizes: numbers of robots; a team consists of the first robots.
        store: store of all stages.
        jobs: number of processes for work that is not measured.
        on_progress: called with label, done and total.

    Raises:
        InputError: a recording cannot be read, or its truth is not known.
    """
    teams, costs = [], []
    for scenario in scenarios:
        run = EvaluatedRun.of(scenario, store)
        make = partial(_tables, run, sizes, jobs, on_progress)
        own_teams, own_costs = retry_damaged(store, make)
        teams.append(own_teams.assign(scenario=scenario.name, seed=scenario.seed))
        costs.append(own_costs.assign(scenario=scenario.name, seed=scenario.seed))
    both = (pd.concat(tables, ignore_index=True) for tables in (teams, costs))
    return Independence(*both)


def _tables(
    run: EvaluatedRun, sizes: Sequence[int], jobs: int, on_progress: OnProgress
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the two tables of one seed."""
    if logs := [robot.log for robot in run.pipeline.simulated]:
        run.execute(jobs, on_progress, logs)
    teams = [team_of(run, n_robots) for n_robots in sizes]
    for team in teams:
        team.run.execute(jobs, on_progress, team.estimates)
    stages = {stage.key: stage for team in teams for stage in team.measured}
    with workers(1) as this_process:
        run_tasks(list(tasks_of(stages.values(), run.store).values()), this_process, on_progress)
    found, costs = [], []
    for team in teams:
        errors, sent = (pd.DataFrame(list(rows)) for rows in (error_rows(team), sent_rows(team)))
        both = errors.merge(sent, "left", ["strategy", "iteration"])
        found.append(both.assign(n_robots=team.n_robots))
        costs.append(pd.DataFrame(list(cost_rows(team))).assign(n_robots=team.n_robots))
    return pd.concat(found), pd.concat(costs)


def medians_at_last_iteration(found: Independence) -> pd.DataFrame:
    """Return medians over seeds at the last iteration, one row per size of team and strategy.

    Columns: those of the tables; n_seeds; n_whole, the number of seeds with one map of all robots;
    robots_s and team_s, sums of the columns of robots and of the team.
    """
    teams_with_costs = found.teams.merge(found.costs, "left", _COLUMNS)
    last = teams_with_costs[
        teams_with_costs["iteration"]
        == teams_with_costs.groupby(["seed", "n_robots"])["iteration"].transform("max")
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
    strategy_index = rows["strategy"].map(order.index)
    return (
        rows.assign(place=strategy_index)
        .sort_values(["n_robots", "place"], ignore_index=True)
        .drop(columns="place")
    )


# Columns of `medians_at_last_iteration` in reports: headings of a page and of a screen.
COST_HEADINGS = {
    "robots_s": ("robots' own work, CPU s", "robots'\nCPU s"),
    "busiest_robot_s": ("of the busiest robot", "busiest\nCPU s"),
    "team_s": ("team's work, CPU s", "team's\nCPU s"),
    "robot_peak_mb": ("peak of a robot, MB", "robot\nMB"),
    "team_peak_mb": ("peak of the team's, MB", "team\nMB"),
    "sent_mb": ("sent by all, MB", "sent\nMB"),
    "landmark_rmse_m": ("map in its frame, mm", "map\nmm"),
    "fitted_rmse_m": ("map after a fit, mm", "fitted\nmm"),
    "path_rmse_m": ("paths after a fit, mm", "paths\nmm"),
}
_MM_PER_M = 1000.0


def shown_numbers(rows: pd.DataFrame, name: str) -> pd.Series:
    """Return a column of `COST_HEADINGS` in the unit of its heading: errors in mm."""
    return rows[name] * (_MM_PER_M if name.endswith("rmse_m") else 1.0)
