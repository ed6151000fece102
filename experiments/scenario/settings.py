"""Scenarios: one validated, frozen value from one YAML file.

The stages' own parameter classes (`FrontEndParameters`, `FastSlamParameters`, ...) are used as they
are: pydantic validates them in place, so a parameter is named and explained once, where it is used.
"""

import json
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, model_validator

from experiments.methods.aligner_calls import require_usable
from experiments.scenario.generated import Generate
from mapfusion.align.acceptance import Acceptance
from mapfusion.align.correspondences import MatchParameters
from mapfusion.align.refine import Refinement
from mapfusion.camera import StereoCamera
from mapfusion.fastslam.parameters import FastSlamParameters
from mapfusion.merge import MergeParameters
from mapfusion.vision.frontend import FrontEndParameters
from sim.driver import DriverSettings
from sim.odometry import OdometryNoise
from sim.p3at import TIRE_FRICTION
from sim.stereo_head import RadiometricNoise
from sim.textures import Texture

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,40}$"  # names become parts of file names
T = TypeVar("T")
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Point = tuple[float, float]
MAX_IMAGE_SIDE_PX = 4096  # the software renderer takes seconds and 100 MB a frame at this size


def _different(items: list[T], prefix: str = "") -> list[T]:
    """Refuse two of one name; the items are names or have one."""
    names = [getattr(item, "name", item) for item in items]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{prefix}two are named {name}; names must differ")
    return items


def _renderable(camera: StereoCamera) -> StereoCamera:
    for name, value in vars(camera).items():
        if name in {"width_px", "height_px"} and not 1 <= value <= MAX_IMAGE_SIDE_PX:
            raise ValueError(f"{name}: is {value}, must be in [1, {MAX_IMAGE_SIDE_PX}]")
        if name in {"focal_px", "baseline_m", "mount_z_m"} and not value > 0:
            raise ValueError(f"{name}: is {value}, must be positive")
    return camera


class Section(BaseModel):
    """Frozen; unknown keys, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Wall(Section):
    """A wall along a polyline, in world metres."""

    points: Annotated[list[Point], Field(min_length=2)]


class World(Section):
    """Walls, all of one height and thickness, under one ceiling."""

    walls: Annotated[list[Wall], Field(min_length=1)]
    wall_height_m: Annotated[float, Field(gt=0.5, le=6)] = 2.5
    wall_thickness_m: Annotated[float, Field(gt=0.01, le=1)] = 0.12
    texture: Texture = Texture()


class Robot(Section):
    """One robot: where it starts (x_m, y_m, theta_rad in the world) and the points it visits.

    `odometry` and `radiometry` replace the scenario's for this robot. `tire_friction` is that of
    its wheels against the ground; on a slippery floor they spin as it speeds up.
    """

    name: Name
    start: tuple[float, float, float]
    route: Annotated[list[Point], Field(min_length=1)]
    loop: bool = True
    odometry: OdometryNoise | None = None
    radiometry: RadiometricNoise | None = None
    tire_friction: Annotated[float, Field(gt=0, le=2)] = TIRE_FRICTION


class Drive(Section):
    """How long and how the robots drive. The seed moves each start within the jitter."""

    frames: Annotated[int, Field(ge=2, le=20_000)]
    frame_interval_s: Annotated[float, Field(gt=0, le=2)] = 0.2
    start_jitter_m: Annotated[float, Field(ge=0, le=1)] = 0.1
    start_jitter_rad: Annotated[float, Field(ge=0, le=3.2)] = 0.1
    control: DriverSettings = DriverSettings()


class Render(Section):
    """What draws the images: PyBullet's own software renderer, or the system's OpenGL by EGL."""

    renderer: Literal["tiny", "egl"] = "tiny"


class Keep(Section):
    """What is kept for the figures beyond the tables."""

    images_at: Annotated[int, Field(ge=0)] = 60
    images: Annotated[int, Field(ge=0, le=50)] = 6
    clouds_every: Annotated[int, Field(ge=1)] = 10


class Slam(Section):
    """The filter, and how often a landmark must have been seen to enter the map."""

    filter: FastSlamParameters = FastSlamParameters()
    min_count: Annotated[int, Field(ge=1)] = 3


class AlignerEntry(Section):
    """An aligner under the name that tables and figures use.

    The time limit holds for one call of an aligner that is not our own. TEASER++ takes 0.6 s for
    5000 pairs: a hundred times that, so that a busy machine is not taken for a method that hangs.
    """

    name: Name
    method: str
    parameters: dict[str, Any] = {}
    time_limit_s: Annotated[float, Field(gt=0, le=86_400)] = 60.0

    @model_validator(mode="after")
    def _known(self) -> Self:
        require_usable(self.method, self.parameters)
        if self.name == "oracle":
            raise ValueError("the name oracle is taken by the evaluation")
        return self


DEFAULT_ALIGNERS = [
    AlignerEntry(name="ransac", method="ransac"),
    AlignerEntry(name="svd", method="svd"),
    AlignerEntry(name="svd-solved", method="svd", parameters={"translation": "solved"}),
    AlignerEntry(name="icp", method="icp"),
    AlignerEntry(name="impicp", method="impicp"),
    AlignerEntry(name="gnc", method="gnc"),
    AlignerEntry(name="clique", method="clique"),
    AlignerEntry(name="ransac_mahalanobis", method="ransac_mahalanobis"),
]


class Align(Section):
    """Correspondences, the aligners on them, the least squares after each, the test against chance.

    Randomised aligners are repeated on each pair of maps, so that their own spread can be seen.
    `also` names aligners beside those of `aligners`, which need not be repeated then.
    """

    match: MatchParameters = MatchParameters()
    aligners: Annotated[list[AlignerEntry], Field(min_length=1)] = DEFAULT_ALIGNERS
    also: list[AlignerEntry] = []
    refinement: Refinement = Refinement()
    acceptance: Acceptance = Acceptance()
    repetitions: Annotated[int, Field(ge=1, le=1000)] = 20

    @model_validator(mode="after")
    def _unique(self) -> Self:
        # One list from here on; pydantic freezes models for their users, not for their validators.
        aligners = _different([*self.aligners, *self.also], "aligners: ")
        object.__setattr__(self, "aligners", aligners)
        object.__setattr__(self, "also", [])
        return self


class Merge(Section):
    """Which aligner's refined result the maps are merged with, and how."""

    aligner: Name = "ransac"
    parameters: MergeParameters = MergeParameters()


