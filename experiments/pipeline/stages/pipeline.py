"""Pipeline of a scenario: all stages up to the aligners' estimates; nothing is computed here.

This is the only module that takes the stages' settings from a scenario.
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
from experiments.plugins.discovery import find_method, fingerprint
from experiments.scenario.settings import AnyScenario, Recording, Scenario, Simulation
from experiments.scenario.world_settings import NAME_PATTERN, TAKEN_NAMES, Section
from mapfusion.errors import InputError
from mapfusion.fusion.fusers import FUSERS, name_order, target_of
from mapfusion.robot_log import read_log
from mapfusion.smoother.smooth import SmootherParameters
from mapfusion.vision.front_end import FrontEndParameters
from sim.renderer import renderer_name, require_pybullet


@dataclass(frozen=True)
class RobotStages:
    """Stages from one robot's log to its maps."""

    name: str
    n_frames: int
    log: Stage | RecordedLog
    slam: Stage
    smooth: Stage


@dataclass(frozen=True)
class SimulatedRobotStages(RobotStages):
    """Stages of a robot whose log is simulated."""

    log: Stage
    features: Stage
    observed: Stage


@dataclass(frozen=True)
class PairStages:
    """Stages of two robots, up to the aligners' estimates from their maps.

    Attributes:
        a: first robot by name.
        b: second robot.
        match: correspondences and rivals.
        aligners: stages of the aligners by their names in the scenario.
        estimates: estimates of all aligners joined.
    """

    a: RobotStages
    b: RobotStages
    match: Stage
    aligners: Mapping[str, Stage]
    estimates: Stage


@dataclass(frozen=True)
class Pipeline:
    """Stages of a scenario: maps of each robot, estimates of each pair, and fused maps."""

    scenario: AnyScenario
    robots: tuple[RobotStages, ...]
    pairs: tuple[PairStages, ...]
    fusers: Mapping[str, Stage]  # by name; empty for a single robot

    @property
    def simulated(self) -> list[SimulatedRobotStages]:
        """Simulated robots."""
        return [robot for robot in self.robots if isinstance(robot, SimulatedRobotStages)]

    def stages(self) -> list[Stage]:
        """Return all stages, each after the stages that it needs.

        Stages with one part (tracks and filter of a robot) run for all robots at the same time.
        Fused maps need one aligner only and have few long tasks. So they come before the estimates
        of the other aligners, whose many short tasks keep all processes busy until the end.
        """
        images = [robot.features for robot in self.simulated]
        logs = [robot.log for robot in self.simulated]
        filters = [robot.slam for robot in self.robots]
        maps = [robot.smooth for robot in self.robots]
        estimates = (pair.estimates for pair in self.pairs)
        in_order = [*images, *logs, *filters, *maps, *self.fusers.values(), *estimates]
        return in_dependency_order(in_order)


def build_pipeline(scenario: AnyScenario) -> Pipeline:
    """Return the stages of a scenario; names and lengths of recorded logs are read.

    Raises:
        InputError: a recorded log cannot be read, names of robots are invalid, or a simulated
            world cannot be driven because PyBullet is not installed.
    """
    recorded = isinstance(scenario, Recording)
    robots = tuple(_recorded(scenario) if recorded else _simulated(scenario))
    pairs = tuple(_pair(scenario, *both) for both in itertools.combinations(robots, 2))
    fusers = _fusers(scenario, robots, pairs) if pairs else {}
    return Pipeline(scenario, robots, pairs, fusers)


def _stage(module: ModuleType, *sections: Section, own: dict[str, Any], **more: Any) -> Stage:
    """Return the stage of a module of `experiments.pipeline.stages`, named after the module.

    The fields of its settings are taken from `own` and, by name, from the sections.
    """
    kind = module.run.__annotations__["settings"]
    known = {name: value for section in sections for name, value in section} | own
    settings = kind(**{field.name: known[field.name] for field in fields(kind)})
    name = module.__name__.rpartition(".")[2]
    return Stage(name, module.LABEL, settings, module.run, module.WRITES, **more)


