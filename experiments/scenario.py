"""Scenarios: one validated, frozen value from one YAML file.

The stages' own parameter classes (`FrontEndParameters`, `FastSlamParameters`, ...) are used as they
are: pydantic validates them in place, so a parameter is named and explained once, where it is used.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from experiments.aligner_calls import require_usable
from experiments.metrics import known_metrics
from experiments.yaml_input import apply_overrides, read_mapping
from mapfusion.align.correspondences import MatchParameters
from mapfusion.align.refine import Refinement
from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.fastslam.parameters import FastSlamParameters
from mapfusion.merge import MergeParameters
from mapfusion.vision.frontend import FrontEndParameters
from sim.driver import DriverSettings
from sim.odometry import OdometryNoise
from sim.stereo_head import RadiometricNoise

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,40}$"  # names become parts of file names
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Point = tuple[float, float]
Pose = tuple[float, float, float]
S = TypeVar("S", bound=BaseModel)
MAX_IMAGE_SIDE_PX = 4096  # the software renderer takes seconds and 100 MB a frame at this size


def _require_unique(field: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{field}: two are named {name}; names must differ")


def _renderable(camera: StereoCamera) -> StereoCamera:
    for name in ("width_px", "height_px"):
        if not 1 <= getattr(camera, name) <= MAX_IMAGE_SIDE_PX:
            raise ValueError(
                f"{name}: is {getattr(camera, name)}, must be in [1, {MAX_IMAGE_SIDE_PX}]"
            )
    for name in ("focal_px", "baseline_m", "mount_z_m"):
        if not getattr(camera, name) > 0:
            raise ValueError(f"{name}: is {getattr(camera, name)}, must be positive")
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


class Robot(Section):
    """One robot: where it starts (x_m, y_m, theta_rad in the world) and the points it visits."""

    name: Name
    start: Pose
    route: Annotated[list[Point], Field(min_length=1)]
    loop: bool = True


class Drive(Section):
    """How long and how the robots drive. The seed moves each start within the jitter."""

    frames: Annotated[int, Field(ge=2, le=20_000)]
    frame_interval_s: Annotated[float, Field(gt=0, le=2)] = 0.2
    start_jitter_m: Annotated[float, Field(ge=0, le=1)] = 0.1
    start_jitter_rad: Annotated[float, Field(ge=0, le=3.2)] = 0.1
    control: DriverSettings = DriverSettings()


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
    """Correspondences, the aligners on them, and the least squares after each.

    Randomised aligners are repeated on each pair of maps, so that their own spread can be seen.
    """

    match: MatchParameters = MatchParameters()
    aligners: Annotated[list[AlignerEntry], Field(min_length=1)] = DEFAULT_ALIGNERS
    refinement: Refinement = Refinement()
    repetitions: Annotated[int, Field(ge=1, le=1000)] = 20

    @model_validator(mode="after")
    def _unique(self) -> Self:
        _require_unique("aligners", [entry.name for entry in self.aligners])
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
    """One experiment: simulated (world, robots, drive) or from recorded logs."""

    schema_version: Literal[1]
    name: Name
    description: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    world: World | None = None
    robots: list[Robot] = []
    drive: Drive | None = None
    logs: list[str] = []
    camera: Annotated[StereoCamera, AfterValidator(_renderable)] = StereoCamera()
    radiometry: RadiometricNoise = RadiometricNoise()
    odometry: OdometryNoise = OdometryNoise()
    vision: FrontEndParameters = FrontEndParameters()
    slam: Slam = Slam()
    align: Align = Align()
    merge: Merge = Merge()
    evaluate: Evaluate = Evaluate()
    keep: Keep = Keep()
    expect: dict[str, Bound] = {}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        simulated = self.world is not None and self.drive is not None and bool(self.robots)
        if simulated == bool(self.logs):
            raise ValueError("give either world, robots and drive, or logs")
        _require_unique("robots", [robot.name for robot in self.robots])
        _require_unique("logs", self.logs)
        aligners = [entry.name for entry in self.align.aligners]
        if self.merge.aligner not in aligners:
            raise ValueError(
                f"merge.aligner: {self.merge.aligner} is not among align.aligners "
                f"({', '.join(aligners)})"
            )
        known = known_metrics(aligners)
        unknown = sorted(set(self.expect) - set(known))
        if unknown:
            raise ValueError(f"expect.{unknown[0]}: unknown; known: {', '.join(known)}")
        return self

    def resolved(self) -> dict[str, Any]:
        """All settings, defaults filled in, as JSON-able values."""
        return self.model_dump(mode="json")


def load_scenario(path: Path, overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """Read and validate a scenario.

    Args:
        path: YAML file.
        overrides: entries `key.sub=value` that replace values of the file.
        seed: replaces the file's seed.

    Raises:
        InputError: one line that names the file, the field and what would be right.
    """
    data = apply_overrides(read_mapping(path), overrides)
    if seed is not None:
        data["seed"] = seed
    scenario = _validated(str(path), Scenario, data)
    logs = [str((path.parent / log).resolve()) for log in scenario.logs]
    return scenario.model_copy(update={"logs": logs})


def load_section(path: Path | None, name: str, kind: type[S], overrides: Sequence[str]) -> S:
    """One section of a scenario (or its defaults, without a file), with overrides inside it.

    Raises:
        InputError: as `load_scenario`.
    """
    if path is None:
        return _validated(name, kind, apply_overrides({}, overrides))
    load_scenario(path)
    data = read_mapping(path).get(name) or {}
    return _validated(f"{path}: {name}", kind, apply_overrides(data, overrides))


def _validated(where: str, kind: type[S], data: dict[str, Any]) -> S:
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{where}: {_first_problem(kind, error)}") from error


def _first_problem(kind: type[BaseModel], error: ValidationError) -> str:
    problems = error.errors(include_url=False)
    # A wrong name explains the missing one that follows from it, so it goes first.
    unknown = [
        p for p in problems if p["type"] in {"extra_forbidden", "unexpected_keyword_argument"}
    ]
    problem = (unknown or problems)[0]
    where = ".".join(str(part) for part in problem["loc"])
    message = problem["msg"].removeprefix("Value error, ")
    if unknown:
        message = f"unknown key; known here: {', '.join(_siblings(kind, problem['loc']))}"
    elif problem["type"] != "value_error" and not isinstance(problem["input"], dict):
        message = f"{message} (it is {problem['input']!r})"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{where}: {message}{more}" if where else f"{message}{more}"


def _siblings(kind: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The names that would have been right beside an unknown one, from the JSON schema."""
    root = kind.model_json_schema()
    node: dict[str, Any] = root
    for part in location[:-1]:
        node = _resolved_node(root, node)
        if isinstance(part, int):
            node = node["items"]
        else:  # a mapping with free keys, as `expect`, describes all its values at once
            node = node.get("properties", {}).get(part) or node["additionalProperties"]
    return sorted(_resolved_node(root, node)["properties"])


def _resolved_node(root: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    for option in node.get("anyOf", []):
        if "$ref" in option:
            node = option
    reference = node.get("$ref")
    return root["$defs"][reference.rsplit("/", 1)[1]] if reference else node


def schema_text() -> str:
    """The JSON schema of scenarios, for editors."""
    return json.dumps(Scenario.model_json_schema(), indent=2)
