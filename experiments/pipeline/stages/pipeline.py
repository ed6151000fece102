"""Pipeline of a scenario: all stages up to the aligners' estimates, and the memory that they need.

This is the only module that takes the stages' settings from a scenario.

Estimates of memory are upper bounds of the parts that grow with the settings, accurate to a factor
of about two. They detect mistyped settings.
"""

import itertools
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from experiments.pipeline.stage import RecordedLog, Stage, StageKind, in_dependency_order
from experiments.pipeline.stages import align, drive, features, fuse, log, slam, smooth, team
from experiments.pipeline.stages.drive import Walls
from experiments.plugins.discovery import code_of_fuser, find_method, fingerprint
from experiments.scenario.settings import (
    AnyScenario,
    Recording,
    Scenario,
    Simulation,
)
from experiments.scenario.world_settings import NAME_PATTERN, TAKEN_NAMES, Section
from mapfusion.errors import InputError
from mapfusion.fusion.fusers import make_fuser, name_order, target_of
from mapfusion.robot_log import read_log
from mapfusion.smoother.smooth import SmootherParameters
from mapfusion.vision.descriptors import DESCRIBERS, descriptor_bytes
from mapfusion.vision.descriptors import target_of as descriptor_target
from mapfusion.vision.front_end import FrontEndParameters
from sim.renderer import renderer_name, require_pybullet
from sim.textures import STYLES


@dataclass(frozen=True)
class RobotStages:
    """Stages from one robot's log to its maps.

    Attributes:
        name: name of the robot.
        n_frames: frames of the log.
        n_observations: observations of the log, at most.
        descriptor_bytes: memory of the descriptor of an observation.
        log: stage of the log.
        slam: stage of the filter.
        smooth: stage of the smoother.
    """

    name: str
    n_frames: int
    n_observations: int
    descriptor_bytes: int
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
class AlignmentStages:
    """Stages from the maps of two robots to the aligners' estimates.

    Attributes:
        match: correspondences and rivals.
        aligners: stages of the aligners by their names in the scenario.
        estimates: estimates of all aligners joined.
    """

    match: Stage
    aligners: Mapping[str, Stage]
    estimates: Stage


@dataclass(frozen=True)
class PairStages:
    """Alignments of two robots.

    Attributes:
        a: first robot by name.
        b: second robot.
        filtered: stages on the filter's maps, at each evaluated iteration.
        smoothed: stages on the smoothed maps, at each iteration at which maps are fused.
    """

    a: RobotStages
    b: RobotStages
    filtered: AlignmentStages
    smoothed: AlignmentStages


@dataclass(frozen=True)
class Pipeline:
    """Stages of a scenario: maps of each robot, estimates of each pair, and fused maps."""

    scenario: AnyScenario
    robots: tuple[RobotStages, ...]
    pairs: tuple[PairStages, ...]
    fusers: Mapping[str, Stage]  # by name; empty for a single robot
    team: Stage | None  # robots that exchange maps while they drive

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
        both = ((pair.smoothed, pair.filtered) for pair in self.pairs)
        estimates = (each.estimates for pair in both for each in pair)
        teams = [] if self.team is None else [self.team]
        in_order = [*images, *logs, *filters, *teams, *maps, *self.fusers.values(), *estimates]
        return in_dependency_order(in_order)


def build_pipeline(scenario: AnyScenario) -> Pipeline:
    """Return the stages of a scenario; names and lengths of recorded logs are read.

    Raises:
        InputError: a recorded log cannot be read, names of robots are invalid, or a simulated
            world cannot be driven because PyBullet is not installed.
    """
    recorded = isinstance(scenario, Recording)
    robots = tuple(_recorded(scenario) if recorded else _simulated(scenario))
    pairs, every = list[PairStages](), scenario.evaluate.every
    for both in itertools.combinations(robots, 2):
        a, b = sorted(both, key=lambda robot: name_order(robot.name))
        n_frames = max(a.n_frames, b.n_frames)
        evaluated = tuple(slam.evaluated_iterations(n_frames, every))
        fused = tuple(smooth.fused_iterations(n_frames, every, scenario.fuse.every))
        filtered = {"smoothed": False, "iterations": evaluated}
        # the variation between repetitions is told by the filter's maps
        smoothed = {"smoothed": True, "iterations": fused, "repetitions": 1}
        alignments = (_alignment(scenario, a, b, values) for values in (filtered, smoothed))
        pairs.append(PairStages(a, b, *alignments))
    fusers = _fusers(scenario, robots, pairs) if pairs else {}
    as_team = _team(scenario, robots) if pairs and scenario.team is not None else None
    return Pipeline(scenario, robots, tuple(pairs), fusers, as_team)


