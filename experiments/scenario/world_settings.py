"""Scenario sections of a simulated world: walls, robots, sensors, generated floor plans."""

from dataclasses import field
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from experiments.scenario.seeds import generator
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fusion.fusers import FUSERS, REFERENCE, target_of
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import Range, require_in_range
from mapfusion.robot_log import STRAY_M
from sim.driver import DriverSettings
from sim.floorplan import wall_shape
from sim.odometry import OdometryNoise
from sim.p3at import TIRE_FRICTION
from sim.plan_generator import PlanParameters, RouteParameters, generate_world
from sim.renderer import Renderer
from sim.stereo_head import RadiometricNoise
from sim.sway import BodySway
from sim.textures import Texture


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Generate(RouteParameters, PlanParameters):
    """A floor plan and routes drawn from a seed.

    Attributes:
        plan_seed: draws the plan; None: the scenario's seed does.
        world: whatever of the world is not drawn (heights, textures).
    """

    plan_seed: Annotated[int, Range(0, 2**32 - 1, "1")] | None = None
    world: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        PlanParameters.__post_init__(self)
        RouteParameters.__post_init__(self)
        if "walls" in self.world:
            raise ValueError("world.walls: are drawn; give world and robots instead of generate")


def expanded(settings: Generate, seed: int) -> dict[str, Any]:
    """The scenario keys that a `generate` section stands for; raises InputError."""
    plan_seed = seed if settings.plan_seed is None else settings.plan_seed
    made = generate_world(settings, settings, generator(plan_seed, "plan"))
    robots = [
        {"name": f"R{i}", "start": own.T_world_start.tolist(), "route": own.waypoints_m.tolist()}
        for i, own in enumerate(made.routes, start=1)
    ]
    return {
        "world": {**settings.world, "walls": [{"points": w.tolist()} for w in made.plan.walls_m]},
        "robots": robots,
        "generated": {
            "plan_seed": plan_seed,
            "overlap_asked": settings.overlap,
            "overlap": round(made.overlap, 4),
        },
    }


NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,40}$"  # names become parts of file names
TAKEN_NAMES = {"fused", "oracle"}  # of a map and of an estimate beside the robots' and aligners'
MAX_FRAMES = 100_000  # five hours and a half at five frames a second
MAX_COUNT = 1_000_000  # of frames or sightings in a log: a day at ten a second
MAX_POINTS = 1000  # of one wall or route
MAX_NAMED = 100  # things with names of their own: more do not fit into any table or figure
# Metres and radians by which walls of one look may differ; corners are written to millimetres.
SAME_SHAPE = 0.002
T = TypeVar("T")
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Coordinate = Annotated[float, Range(-500, 500, "m")]  # beyond any building
Point = tuple[Coordinate, Coordinate]


def different(items: list[T], prefix: str = "") -> list[T]:
    """Refuse two of one name; the items are names or have one."""
    names = [getattr(item, "name", item) for item in items]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{prefix}two are named {name}; names must differ")
    return items


def free(name: str) -> str:
    """Refuse a name that the evaluation uses itself."""
    if name in TAKEN_NAMES:
        raise ValueError(f"the name {name} is taken by the evaluation")
    return name


