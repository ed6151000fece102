"""All stages of a scenario up to the aligners' estimates, laid out; nothing is computed here.

Each stage is handed its own settings, taken from the scenario here and nowhere else.
"""

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from experiments.methods.catalogue import Kind, find_method
from experiments.run.stage import RecordedLog, Stage
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
from experiments.run.stages.map_batches import WRITES as BATCH
from experiments.run.stages.map_batches import batches
from experiments.run.stages.walls import Walls
from experiments.scenario.settings import (
    NAME_PATTERN,
    AlignerEntry,
    AnyScenario,
    Recording,
    Scenario,
    Simulation,
)
from mapfusion.errors import InputError
from mapfusion.robot_log import read_log
from mapfusion.vision.frontend import FrontEndParameters
from sim.renderer import renderer_name

_ALIGNING = "align the maps"


@dataclass(frozen=True)
class RobotStages:
    """From one robot's log to its maps."""

    name: str
    n_frames: int
    log: Stage | RecordedLog
    slam: Stage

    def to_log(self) -> list[Stage]:
        """What must be done for the log, each stage after those before it."""
        return []


@dataclass(frozen=True)
class SimulatedRobotStages(RobotStages):
    """The same of a robot whose log is simulated."""

    log: Stage
    features: Stage
    observed: Stage

    def to_log(self) -> list[Stage]:
        """From images to the log."""
        return [self.features, self.observed, self.log]


@dataclass(frozen=True)
class PairStages:
    """From two robots' maps to the aligners' estimates."""

    a: RobotStages
    b: RobotStages
    match: Stage
    aligners: tuple[Stage, ...]
    estimates: Stage


@dataclass(frozen=True)
class Pipeline:
    """A scenario's stages.

    Attributes:
        scenario: what they were laid out from.
        world: stages that all robots share; none for recorded logs.
        robots: in the scenario's order.
        pairs: every two robots.
    """

    scenario: AnyScenario
    world: tuple[Stage, ...]
    robots: tuple[RobotStages, ...]
    pairs: tuple[PairStages, ...]

    @property
    def simulated(self) -> list[SimulatedRobotStages]:
        """Robots with images."""
        return [robot for robot in self.robots if isinstance(robot, SimulatedRobotStages)]

    def to_logs(self) -> list[Stage]:
        """What must be done for the robots' logs, each stage after those before it."""
        return [*self.world, *(s for robot in self.simulated for s in robot.to_log())]

    def stages(self) -> list[Stage]:
        """All stages, each after those before it; a robot is done before the next one's images."""
        found = list(self.world)
        for robot in self.robots:
            found += [*robot.to_log(), robot.slam]
        for pair in self.pairs:
            found += [pair.match, *pair.aligners, pair.estimates]
        return found


def lay_out(scenario: AnyScenario) -> Pipeline:
    """The stages of a scenario; of recorded logs the names and lengths are read.

    Raises:
        InputError: a recorded log that cannot be read, or names that cannot be used together.
    """
    world: tuple[Stage, ...] = ()
    if isinstance(scenario, Recording):
        robots = [_recorded(scenario, Path(folder)) for folder in scenario.logs]
        _require_usable_names(robots)
    else:
        world = driven, painted = _drive(scenario), _faces(scenario)
        robots = [_simulated(scenario, driven, painted, robot.name) for robot in scenario.robots]
    pairs = [_pair(scenario, a, b) for a, b in itertools.combinations(robots, 2)]
    return Pipeline(scenario, world, tuple(robots), tuple(pairs))


def _walls(scenario: Simulation) -> Walls:
    world = scenario.world
    lines = tuple(tuple(wall.points) for wall in world.walls)
    return Walls(lines, world.wall_height_m, world.wall_thickness_m)


def _drive(scenario: Simulation) -> Stage:
    settings = drive.DriveSettings(
        seed=scenario.seed,
        walls=_walls(scenario),
        robots=tuple(
            drive.DrivenRobot(r.name, r.start, tuple(r.route), r.loop, r.tire_friction)
            for r in scenario.robots
        ),
        **dict(scenario.drive),
    )
    return Stage("drive", "drive the robots", settings, drive.run, (drive.TRAJECTORY_FILE,))


def _faces(scenario: Simulation) -> Stage:
    settings = faces.FacesSettings(scenario.seed, _walls(scenario), scenario.world.texture)
    return Stage("faces", "paint the walls", settings, faces.run)


