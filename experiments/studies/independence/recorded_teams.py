"""The first robots of a scenario as a team: their logs as they are, and all that is made of them.

Robots of a team of three are those of a team of five that drove in the same world and were drawn
into each other's pictures: only what is made of their logs differs. So logs are taken as recorded.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from experiments.evaluation.evaluated_run import JudgedRun
from experiments.evaluation.truth import why_no_truth
from experiments.pipeline.pipeline import PairStages, RobotStages
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.aligner import AlignerSettings
from experiments.pipeline.stages.fuse import FuseSettings
from experiments.pipeline.stages.match import MatchSettings
from experiments.pipeline.stages.slam import SlamSettings
from experiments.pipeline.stages.smooth import SmoothSettings
from experiments.scenario.settings import AnyScenario, Recording, Scenario
from experiments.studies.independence import pair_costs, robot_costs, team_costs
from experiments.studies.independence.pair_costs import PairCostSettings
from experiments.studies.independence.robot_costs import RobotCostSettings
from experiments.studies.independence.strategies import FUSERS
from mapfusion.errors import InputError
from mapfusion.fusion.fusers import USUAL

_LEAST = 2  # robots of a team


def team_sizes(text: str | None, scenario: AnyScenario) -> list[int]:
    """Numbers of robots from `3,5`, in order; all robots of the scenario without a text.

    Raises:
        InputError: they are no numbers, or more robots than there are.
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


def team_of(run: JudgedRun, n_robots: int) -> "RecordedTeam":
    """The first robots of a run whose logs are there.

    Raises:
        InputError: recorded logs whose truth is not known.
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
    kept = {name: value for name, value in scenario if name in Scenario.model_fields}
    logs = [str(run.store.path(robot.log)) for robot in robots]
    recorded = Recording(**kept | changed, logs=logs)
    if reason := why_no_truth(recorded):
        raise InputError(f"scenario {scenario.name}: {reason}; errors cannot be told")
    return RecordedTeam(JudgedRun.of(recorded, run.store))


@dataclass(frozen=True)
class RecordedTeam:
    """A team's stages: those that make its maps, and those that measure what that costs."""

    run: JudgedRun

    @property
    def n_robots(self) -> int:
        """How many they are."""
        return len(self.run.pipeline.robots)

    @property
    def iterations(self) -> tuple[int, ...]:
        """When maps are fused."""
        return self._fuse_settings(USUAL).iterations

    @property
    def estimates(self) -> list[Stage]:
        """The stages to be made, in any number of processes, before anything is measured."""
        pipeline = self.run.pipeline
        smoothed = [robot.smooth for robot in pipeline.robots]
        return [*smoothed, *(pair.estimates for pair in pipeline.pairs)]

    @property
    def measured(self) -> list[Stage]:
        """The stages that are measured, one after the other."""
        return [*self.by_robot.values(), *self.by_pair, *self.by_fuser.values()]

    @cached_property
    def by_robot(self) -> Mapping[str, Stage]:
        """Each robot's own work."""
        return {robot.name: _robot_stage(robot) for robot in self.run.pipeline.robots}

    @cached_property
    def by_pair(self) -> list[Stage]:
        """The alignments."""
        return [_pair_stage(pair, self.iterations) for pair in self.run.pipeline.pairs]

    @cached_property
    def by_fuser(self) -> Mapping[str, Stage]:
        """Fusion, by each fuser."""
        return {
            name: Stage(
                "team_costs",
                team_costs.LABEL,
                self._fuse_settings(name),
                team_costs.run,
                team_costs.WRITES,
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
        """Where what a stage made is."""
        return self.run.store.path(stage)


def _robot_stage(robot: RobotStages) -> Stage:
    filtered, smoothed = robot.slam.settings, robot.smooth.settings
    assert isinstance(filtered, SlamSettings)
    assert isinstance(smoothed, SmoothSettings)
    return Stage(
        "robot_costs",
        robot_costs.LABEL,
        RobotCostSettings(filtered, smoothed),
        robot_costs.run,
        robot_costs.WRITES,
        {"log": robot.log, "slam": robot.slam, "smooth": robot.smooth},
    )


def _pair_stage(pair: PairStages, iterations: tuple[int, ...]) -> Stage:
    aligned = next(iter(pair.aligners.values()))
    match_settings, aligner_settings = pair.match.settings, aligned.settings
    assert isinstance(match_settings, MatchSettings)
    assert isinstance(aligner_settings, AlignerSettings)
    before = {
        "log_a": pair.a.log,
        "slam_a": pair.a.slam,
        "log_b": pair.b.log,
        "slam_b": pair.b.slam,
    }
    # Which batches the aligner was asked in says nothing about what it costs.
    own = replace(aligner_settings, iterations=())
    return Stage(
        "pair_costs",
        pair_costs.LABEL,
        PairCostSettings(match_settings.match, own, iterations),
        pair_costs.run,
        pair_costs.WRITES,
        before,
        loads=aligned.loads,
    )
