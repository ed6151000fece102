"""Pipeline of a scenario: all stages up to the aligners' estimates; nothing is computed here.

Each stage is handed its own settings, taken from the scenario here and nowhere else.
"""

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from experiments.pipeline.stage import RecordedLog, Stage, in_dependency_order
from experiments.pipeline.stages import (
    align,
    aligner,
    drive,
    faces,
    features,
    fuse,
    log,
    match,
    observed,
    slam,
    smooth,
)
from experiments.pipeline.stages.faces import Walls
from experiments.plugins.discovery import Kind, find_method, fingerprint
from experiments.scenario.settings import AnyScenario, Recording, Scenario, Simulation
from experiments.scenario.world_settings import NAME_PATTERN, TAKEN_NAMES, Section
from mapfusion.errors import InputError
from mapfusion.fusion.fused_map import name_order
from mapfusion.fusion.fusers import FUSERS, target_of
from mapfusion.robot_log import read_log
from mapfusion.smoother.smooth import SmootherParameters
from mapfusion.vision.front_end import FrontEndParameters
from sim.renderer import renderer_name


@dataclass(frozen=True)
class RobotStages:
    """From one robot's log to its maps."""

    name: str
    n_frames: int
    log: Stage | RecordedLog
    slam: Stage
    smooth: Stage


@dataclass(frozen=True)
class SimulatedRobotStages(RobotStages):
    """The same of a robot whose log is simulated."""

    log: Stage
    features: Stage
    observed: Stage


@dataclass(frozen=True)
class PairStages:
    """Two robots, and the aligners' estimates from their maps.

    Attributes:
        a: the first robot by name.
        b: the second.
        match: correspondences and rivals.
        aligners: by the name that the scenario gives them.
        estimates: all of these joined.
    """

    a: RobotStages
    b: RobotStages
    match: Stage
    aligners: Mapping[str, Stage]
    estimates: Stage


@dataclass(frozen=True)
class Pipeline:
    """What a scenario's stages lead to: maps of each robot, estimates of every two, fused maps."""

    scenario: AnyScenario
    robots: tuple[RobotStages, ...]
    pairs: tuple[PairStages, ...]
    fusers: Mapping[str, Stage]  # by name; none for a single robot

    @property
    def simulated(self) -> list[SimulatedRobotStages]:
        """Robots with images."""
        return [robot for robot in self.robots if isinstance(robot, SimulatedRobotStages)]

    def stages(self) -> list[Stage]:
        """All stages, each after those before it; in the order in which they keep processes busy.

        What is made in one piece (a robot's tracks, its filter) is made for all robots at a time,
        and not for the last one while others wait. Fused maps need one aligner only and are made in
        few long pieces, so they come before the others' estimates: many short pieces at the end
        keep all processes at work until then.
        """
        images = [robot.features for robot in self.simulated]
        logs = [robot.log for robot in self.simulated]
        filters = [robot.slam for robot in self.robots]
        maps = [robot.smooth for robot in self.robots]
        estimates = (pair.estimates for pair in self.pairs)
        in_order = [*images, *logs, *filters, *maps, *self.fusers.values(), *estimates]
        return in_dependency_order(in_order)


def build_pipeline(scenario: AnyScenario) -> Pipeline:
    """The stages of a scenario; of recorded logs the names and lengths are read.

    Raises:
        InputError: a recorded log that cannot be read, or names that cannot be used together.
    """
    recorded = isinstance(scenario, Recording)
    robots = tuple(_recorded(scenario) if recorded else _simulated(scenario))
    pairs = tuple(_pair(scenario, *both) for both in itertools.combinations(robots, 2))
    fusers = _fusers(scenario, robots, pairs) if pairs else {}
    return Pipeline(scenario, robots, pairs, fusers)


def _stage(module: ModuleType, *sections: Section, own: dict[str, Any], **more: Any) -> Stage:
    """The stage that a module of `experiments.pipeline.stages` does the work of, under its name.

    It is told the fields of its settings and no others: its own, and from the sections by name.
    """
    kind = module.run.__annotations__["settings"]
    known = {name: value for section in sections for name, value in section} | own
    settings = kind(**{field.name: known[field.name] for field in fields(kind)})
    name = module.__name__.rpartition(".")[2]
    return Stage(name, module.LABEL, settings, module.run, module.WRITES, **more)


