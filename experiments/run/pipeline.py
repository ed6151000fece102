"""All stages of a scenario up to the aligners' estimates, laid out; nothing is computed here.

Each stage is handed its own settings, taken from the scenario here and nowhere else.
"""

import itertools
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from experiments.methods.catalogue import Kind, find_method
from experiments.run.stage import WHOLE, RecordedLog, Stage, with_those_before
from experiments.run.stages import (
    align,
    aligner,
    drive,
    faces,
    features,
    log,
    match,
    observed,
    slam,
)
from experiments.run.stages.walls import Walls
from experiments.scenario.settings import (
    NAME_PATTERN,
    AnyScenario,
    Recording,
    Scenario,
    Section,
    Simulation,
)
from mapfusion.errors import InputError
from mapfusion.robot_log import read_log
from mapfusion.vision.frontend import FrontEndParameters
from sim.renderer import renderer_name

S = TypeVar("S")


@dataclass(frozen=True)
class RobotStages:
    """From one robot's log to its maps."""

    name: str
    n_frames: int
    log: Stage | RecordedLog
    slam: Stage


@dataclass(frozen=True)
class SimulatedRobotStages(RobotStages):
    """The same of a robot whose log is simulated."""

    log: Stage
    features: Stage
    observed: Stage


@dataclass(frozen=True)
class PairStages:
    """Two robots, and the aligners' estimates from their maps."""

    a: RobotStages
    b: RobotStages
    estimates: Stage


@dataclass(frozen=True)
class Pipeline:
    """What a scenario's stages lead to: the maps of each robot, the estimates of every two."""

    scenario: AnyScenario
    robots: tuple[RobotStages, ...]
    pairs: tuple[PairStages, ...]

    @property
    def simulated(self) -> list[SimulatedRobotStages]:
        """Robots with images."""
        return [robot for robot in self.robots if isinstance(robot, SimulatedRobotStages)]

    def to_logs(self) -> list[Stage]:
        """What must be done for the robots' logs, each stage after those before it."""
        return with_those_before(robot.log for robot in self.robots)

    def stages(self) -> list[Stage]:
        """All stages, each after those before it; a robot is done before the next one's images."""
        maps = (robot.slam for robot in self.robots)
        return with_those_before([*maps, *(pair.estimates for pair in self.pairs)])


def lay_out(scenario: AnyScenario) -> Pipeline:
    """The stages of a scenario; of recorded logs the names and lengths are read.

    Raises:
        InputError: a recorded log that cannot be read, or names that cannot be used together.
    """
    recorded = isinstance(scenario, Recording)
    robots = tuple(_recorded(scenario) if recorded else _simulated(scenario))
    pairs = tuple(_pair(scenario, a, b) for a, b in itertools.combinations(robots, 2))
    return Pipeline(scenario, robots, pairs)


def _stage(
    module: ModuleType,
    settings: object,
    before: Mapping[str, Stage | RecordedLog] | None = None,
    parts: tuple[str, ...] = WHOLE,
    **more: Any,
) -> Stage:
    """The stage that a module of `experiments.run.stages` does the work of, under its name."""
    name = module.__name__.rpartition(".")[2]
    return Stage(
        name, module.LABEL, settings, module.run, module.WRITES, before or {}, parts, **more
    )


def _filled(kind: type[S], *sections: Section, **own: Any) -> S:
    """A stage's settings: its own, and the others by their names in these sections."""
    known = {name: value for section in sections for name, value in section} | own
    return kind(**{field.name: known[field.name] for field in fields(kind)})  # type: ignore[arg-type]