def _simulated(scenario: Simulation) -> Iterable[RobotStages]:
    """Yield the stages of simulated robots."""
    require_pybullet()  # here rather than in a worker, after the first stages
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
    """Yield the stages of robots with recorded logs, whose names must be valid file names."""
    robots: dict[str, tuple[int, RecordedLog]] = {}
    for folder in map(Path, scenario.logs):
        frames = folder / "frames.parquet"
        files = ((path.name, path.stat()) for path in sorted(folder.glob("*")))
        stamps = tuple((name, stat.st_mtime_ns, stat.st_size) for name, stat in files)
        recorded, name, n_frames = _read_recorded(folder, stamps)
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


@lru_cache(maxsize=256)  # all runs of a sweep have the same logs
def _read_recorded(folder: Path, _: object) -> tuple[RecordedLog, str, int]:
    """Return a recorded log, its robot's name and number of frames.

    The second argument is the state of the files: a changed log is read again.
    """
    log = read_log(folder)
    return RecordedLog(folder), log.robot, len(log)


def _slam(scenario: Scenario, logged: Stage | RecordedLog) -> Stage:
    """Return the stage of a robot's filter."""
    sections = (scenario, scenario.slam, scenario.evaluate, scenario.keep)
    return _stage(slam, *sections, own={}, before={"log": logged})


def _smooth(
    scenario: Scenario, logged: Stage | RecordedLog, mapped: Stage, n_frames: int, n_most: int
) -> Stage:
    """Return the stage of a robot's smoother; `n_most` are the frames of the team's longest log."""
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
    """Return the smoother's parameters, with the filter's noise model."""
    slam = scenario.slam
    return SmootherParameters(slam.filter.motion, scenario.smooth.stray_m, slam.min_count)


def _pair(scenario: Scenario, *robots: RobotStages) -> PairStages:
    """Return the stages of two robots, which are ordered by name."""
    a, b = sorted(robots, key=lambda robot: name_order(robot.name))
    n_frames = max(a.n_frames, b.n_frames)
    iterations = tuple(slam.evaluated_iterations(n_frames, scenario.evaluate.every))
    parts = match.batches(iterations)
    maps = {"log_a": a.log, "slam_a": a.slam, "log_b": b.log, "slam_b": b.slam}
    own = {"iterations": iterations}
    # a robot's maps are shared by several pairs, and the matches of a pair by all aligners
    matched = _stage(match, scenario.align, own=own, before=maps, parts=parts, shares=match.LABEL)
    estimates: dict[str, Stage] = {}
    for entry in scenario.align.aligners:
        method = find_method(entry.method)
        estimates[entry.name] = _stage(
            aligner,
            *(scenario, scenario.align, entry),
            own=own | {"origin": method.origin()},
            before=maps | {"match": matched},
            parts=parts,
            loads=(method.own_module,),
            # fusing waits for the merging aligner only
            shares="" if entry.name == scenario.merge.aligner else f"estimates on {matched.key}",
        )
    named = {f"aligner {i}": stage for i, stage in enumerate(estimates.values())}
    joined = _stage(align, own={"batches": parts}, before={"match": matched} | named)
    return PairStages(a, b, matched, estimates, joined)


def _fusers(
    scenario: Scenario, robots: Sequence[RobotStages], pairs: Sequence[PairStages]
) -> dict[str, Stage]:
    """Return the stages of the fusers by name."""
    n_frames = max(robot.n_frames for robot in robots)
    iterations = smooth.fused_iterations(n_frames, scenario.evaluate.every, scenario.fuse.every)
    before: dict[str, Stage | RecordedLog] = {}
    for robot in robots:
        before |= {f"log {robot.name}": robot.log, f"slam {robot.name}": robot.slam}
        before[f"smooth {robot.name}"] = robot.smooth
    for pair in pairs:  # fused maps do not depend on the other aligners
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