class Evaluate(Section):
    """When aligners are compared, and what counts as truly the same landmark."""

    every: Annotated[int, Field(ge=1)] = 25
    true_pair_radius_m: Annotated[float, Field(gt=0)] = 0.10
    timing_points: Annotated[int, Field(ge=1)] = 8
    timing_repeats: Annotated[int, Field(ge=1)] = 5


class Bound(Section):
    """The range a metric must lie in; both ends included."""

    min: float | None = None
    max: float | None = None

    @model_validator(mode="after")
    def _one_end(self) -> Self:
        if self.min is None and self.max is None:
            raise ValueError("give min, max or both")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is above max {self.max:g}")
        return self


class Scenario(Section):
    """What a simulation and a recording have in common."""

    schema_version: Literal[1]
    name: Name
    description: str = ""
    tags: list[Name] = []
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    slam: Slam = Slam()
    align: Align = Align()
    merge: Merge = Merge()
    evaluate: Evaluate = Evaluate()
    keep: Keep = Keep()
    expect: dict[str, Bound] = {}

    @model_validator(mode="after")
    def _merges_what_it_aligns(self) -> Self:
        aligners = [entry.name for entry in self.align.aligners]
        if self.merge.aligner not in aligners:
            known = f"is not among align.aligners ({', '.join(aligners)})"
            raise ValueError(f"merge.aligner: {self.merge.aligner} {known}")
        return self

    def resolved(self) -> dict[str, Any]:
        """All settings, defaults filled in, as JSON-able values."""
        return self.model_dump(mode="json")


class Recording(Scenario):
    """An experiment on recorded logs: folders, relative to the scenario's file."""

    logs: Annotated[list[str], Field(min_length=1), AfterValidator(_different)]


class SimulatedScenario(Scenario):
    """What simulations have in common, whoever draws their world."""

    drive: Drive
    render: Render = Render()
    camera: Annotated[StereoCamera, AfterValidator(_renderable)] = StereoCamera()
    radiometry: RadiometricNoise = RadiometricNoise()
    odometry: OdometryNoise = OdometryNoise()
    vision: FrontEndParameters = FrontEndParameters()


class GeneratedScenario(SimulatedScenario):
    """A simulation as its file has it, whose world and robots the seed draws."""

    generate: Generate


class Generated(Section):
    """Where a generated world came from; written by the program, read by nobody but people.

    `overlap` is the one achieved: ground that two robots both visit over the ground that either
    visits, mean over pairs.
    """

    plan_seed: int
    overlap_asked: float
    overlap: float


class Simulation(SimulatedScenario):
    """An experiment in a simulated world; `generated` tells where a drawn one came from."""

    world: World
    robots: Annotated[list[Robot], Field(min_length=1), AfterValidator(_different)]
    generated: Generated | None = None


AnyScenario = Simulation | Recording


def schema_text() -> str:
    """The JSON schema of scenarios, for editors."""
    kinds = TypeAdapter[object](Simulation | GeneratedScenario | Recording)
    return json.dumps(kinds.json_schema(), indent=2)