def _stage(kind: StageKind, *sections: Section, values: dict[str, Any], **more: Any) -> Stage:
    """Return a stage whose settings are collected by field name.

    Args:
        kind: kind of the stage, which tells the fields of its settings.
        sections: scenario sections, in which the fields are searched.
        values: values of fields, which have precedence over the sections.
        more: further arguments of `Stage`.
    """
    settings = kind.work.__annotations__["settings"]
    value_by_name = {name: value for section in sections for name, value in section} | values
    stage_settings = settings(
        **{field.name: value_by_name[field.name] for field in fields(settings)}
    )
    return Stage(kind.name, kind.label, stage_settings, kind.work, kind.writes, **more)


def _simulated(scenario: Simulation) -> Iterable[RobotStages]:
    """Yield the stages of simulated robots."""
    require_pybullet()  # here rather than in a worker, after the first stages
    world, render, keep_settings = scenario.world, scenario.render, scenario.keep
    lines = tuple(tuple(wall.points) for wall in world.walls)
    walls = Walls(lines, world.wall_height_m, world.wall_thickness_m)
    routes = tuple(
        drive.DrivenRobot(robot.name, robot.start, robot.route, robot.loop, robot.tire_friction)
        for robot in scenario.robots
    )
    driven = _stage(
        drive.DRIVE_STAGE, scenario, scenario.drive, values={"walls": walls, "robots": routes}
    )
    face_values = {
        "walls": walls,
        "looks": tuple((wall.look, wall.mirrored) for wall in world.walls),
    }
    feature_inputs = {
        "drive": driven,
        "faces": _stage(drive.FACES_STAGE, scenario, world, values=face_values),
    }
    n_frames, drawn_by = scenario.drive.frames, renderer_name(render.renderer)
    vision, default_parameters = scenario.vision, FrontEndParameters()
    size = n_frames, n_frames * vision.harris.max_corners, descriptor_bytes(vision.descriptor)
    extraction_fields = ("harris", "stereo", "descriptor", "usurf")
    extraction_parameters = replace(
        default_parameters, **{name: getattr(vision, name) for name in extraction_fields}
    )
    tracking_parameters = replace(
        vision, **{name: getattr(default_parameters, name) for name in extraction_fields}
    )
    descriptor_origin = ""
    if vision.descriptor not in DESCRIBERS:
        target = descriptor_target(vision.descriptor)
        file, module = target.rpartition(":")[0], target.partition(".")[0]
        descriptor_origin = f"{target} {fingerprint(file if file.endswith('.py') else module)}"
    for robot in scenario.robots:
        robot_values = {"robot": robot.name, "n_frames": n_frames, "drawn_by": drawn_by}
        robot_values["radiometry"] = robot.radiometry or scenario.radiometry
        robot_values["odometry"] = robot.odometry or scenario.odometry
        chunks, feature_values = (
            features.chunks(n_frames),
            robot_values | {"vision": extraction_parameters, "origin": descriptor_origin},
        )
        extracted = _stage(
            features.FEATURES_STAGE,
            scenario,
            render,
            keep_settings,
            values=feature_values,
            before=feature_inputs,
            parts=chunks,
        )
        observed_values, observed_inputs = (
            robot_values | {"vision": tracking_parameters},
            {"drive": driven, "features": extracted},
        )
        tracked = _stage(
            log.OBSERVED_STAGE,
            scenario,
            keep_settings,
            values=observed_values,
            before=observed_inputs,
        )
        logged = _stage(
            log.LOG_STAGE,
            scenario,
            values=robot_values,
            before={"drive": driven, "observed": tracked},
        )
        mapped = _slam(scenario, logged)
        smoothed = _smooth(scenario, logged, mapped, n_frames, n_frames)
        yield SimulatedRobotStages(robot.name, *size, logged, mapped, smoothed, extracted, tracked)


