"""Scenario sections of a simulated world: walls, robots, sensors, generated floor plans."""

from dataclasses import field
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from mapfusion.datasets.log_consistency import NoiseSource
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fusion.fusers import COMPARED, target_of
from mapfusion.geometry.numerics import Float, generator
from mapfusion.parameters import Range
from mapfusion.robot_log import STRAY_M
from sim.driver import DriverSettings
from sim.floorplan import wall_shape
from sim.odometry import OdometryNoise
from sim.p3at import TIRE_FRICTION
from sim.plan_generator import PlanParameters, RouteParameters, generate_world
from sim.renderer import Renderer
from sim.stereo_head import RadiometricNoise
from sim.textures import Texture
from sim.trajectory import BodySway


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Generate(RouteParameters, PlanParameters):
    """Random floor plan and routes.

    Attributes:
        plan_seed: seed of the plan; None: the seed of the scenario.
        world: settings of the world that are not drawn (heights, textures).
    """

    plan_seed: Annotated[int, Range(0, 2**32 - 1, "1")] | None = None
    world: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        PlanParameters.__post_init__(self)
        RouteParameters.__post_init__(self)
        if "walls" in self.world:
            raise ValueError("world.walls: are drawn; give world and robots instead of generate")


def expanded(settings: Generate, seed: int) -> dict[str, Any]:
    """Draw the world and robots of a `generate` section; raise InputError if none is found."""
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


NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,40}$"  # names are parts of file names
TAKEN_NAMES = {"fused", "oracle"}  # names of maps and estimates in every result
MAX_FRAMES = 100_000  # five and a half hours at five frames per second
MAX_COUNT = 1_000_000  # frames or sightings in a log: a day at ten per second
MAX_POINTS = 1000  # points of a wall or route
MAX_NAMED = 100  # named items; more do not fit into a table or figure
# Tolerance, in m and rad, of the shapes of walls with the same look; corners have millimetres.
SAME_SHAPE = 0.002
T = TypeVar("T")
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Coordinate = Annotated[float, Range(-500, 500, "m")]  # larger than any building
Point = tuple[Coordinate, Coordinate]


def different(items: list[T], prefix: str = "") -> list[T]:
    """Refuse repeated names; the items are names or have a `name`."""
    names = [getattr(item, "name", item) for item in items]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{prefix}two are named {name}; names must differ")
    return items


def free(name: str) -> str:
    """Refuse a name that the evaluation uses."""
    if name in TAKEN_NAMES:
        raise ValueError(f"the name {name} is taken by the evaluation")
    return name