def _simulated(
    scenario: Simulation, driven: Stage, painted: Stage, robot: str
) -> SimulatedRobotStages:
    n_frames, vision, keep = scenario.drive.frames, scenario.vision, scenario.keep
    unread = FrontEndParameters()
    seen = Stage(
        "features",
        "render and find features",
        features.FeatureSettings(
            scenario.seed,
            robot,
            scenario.camera,
            scenario.radiometry_of(robot),
            scenario.render.renderer,
            renderer_name(scenario.render.renderer),
            replace(unread, harris=vision.harris, stereo=vision.stereo, usurf=vision.usurf),
            keep.images_at,
            keep.images,
        ),
        features.run,
        features.WRITES,
        {"drive": driven, "faces": painted},
        features.chunks(n_frames),
    )
    tracking = replace(vision, harris=unread.harris, stereo=unread.stereo, usurf=unread.usurf)
    seen_points = Stage(
        "observed",
        "track features",
        observed.ObservedSettings(
            robot, n_frames, scenario.camera, tracking, keep.images_at, keep.images
        ),
        observed.run,
        observed.WRITES,
        {"features": seen},
    )
    logged = Stage(
        "log",
        "track features",
        log.LogSettings(scenario.seed, robot, scenario.odometry_of(robot)),
        log.run,
        log.WRITES,
        {"drive": driven, "observed": seen_points},
    )
    return SimulatedRobotStages(robot, n_frames, logged, _slam(scenario, logged), seen, seen_points)


def _recorded(scenario: Recording, folder: Path) -> RobotStages:
    known = read_log(folder)
    if not len(known):
        raise InputError(f"{folder}: frames.parquet holds no frame")
    recorded = RecordedLog(folder)
    return RobotStages(known.robot, len(known), recorded, _slam(scenario, recorded))


def _require_usable_names(robots: Sequence[RobotStages]) -> None:
    """Robots of recorded logs give their names to files, as those of scenarios do."""
    known: set[str] = set()
    for robot in robots:
        assert isinstance(robot.log, RecordedLog)
        frames = robot.log.path / "frames.parquet"
        if not re.fullmatch(NAME_PATTERN, robot.name):
            raise InputError(f"{frames}: robot is named {robot.name!r}, expected {NAME_PATTERN}")
        if robot.name in known:
            raise InputError(f"{frames}: robot {robot.name} is in another log already")
        known.add(robot.name)


def _slam(scenario: Scenario, logged: Stage | RecordedLog) -> Stage:
    settings = slam.SlamSettings(
        scenario.seed,
        scenario.slam.filter,
        scenario.slam.min_count,
        scenario.evaluate.every,
        scenario.keep.clouds_every,
    )
    return Stage("slam", "FastSLAM", settings, slam.run, slam.WRITES, {"log": logged})


def _pair(scenario: Scenario, a: RobotStages, b: RobotStages) -> PairStages:
    n_frames = max(a.n_frames, b.n_frames)
    iterations = tuple(slam.evaluated_iterations(n_frames, scenario.evaluate.every))
    parts = batches(iterations)
    maps = {"log_a": a.log, "slam_a": a.slam, "log_b": b.log, "slam_b": b.slam}
    settings = match.MatchSettings(scenario.align.match, iterations)
    offered = Stage("match", _ALIGNING, settings, match.run, BATCH, maps, parts)
    aligners = tuple(
        _aligner(scenario, entry, maps | {"match": offered}, iterations, parts)
        for entry in scenario.align.aligners
    )
    joined = Stage(
        "align",
        _ALIGNING,
        align.JoinSettings(parts),
        align.run,
        align.WRITES,
        {"match": offered} | {f"aligner {i}": stage for i, stage in enumerate(aligners)},
    )
    return PairStages(a, b, offered, aligners, joined)


def _aligner(
    scenario: Scenario,
    entry: AlignerEntry,
    before: dict[str, Stage | RecordedLog],
    iterations: tuple[int, ...],
    parts: tuple[str, ...],
) -> Stage:
    method = find_method(entry.method)
    settings = aligner.AlignerSettings(
        seed=scenario.seed,
        **dict(entry),
        origin=method.origin(),
        repetitions=scenario.align.repetitions,
        refinement=scenario.align.refinement,
        acceptance=scenario.align.acceptance,
        iterations=iterations,
    )
    # a plug-in may import whatever helps it
    loads = "mapfusion.align" if method.kind is Kind.PLUG_IN else method.target.partition(":")[0]
    return Stage(
        "aligner",
        _ALIGNING,
        settings,
        aligner.run,
        BATCH,
        before,
        parts,
        frozenset({"match"}),
        (loads,),
    )