def _recorded(scenario: Recording) -> Iterable[RobotStages]:
    """Yield the stages of robots with recorded logs, whose names must be valid file names."""
    robots: dict[str, _ReadLog] = {}
    for folder in map(Path, scenario.logs):
        frames = folder / "frames.parquet"
        files = ((path.name, path.stat()) for path in sorted(folder.glob("*")))
        stamps = tuple((name, stat.st_mtime_ns, stat.st_size) for name, stat in files)
        read = _read_recorded(folder, stamps)
        name = read.robot
        if not read.n_frames:
            raise InputError(f"{folder}: frames.parquet holds no frame")
        if not re.fullmatch(NAME_PATTERN, name):
            raise InputError(f"{frames}: robot is named {name!r}, expected {NAME_PATTERN}")
        if name in TAKEN_NAMES:
            raise InputError(f"{frames}: robot is named {name}, a name of the evaluation's own")
        if name in robots:
            raise InputError(f"{frames}: robot {name} is in another log already")
        robots[name] = read
    n_most = max(read.n_frames for read in robots.values())
    for name, (recorded, _, n_frames, n_observations, n_bytes) in robots.items():
        mapped = _slam(scenario, recorded)
        smoothed = _smooth(scenario, recorded, mapped, n_frames, n_most)
        size = n_frames, n_observations, n_bytes
        yield RobotStages(name, *size, recorded, mapped, smoothed)


class _ReadLog(NamedTuple):
    """Recorded log, its robot's name, and its size as in `RobotStages`."""

    log: RecordedLog
    robot: str
    n_frames: int
    n_observations: int
    descriptor_bytes: int


@lru_cache(maxsize=256)  # all runs of a sweep have the same logs
def _read_recorded(folder: Path, _: object) -> _ReadLog:
    """Read a recorded log.

    The second argument is the state of the files: a changed log is read again.
    """
    log = read_log(folder)
    descriptor, n = log.observations.descriptor, len(log.observations)
    n_bytes = 0 if descriptor is None else descriptor.nbytes // max(n, 1)
    return _ReadLog(RecordedLog(folder), log.robot, len(log), n, n_bytes)


def _slam(scenario: Scenario, logged: Stage | RecordedLog) -> Stage:
    """Return the stage of a robot's filter."""
    sections = (scenario, scenario.slam, scenario.evaluate, scenario.keep)
    return _stage(slam.SLAM_STAGE, *sections, values={}, before={"log": logged})