def _simulated(scenario: Simulation) -> Iterable[RobotStages]:
    world, render, keep = scenario.world, scenario.render, scenario.keep
    lines = tuple(tuple(wall.points) for wall in world.walls)
    walls = Walls(lines, world.wall_height_m, world.wall_thickness_m)
    routes = tuple(
        drive.DrivenRobot(robot.name, robot.start, robot.route, robot.loop, robot.tire_friction)
        for robot in scenario.robots
    )
    driven = _stage(drive, scenario, scenario.drive, own={"walls": walls, "robots": routes})
    to_paint = {"walls": walls, "looks": tuple((wall.look, wall.mirrored) for wall in world.walls)}
    before = {"drive": driven, "faces": _stage(faces, scenario, world, own=to_paint)}
    n_frames, drawn_by = scenario.drive.frames, renderer_name(render.renderer)
    vision, unread = scenario.vision, FrontEndParameters()
    finding = replace(unread, harris=vision.harris, stereo=vision.stereo, usurf=vision.usurf)
    tracking = replace(vision, harris=unread.harris, stereo=unread.stereo, usurf=unread.usurf)
    for robot in scenario.robots:
        own = {"robot": robot.name, "n_frames": n_frames, "drawn_by": drawn_by}
        own["radiometry"] = robot.radiometry or scenario.radiometry
        own["odometry"] = robot.odometry or scenario.odometry
        chunks, to_find = features.chunks(n_frames), own | {"vision": finding}
        found = _stage(features, scenario, render, keep, own=to_find, before=before, parts=chunks)
        to_track, images = own | {"vision": tracking}, {"drive": driven, "features": found}
        tracked = _stage(observed, scenario, keep, own=to_track, before=images)
        logged = _stage(log, scenario, own=own, before={"drive": driven, "observed": tracked})
        mapped = _slam(scenario, logged)
        smoothed = _smooth(scenario, logged, mapped, n_frames, n_frames)
        yield SimulatedRobotStages(robot.name, n_frames, logged, mapped, smoothed, found, tracked)


def _recorded(scenario: Recording) -> Iterable[RobotStages]:
    """Robots of recorded logs give their names to files, as those of scenarios do."""
    robots: dict[str, tuple[int, RecordedLog]] = {}
    for folder in map(Path, scenario.logs):
        frames = folder / "frames.parquet"
        recorded, name, n_frames = _known(folder, _stamps(folder))
        if not n_frames:
            raise InputError(f"{folder}: frames.parquet holds no frame")
        if not re.fullmatch(NAME_PATTERN, name):
            raise InputError(f"{frames}: robot is named {name!r}, expected {NAME_PATTERN}")
        if name in TAKEN_NAMES:
            raise InputError(f"{frames}: robot is named {name}, a name of the evaluation's own")
        if name in robots:
            raise InputError(f"{frames}: robot {name} is in another log already")
        robots[name] = n_frames, recorded
    n_most = max(n_frames for n_frames, _ in robots.values())
    for name, (n_frames, recorded) in robots.items():
        mapped = _slam(scenario, recorded)
        smoothed = _smooth(scenario, recorded, mapped, n_frames, n_most)
        yield RobotStages(name, n_frames, recorded, mapped, smoothed)