def _simulated(scenario: Simulation) -> Iterable[RobotStages]:
    world, render, keep = scenario.world, scenario.render, scenario.keep
    lines = tuple(tuple(wall.points) for wall in world.walls)
    walls = Walls(lines, world.wall_height_m, world.wall_thickness_m)
    routes = tuple(_filled(drive.DrivenRobot, robot) for robot in scenario.robots)
    driven = _stage(
        drive, _filled(drive.DriveSettings, scenario, scenario.drive, walls=walls, robots=routes)
    )
    painted = _stage(faces, _filled(faces.FacesSettings, scenario, world, walls=walls))
    n_frames, vision, unread = scenario.drive.frames, scenario.vision, FrontEndParameters()
    finding = replace(unread, harris=vision.harris, stereo=vision.stereo, usurf=vision.usurf)
    tracking = replace(vision, harris=unread.harris, stereo=unread.stereo, usurf=unread.usurf)
    for robot in scenario.robots:
        to_find = _filled(
            features.FeatureSettings,
            *(scenario, render, keep),
            robot=robot.name,
            radiometry=robot.radiometry or scenario.radiometry,
            drawn_by=renderer_name(render.renderer),
            vision=finding,
        )
        world_stages = {"drive": driven, "faces": painted}
        found = _stage(features, to_find, world_stages, features.chunks(n_frames))
        own = {"robot": robot.name, "n_frames": n_frames, "vision": tracking}
        to_track = _filled(observed.ObservedSettings, scenario, keep, **own)
        tracked = _stage(observed, to_track, {"features": found})
        odometry = robot.odometry or scenario.odometry
        to_log = _filled(log.LogSettings, scenario, robot=robot.name, odometry=odometry)
        logged = _stage(log, to_log, {"drive": driven, "observed": tracked})
        mapped = _slam(scenario, logged)
        yield SimulatedRobotStages(robot.name, n_frames, logged, mapped, found, tracked)


def _recorded(scenario: Recording) -> Iterable[RobotStages]:
    """Robots of recorded logs give their names to files, as those of scenarios do."""
    robots: dict[str, RobotStages] = {}
    for folder in map(Path, scenario.logs):
        known, frames = read_log(folder), folder / "frames.parquet"
        name = known.robot
        if not len(known):
            raise InputError(f"{folder}: frames.parquet holds no frame")
        if not re.fullmatch(NAME_PATTERN, name):
            raise InputError(f"{frames}: robot is named {name!r}, expected {NAME_PATTERN}")
        if name in robots:
            raise InputError(f"{frames}: robot {name} is in another log already")
        recorded = RecordedLog(folder)
        robots[name] = RobotStages(name, len(known), recorded, _slam(scenario, recorded))
    return robots.values()


def _slam(scenario: Scenario, logged: Stage | RecordedLog) -> Stage:
    sections = (scenario, scenario.slam, scenario.evaluate, scenario.keep)
    return _stage(slam, _filled(slam.SlamSettings, *sections), {"log": logged})


def _pair(scenario: Scenario, a: RobotStages, b: RobotStages) -> PairStages:
    n_frames = max(a.n_frames, b.n_frames)
    iterations = tuple(slam.evaluated_iterations(n_frames, scenario.evaluate.every))
    parts = match.batches(iterations)
    maps = {"log_a": a.log, "slam_a": a.slam, "log_b": b.log, "slam_b": b.slam}
    to_match = _filled(match.MatchSettings, scenario.align, iterations=iterations)
    before = {"match": _stage(match, to_match, maps, parts)}
    for i, entry in enumerate(scenario.align.aligners):
        method = find_method(entry.method)
        module = method.target.partition(":")[0]
        own = {"origin": method.origin(), "iterations": iterations}
        before[f"aligner {i}"] = _stage(
            aligner,
            _filled(aligner.AlignerSettings, scenario, scenario.align, entry, **own),
            maps | {"match": before["match"]},
            parts,
            alongside=frozenset({"match"}),
            # a plug-in may import whatever helps it
            loads=("mapfusion.align" if method.kind is Kind.PLUG_IN else module,),
        )
    return PairStages(a, b, _stage(align, align.JoinSettings(parts), before))