def _smooth(
    scenario: Scenario, logged: Stage | RecordedLog, mapped: Stage, n_frames: int, n_most: int
) -> Stage:
    """Return the stage of a robot's smoother; `n_most` are the frames of the team's longest log."""
    fused = smooth.fused_iterations(n_most, scenario.evaluate.every, scenario.fuse.every)
    settings, iterations = scenario.slam.filter, smooth.iterations_of(n_frames, fused)
    return _stage(
        smooth.SMOOTH_STAGE,
        scenario.smooth,
        values={
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


def _alignment(
    scenario: Scenario, a: RobotStages, b: RobotStages, values: dict[str, Any]
) -> AlignmentStages:
    """Return the stages that align maps of two robots."""
    parts = align.batches(values["iterations"])
    maps: dict[str, Stage | RecordedLog] = {}
    smooth_of: dict[str, Stage | RecordedLog] = {}
    for side, robot in (("a", a), ("b", b)):
        maps |= {f"log_{side}": robot.log, f"slam_{side}": robot.slam}
        smooth_of[f"smooth_{side}"] = robot.smooth
    # a robot's maps are shared by several pairs, and the matches of a pair by all aligners
    matched = _stage(
        align.MATCH_STAGE,
        scenario.align,
        values=values,
        before=maps | smooth_of if values["smoothed"] else maps,
        parts=parts,
        shares="maps",
    )
    estimates: dict[str, Stage] = {}
    for entry in scenario.align.aligners:
        method = find_method(entry.method)
        estimates[entry.name] = _stage(
            align.ALIGNER_STAGE,
            *(scenario, scenario.align, entry),
            values=values | {"origin": method.origin()},
            before=maps | smooth_of | {"match": matched},
            parts=parts,
            loads=(method.own_module,),
            # fusing waits for the merging aligner only
            shares="" if entry.name == scenario.merge.aligner else f"estimates on {matched.key}",
        )
    aligner_inputs = {f"aligner {i}": stage for i, stage in enumerate(estimates.values())}
    joined = _stage(
        align.ALIGN_STAGE, values={"batches": parts}, before={"match": matched} | aligner_inputs
    )
    return AlignmentStages(matched, estimates, joined)


def _fusers(
    scenario: Scenario, robots: Sequence[RobotStages], pairs: Sequence[PairStages]
) -> dict[str, Stage]:
    """Return the stages of the fusers by name."""
    n_frames = max(robot.n_frames for robot in robots)
    iterations = smooth.fused_iterations(n_frames, scenario.evaluate.every, scenario.fuse.every)
    inputs: dict[str, Stage | RecordedLog] = {}
    for robot in robots:
        inputs |= {f"log {robot.name}": robot.log, f"slam {robot.name}": robot.slam}
        inputs[f"smooth {robot.name}"] = robot.smooth
    aligned: dict[bool, dict[str, Stage | RecordedLog]] = {True: {}, False: {}}
    for pair in pairs:  # fused maps do not depend on the other aligners
        pair_name = f"{pair.a.name} {pair.b.name}"
        for smoothed, stages_of in ((True, pair.smoothed), (False, pair.filtered)):
            aligned[smoothed] |= {
                f"match {pair_name}": stages_of.match,
                f"aligner {pair_name}": stages_of.aligners[scenario.merge.aligner],
            }
    values = {"robots": tuple(robot.name for robot in robots), "iterations": tuple(iterations)}
    values |= {"smoother": smoother_parameters(scenario)}
    values |= {"noise_floor_m": scenario.slam.filter.noise_floor_m}
    stages = {}
    for name in scenario.fuse.fusers:
        origin = code_of_fuser(name)
        stages[name] = _stage(
            fuse.FUSE_STAGE,
            scenario.merge,
            values=values | {"fuser": name, "origin": origin},
            before=inputs | aligned[make_fuser(name).smoothed],
            loads=("mapfusion.fusion" if origin else target_of(name).partition(":")[0],),
        )
    return stages


def _team(scenario: Scenario, robots: Sequence[RobotStages]) -> Stage:
    """Return the stage of the robots that exchange maps; it uses the aligner of `merge`."""
    assert scenario.team is not None
    names, own = {robot.name for robot in robots}, scenario.team
    named = {"starts": own.starts, "carried": own.carried}
    for key, robots_of in named.items():
        others = own.carried.values() if key == "carried" else ()
        for name in (*robots_of, *others):
            if name not in names:
                known = f"known are {', '.join(sorted(names, key=name_order))}"
                raise InputError(f"team.{key}: there is no robot {name}, {known}")
    entries = scenario.align.aligners
    entry = next(each for each in entries if each.name == scenario.merge.aligner)
    method = find_method(entry.method)
    before: dict[str, Stage | RecordedLog] = {}
    for robot in robots:
        before |= {f"log {robot.name}": robot.log, f"slam {robot.name}": robot.slam}
    return _stage(
        team.TEAM_STAGE,
        *(scenario, scenario.slam, scenario.smooth, scenario.evaluate, scenario.align),
        *(scenario.team, entry),
        values={
            "robots": tuple(robot.name for robot in robots),
            "smoother": smoother_parameters(scenario),
            "merge": scenario.merge.parameters,
            "origin": method.origin(),
        },
        before=before,
        loads=(method.own_module,),
    )


_GB = 1e9
_PROCESS_BYTES = 300e6  # worker with numerical libraries and compiled kernels
# A landmark has a mean (3 numbers), a covariance (6) and a count for each particle, and a slot with
# as much, a label, and numbers and boxes of eight bytes, beside the descriptor. The factor is for
# the old half while arrays are doubled.
_DOUBLED = 1.5
_ROW_BYTES, _SLOT_BYTES = 9 * 8 + 4, (9 * 8 + 4) + 4 + 8 * 8
# Share of the corners of a frame that become new landmarks: 0.5 to 2 % in the suite.
_NEW_SHARE = 0.02
_POSE_BYTES = 3 * 8 + 4  # per particle and frame: pose and ancestor
_ASSOCIATION_BYTES = 4  # per particle and observation: landmark
# Both are stored for all M particles only since their common ancestor. That is at most 2 M
# resamplings ago on average, with ten frames or more between two resamplings.
_FRAMES_A_PARTICLE = 30
# Observation of a log beside its descriptor: position, covariance, label, pixels, frame.
_OBSERVATION_BYTES = 3 * 8 + 9 * 8 + 4 + 3 * 4 + 4
# Two images with depth, noise and corner responses need 60 to 80 bytes per pixel.
_PIXEL_BYTES = 100
# The renderer's copy of a texel, and the memory per texel while a face is painted.
_TEXEL_BYTES, _PAINTED_BYTES = 4, 20
# A landmark of an evaluated map has twelve numbers, and a copy while it is written.
_EVALUATED_BYTES = 2 * 12 * 8
_CGROUP_LIMITS = ("memory.max", "memory/memory.limit_in_bytes")  # cgroup version 2 and 1


@dataclass(frozen=True)
class Need:
    """Memory of one process, and the setting on which it depends."""

    n_bytes: float
    setting: str
    why: str


def require_memory(pipeline: Pipeline, jobs: int, machine_bytes: float | None = None) -> None:
    """Raise InputError, naming the setting, if the machine has less memory than the run needs.

    `machine_bytes` is the memory of the machine; None: that of this machine.
    """
    has = memory_bytes() if machine_bytes is None else machine_bytes
    need = max(needs(pipeline), key=lambda need: need.n_bytes)
    wanted = jobs * process_bytes(pipeline)
    if wanted > has:
        processes = f" in each of {jobs} processes (--jobs 1 needs least)" if jobs > 1 else ""
        raise InputError(
            f"{need.setting}: {need.why} take about {need.n_bytes / _GB:.1f} GB{processes}, this "
            f"machine has {has / _GB:.1f} GB"
        )


def process_bytes(pipeline: Pipeline) -> float:
    """Return the memory of a process that does the largest task of a run, in bytes."""
    return _PROCESS_BYTES + max(need.n_bytes for need in needs(pipeline))


def needs(pipeline: Pipeline) -> Iterator[Need]:
    """Yield the memory of the tasks that need most.

    The smoother's memory depends on the log and is bounded later, by
    `smooth.max_memory_gb` (`mapfusion.smoother.elimination.memory_bytes`).
    """
    scenario = pipeline.scenario
    for robot in pipeline.robots:
        # the filter with its log
        settings = scenario.slam.filter
        n_frames, n_observations = robot.n_frames, robot.n_observations
        where = "logs" if isinstance(robot.log, RecordedLog) else "drive.frames"
        n_landmarks = _NEW_SHARE * n_observations
        late = 1.0  # share of frames with distinct particles
        if settings.resample_fraction > 0:
            late = min(1.0, _FRAMES_A_PARTICLE * settings.n_particles / max(n_frames, 1))
        a_particle = late * (
            _DOUBLED * n_landmarks * _ROW_BYTES
            + n_observations * _ASSOCIATION_BYTES
            + n_frames * _POSE_BYTES
        )
        once = n_observations * (_OBSERVATION_BYTES + robot.descriptor_bytes)
        once += _DOUBLED * n_landmarks * (_SLOT_BYTES + robot.descriptor_bytes)
        of_particles = settings.n_particles * a_particle
        setting = "slam.filter.n_particles" if of_particles > once else where
        seen = f"{n_observations} observations in {n_frames} frames"
        yield Need(of_particles + once, setting, f"{settings.n_particles} particles with {seen}")
        # maps grow from zero, so their mean size is half that of the last one
        n_rows = n_frames / scenario.evaluate.every * n_landmarks / 2
        often = f"maps each {scenario.evaluate.every} of {n_frames} frames"
        yield Need(n_rows * _EVALUATED_BYTES, "evaluate.every", often)
    if isinstance(scenario, Simulation):
        camera = scenario.camera
        pixels = camera.width_px * camera.height_px
        why = f"images of {camera.width_px} x {camera.height_px} pixels"
        yield Need(_PIXEL_BYTES * pixels, "camera.width_px", why)
        # textures of all walls (two sides each), floor and ceiling
        world = scenario.world
        corners = [point for wall in world.walls for point in wall.points]
        wide, deep = (max(axis) - min(axis) for axis in zip(*corners, strict=True))
        lengths = [
            ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
            for wall in world.walls
            for (x0, y0), (x1, y1) in zip(wall.points, wall.points[1:], strict=False)
        ]
        upright, level = STYLES["wall"].texels_per_m ** 2, STYLES["floor"].texels_per_m ** 2
        faces = [2 * length * world.wall_height_m * upright for length in lengths]
        plans = [2 * wide * deep * level]
        painted = max(max(faces), *plans) / 2
        n_bytes = _TEXEL_BYTES * (sum(faces) + sum(plans)) + _PAINTED_BYTES * painted
        why = f"walls of {sum(lengths):.0f} m around {wide:.0f} m x {deep:.0f} m, painted,"
        yield Need(n_bytes, "world.walls", why)


def memory_bytes() -> float:
    """Return the total memory of this machine, or of the container of this process."""
    has = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for name in _CGROUP_LIMITS:
        try:
            has = min(has, float((Path("/sys/fs/cgroup") / name).read_text()))
        except (OSError, ValueError):  # no limit; "max" means no limit either
            continue
    return has