class Section(BaseModel):
    """Frozen; unknown keys, NaN, infinity and what lies outside a declared range are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        require_in_range(self)
        return self


class Wall(Section):
    """A wall.

    Attributes:
        points: corners x, y of the polyline it stands on, in the world's frame.
        look: a name; walls of one have one shape and carry the same pictures. Empty: its own.
        mirrored: whether it is the mirror image of other walls of its look, points and pictures.
    """

    points: Annotated[list[Point], Field(min_length=2, max_length=MAX_POINTS)]
    look: Annotated[str, Field(pattern=f"{NAME_PATTERN}|^$")] = ""
    mirrored: bool = False

    @model_validator(mode="after")
    def _mirrors_another(self) -> Self:
        if self.mirrored and not self.look:
            raise ValueError("mirrored: needs a look that other walls have too")
        return self


class World(Section):
    """Walls, all of one height and thickness, under one ceiling.

    Attributes:
        walls: the walls.
        wall_height_m: of all of them, and of the ceiling; the cameras look from 0.45 m.
        wall_thickness_m: of all of them.
        texture: how the world is painted.
    """

    walls: Annotated[list[Wall], Field(min_length=1, max_length=1000)]
    wall_height_m: Annotated[float, Range(0.5, 6, "m")] = 2.5
    wall_thickness_m: Annotated[float, Range(0.01, 1, "m")] = 0.12
    texture: Texture = Texture()

    @model_validator(mode="after")
    def _of_one_look_of_one_shape(self) -> Self:
        first: dict[str, tuple[int, Float]] = {}
        for i, wall in enumerate(self.walls):
            if not wall.look:
                continue
            shape = wall_shape(np.array(wall.points), wall.mirrored)
            k, known = first.setdefault(wall.look, (i, shape))
            if len(shape) != len(known) or np.abs(shape - known).max() > SAME_SHAPE:
                mirrored = " mirrored" if wall.mirrored else ""
                what = f"must be of the shape of walls.{k},{mirrored} point by point, to look alike"
                raise ValueError(f"walls.{i}.points: {what} ({wall.look})")
        return self


class Robot(Section):
    """One robot.

    Attributes:
        name: of its map and tables.
        start: x, y and heading in the world's frame.
        route: points x, y that it visits, in the world's frame.
        loop: whether it goes on from the last point to the first, or parks.
        odometry: in place of the scenario's.
        radiometry: in place of the scenario's.
        tire_friction: of its wheels against the ground, the coefficient; on a slippery floor they
            spin as it speeds up.
    """

    name: Annotated[Name, AfterValidator(free)]
    start: tuple[Coordinate, Coordinate, Annotated[float, Range(-100, 100, "rad")]]
    route: Annotated[list[Point], Field(min_length=1, max_length=MAX_POINTS)]
    loop: bool = True
    odometry: OdometryNoise | None = None
    radiometry: RadiometricNoise | None = None
    tire_friction: Annotated[float, Range(1e-3, 2, "1")] = TIRE_FRICTION


class Drive(Section):
    """How long and how the robots drive.

    Attributes:
        frames: pairs of images that each robot takes.
        frame_interval_s: between two of them.
        start_jitter_m: by which the seed moves each start at most, along x and along y.
        start_jitter_rad: by which the seed turns each start at most.
        control: how the robots are driven.
        body_sway: how their bodies pitch and roll meanwhile.
    """

    frames: Annotated[int, Range(2, MAX_FRAMES, "frames")]
    frame_interval_s: Annotated[float, Range(0.016, 2, "s")] = 0.2  # from one step of the physics
    start_jitter_m: Annotated[float, Range(0, 1, "m")] = 0.1
    start_jitter_rad: Annotated[float, Range(0, 3.2, "rad")] = 0.1
    control: DriverSettings = DriverSettings()
    body_sway: BodySway = BodySway()


class Render(Section):
    """What draws the images.

    Attributes:
        renderer: tiny is PyBullet's own in software, egl the system's OpenGL, raycast our own:
            filtered, and many times as fast.
    """

    renderer: Renderer = "tiny"


class Keep(Section):
    """What is kept for the figures beyond the tables.

    Attributes:
        images_at: first frame of each robot whose images are kept.
        images: how many frames from there on.
        clouds_every: the particles are kept at every so-manieth frame.
    """

    images_at: Annotated[int, Range(0, MAX_FRAMES, "frames")] = 60
    images: Annotated[int, Range(0, 50, "frames")] = 6
    clouds_every: Annotated[int, Range(1, MAX_COUNT, "frames")] = 10


class Slam(Section):
    """Mapping.

    Attributes:
        filter: the filter's settings.
        min_count: sightings that a landmark needs to enter the map.
    """

    filter: FastSlamParameters = FastSlamParameters()
    min_count: Annotated[int, Range(1, MAX_COUNT, "sightings")] = 3


class Smooth(Section):
    """The batch smoother, beside the filter.

    Attributes:
        stray_m: standard deviation, along each axis, of where the point that a track is of lies
            beside its landmark, as usual cameras see it; of coarse ones, whose pixels show more of
            a wall, it is larger. Tracks that the filter took for one landmark and that lie farther
            apart are parted. The filter's own (`slam.filter.stray_m`) is larger: along its path
            they cannot be told apart.
        max_memory_gb: of one robot's smoothing. It grows with the log, and with how much of it saw
            the same places. A robot is not smoothed beyond the iteration where it may take more; 0
            for no robot at all.
    """

    stray_m: Annotated[float, Range(0, 10, "m")] = STRAY_M
    max_memory_gb: Annotated[float, Range(0, 10_000, "GB")] = 1.0


_FUSERS = tuple(name for name in FUSERS if name != REFERENCE)


def _known_fusers(names: list[str]) -> list[str]:
    """Refuse a fuser that nobody has, or that is named twice."""
    for name in names:
        target_of(name)
    return different(names, "fusers: ")


class Fuse(Section):
    """How and when robots' maps are fused to one, so that fusers can be compared.

    Attributes:
        fusers: names; all are given the same maps and alignments. All of ours but `batch`, which
            smooths all logs as one and takes long, are in every run.
        every: at every so-manieth frame, a multiple of `evaluate.every`, and at the last. None: at
            the last, and at four evaluated iterations evenly spread before it.
    """

    fusers: Annotated[list[Name], AfterValidator(_known_fusers)] = [
        each for each in FUSERS if each != REFERENCE
    ]
    every: Annotated[int, Range(1, MAX_COUNT, "frames")] | None = None