def _stamps(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """What changes with a log's files."""
    files = ((path.name, path.stat()) for path in sorted(folder.glob("*")))
    return tuple((name, stat.st_mtime_ns, stat.st_size) for name, stat in files)


@lru_cache(maxsize=256)  # a sweep lays out the same logs for every run
def _known(folder: Path, _: object) -> tuple[RecordedLog, str, int]:
    """A recorded log, its robot's name and number of frames; read again when it has changed."""
    log = read_log(folder)
    return RecordedLog(folder), log.robot, len(log)


def _slam(scenario: Scenario, logged: Stage | RecordedLog) -> Stage:
    sections = (scenario, scenario.slam, scenario.evaluate, scenario.keep)
    return _stage(slam, *sections, own={}, before={"log": logged})


def _smooth(
    scenario: Scenario, logged: Stage | RecordedLog, mapped: Stage, n_frames: int, n_most: int
) -> Stage:
    """By the filter's own noise model; `n_most` are the frames of the team's longest log."""
    fused = smooth.fused_iterations(n_most, scenario.evaluate.every, scenario.fuse.every)
    settings, iterations = scenario.slam.filter, smooth.iterations_of(n_frames, fused)
    return _stage(
        smooth,
        scenario.smooth,
        own={
            "smoother": smoother_parameters(scenario),
            "iterations": iterations,
            "noise_floor_m": settings.noise_floor_m,
        },
        before={"log": logged, "slam": mapped},
        parts=smooth.parts(iterations),
    )


def smoother_parameters(scenario: Scenario) -> SmootherParameters:
    """The filter's own noise model, but for the corners that the filter cannot tell apart."""
    slam = scenario.slam
    return SmootherParameters(slam.filter.motion, scenario.smooth.stray_m, slam.min_count)


def _pair(scenario: Scenario, *robots: RobotStages) -> PairStages:
    """Two robots, in the order of their names: whichever a scenario lists first."""
    a, b = sorted(robots, key=lambda robot: name_order(robot.name))
    n_frames = max(a.n_frames, b.n_frames)
    iterations = tuple(slam.evaluated_iterations(n_frames, scenario.evaluate.every))
    parts = match.batches(iterations)
    maps = {"log_a": a.log, "slam_a": a.slam, "log_b": b.log, "slam_b": b.slam}
    own = {"iterations": iterations}
    # a robot's maps are in several pairs, and what is matched of two goes to all aligners
    matched = _stage(match, scenario.align, own=own, before=maps, parts=parts, shares=match.LABEL)
    estimates: dict[str, Stage] = {}
    for entry in scenario.align.aligners:
        method = find_method(entry.method)
        module = method.target.partition(":")[0]
        if method.kind is Kind.PLUG_IN:
            module = "mapfusion.align"  # it may import whatever helps it
        estimates[entry.name] = _stage(
            aligner,
            *(scenario, scenario.align, entry),
            own=own | {"origin": method.origin()},
            before=maps | {"match": matched},
            parts=parts,
            loads=(module,),
            # fusing does not wait for the others
            shares="" if entry.name == scenario.merge.aligner else f"estimates on {matched.key}",
        )
    named = {f"aligner {i}": stage for i, stage in enumerate(estimates.values())}
    joined = _stage(align, own={"batches": parts}, before={"match": matched} | named)
    return PairStages(a, b, matched, estimates, joined)


def _fusers(
    scenario: Scenario, robots: Sequence[RobotStages], pairs: Sequence[PairStages]
) -> dict[str, Stage]:
    n_frames = max(robot.n_frames for robot in robots)
    iterations = smooth.fused_iterations(n_frames, scenario.evaluate.every, scenario.fuse.every)
    before: dict[str, Stage | RecordedLog] = {}
    for robot in robots:
        before |= {f"log {robot.name}": robot.log, f"slam {robot.name}": robot.slam}
        before[f"smooth {robot.name}"] = robot.smooth
    for pair in pairs:  # fused maps stay as they are when an aligner changes that does not merge
        both = f"{pair.a.name} {pair.b.name}"
        before[f"match {both}"] = pair.match
        before[f"aligner {both}"] = pair.aligners[scenario.merge.aligner]
    own = {"robots": tuple(robot.name for robot in robots), "iterations": tuple(iterations)}
    own |= {"smoother": smoother_parameters(scenario)}
    own |= {"noise_floor_m": scenario.slam.filter.noise_floor_m}
    stages = {}
    for name in scenario.fuse.fusers:
        target = target_of(name)
        module, ours = target.partition(":")[0], name in FUSERS
        origin = "" if ours else f"{target} {fingerprint(module.partition('.')[0])}"
        stages[name] = _stage(
            fuse,
            scenario.merge,
            own=own | {"fuser": name, "origin": origin},
            before=before,
            loads=(module if ours else "mapfusion.fusion",),
        )
    return stages