class Section(BaseModel):
    """Frozen section that forbids unknown keys, NaN, infinity and values out of range."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Wall(Section):
    """A wall.

    Attributes:
        points: corners x, y of the wall's polyline, in the world's frame.
        look: name of a texture; walls with the same look have the same shape and pictures. Empty:
            the wall has its own pictures.
        mirrored: true if the wall is the mirror image of other walls of its look, with its points
            and pictures.
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
    """World of walls with the same height and thickness, under a ceiling.

    Attributes:
        walls: the walls.
        wall_height_m: height of the walls and of the ceiling; the cameras are at 0.45 m.
        wall_thickness_m: thickness of the walls.
        texture: textures of walls, floor and ceiling.
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
    """Robot with its route.

    Attributes:
        name: name of the robot in maps and tables.
        start: x, y and heading in the world's frame.
        route: points x, y that the robot visits, in the world's frame.
        loop: true to drive from the last point to the first again, false to park.
        odometry: replaces the odometry noise of the scenario.
        radiometry: replaces the image noise of the scenario.
        tire_friction: friction coefficient of the wheels; on a slippery floor they spin when the
            robot accelerates.
    """

    name: Annotated[Name, AfterValidator(free)]
    start: tuple[Coordinate, Coordinate, Annotated[float, Range(-100, 100, "rad")]]
    route: Annotated[list[Point], Field(min_length=1, max_length=MAX_POINTS)]
    loop: bool = True
    odometry: OdometryNoise | None = None
    radiometry: RadiometricNoise | None = None
    tire_friction: Annotated[float, Range(1e-3, 2, "1")] = TIRE_FRICTION


class Drive(Section):
    """Drive of all robots.

    Attributes:
        frames: number of stereo images of each robot.
        frame_interval_s: time between two frames.
        start_jitter_m: largest random offset of each start along x and y.
        start_jitter_rad: largest random rotation of each start.
        control: controller of the robots.
        body_sway: pitch and roll of the robots' bodies.
    """

    frames: Annotated[int, Range(2, MAX_FRAMES, "frames")]
    frame_interval_s: Annotated[float, Range(0.016, 2, "s")] = 0.2  # from one step of the physics
    start_jitter_m: Annotated[float, Range(0, 1, "m")] = 0.1
    start_jitter_rad: Annotated[float, Range(0, 3.2, "rad")] = 0.1
    control: DriverSettings = DriverSettings()
    body_sway: BodySway = BodySway()


class Render(Section):
    """Renderer of the images.

    Attributes:
        renderer: tiny is PyBullet's software renderer, egl the system's OpenGL, and raycast our
            own renderer, which filters textures and is many times faster.
    """

    renderer: Renderer = "tiny"


class Keep(Section):
    """Data that is stored for figures in addition to the tables.

    Attributes:
        images_at: first frame of each robot whose images are stored.
        images: number of frames whose images are stored.
        clouds_every: interval between frames whose particles are stored.
    """

    images_at: Annotated[int, Range(0, MAX_FRAMES, "frames")] = 60
    images: Annotated[int, Range(0, 50, "frames")] = 6
    clouds_every: Annotated[int, Range(1, MAX_COUNT, "frames")] = 10


class Slam(Section):
    """FastSLAM filter and its map.

    Attributes:
        filter: settings of the filter.
        noise: odometry noise of filter and smoother. from_log: `filter.motion`, enlarged if the log
            shows that its odometry is noisier; stated: `filter.motion`.
        min_count: number of sightings that a landmark in the map needs.
    """

    filter: FastSlamParameters = FastSlamParameters()
    noise: NoiseSource = NoiseSource.FROM_LOG
    min_count: Annotated[int, Range(1, MAX_COUNT, "sightings")] = 3


class Smooth(Section):
    """Batch smoother, which runs in addition to the filter.

    Attributes:
        stray_m: standard deviation, along each axis, of the offset between the point of a track and
            its landmark, for usual cameras. It is larger for coarse cameras, whose pixels show
            more of a wall. Tracks of one landmark that lie farther apart become several landmarks.
            The filter's value (`slam.filter.stray_m`) is larger, because its path is less
            accurate.
        max_memory_gb: memory for smoothing one robot's log. The need grows with the length of the
            log and with repeated views of the same places. Iterations that may need more memory
            are not smoothed. 0: no smoothing.
    """

    stray_m: Annotated[float, Range(0, 10, "m")] = STRAY_M
    max_memory_gb: Annotated[float, Range(0, 10_000, "GB")] = 1.0


def _known_fusers(names: list[str]) -> list[str]:
    """Refuse unknown and repeated fusers."""
    for name in names:
        target_of(name)
    return different(names, "fusers: ")


class Fuse(Section):
    """Fusion of the robots' maps with several fusers.

    Attributes:
        fusers: names of the fusers; all get the same maps and alignments. The default is all fusers
            except `batch`, which smooths all logs together and takes long, and
            `kalman_as_printed`, which has the wrong sign of the paper's eq. 13.
        every: interval between fused frames, a multiple of `evaluate.every`; the last frame is
            always fused. None: the last frame and four evaluated frames evenly spread before it.
    """

    fusers: Annotated[list[Name], AfterValidator(_known_fusers)] = list(COMPARED)
    every: Annotated[int, Range(1, MAX_COUNT, "frames")] | None = None
