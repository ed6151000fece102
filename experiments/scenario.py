"""Scenarios: one validated, frozen value from one YAML file.

The stages' own parameter classes (`FrontEndParameters`, `FastSlamParameters`, ...) are used as they
are: pydantic validates them in place, so a parameter is named and explained once, where it is used.
"""

import json
import warnings
from collections.abc import Iterator, Sequence
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

from experiments.generate import Generate, Generated, expanded
from experiments.methods.aligner_calls import require_usable
from experiments.methods.catalogue import name_clashes
from experiments.metrics import known_metrics
from experiments.yaml_input import apply_overrides, read_mapping
from mapfusion.align.acceptance import Acceptance
from mapfusion.align.correspondences import MatchParameters
from mapfusion.align.refine import Refinement
from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError, NameClashWarning
from mapfusion.fastslam.parameters import FastSlamParameters
from mapfusion.merge import MergeParameters
from mapfusion.vision.frontend import FrontEndParameters
from sim.driver import DriverSettings
from sim.odometry import OdometryNoise
from sim.p3at import TIRE_FRICTION
from sim.stereo_head import RadiometricNoise
from sim.textures import Texture

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,40}$"  # names become parts of file names
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Point = tuple[float, float]
Pose = tuple[float, float, float]
S = TypeVar("S", bound=BaseModel)
_MOST_SUGGESTED = 3  # keys that an error message offers
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
    texture: Texture = Texture()


class Robot(Section):
    """One robot: where it starts (x_m, y_m, theta_rad in the world) and the points it visits.

    `odometry` and `radiometry` replace the scenario's for this robot. `tire_friction` is that of
    its wheels against the ground; on a slippery floor they spin as it speeds up.
    """

    name: Name
    start: Pose
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
        object.__setattr__(self, "aligners", [*self.aligners, *self.also])
        object.__setattr__(self, "also", [])
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
    """One experiment: simulated (world, robots, drive) or from recorded logs.

    `generate` stands in place of world and robots; once loaded, these are there instead, and
    `generated` tells where they came from.
    """

    schema_version: Literal[1]
    name: Name
    description: str = ""
    tags: list[Name] = []
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    generate: Generate | None = None
    generated: Generated | None = None
    world: World | None = None
    robots: list[Robot] = []
    drive: Drive | None = None
    logs: list[str] = []
    render: Render = Render()
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
        given = self.world is not None and bool(self.robots)
        simulated = self.drive is not None and (given or self.generate is not None)
        if simulated == bool(self.logs):
            raise ValueError(
                "give either world, robots and drive, or logs; generate stands for world and robots"
            )
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

    def radiometry_of(self, robot: str) -> RadiometricNoise:
        """The noise of a robot's images."""
        own = {r.name: r.radiometry for r in self.robots}[robot]
        return self.radiometry if own is None else own

    def odometry_of(self, robot: str) -> OdometryNoise:
        """The noise of a robot's odometry."""
        own = {r.name: r.odometry for r in self.robots}[robot]
        return self.odometry if own is None else own

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
    data = _expanded(str(path), data)
    scenario = _validated(str(path), Scenario, data)
    _warn_of_name_clashes(scenario.align)
    logs = [str((path.parent / log).resolve()) for log in scenario.logs]
    return scenario.model_copy(update={"logs": logs})


def _expanded(where: str, data: dict[str, Any]) -> dict[str, Any]:
    """The data with the world and the robots that its `generate` section stands for."""
    if data.get("generate") is None:
        return data
    if data.get("world") is not None or data.get("robots") or data.get("logs"):
        raise InputError(f"{where}: give either generate, or world and robots, or logs")
    # the rest is judged first: what is wrong with the seed must not show as a broken plan
    if not isinstance(data.get("seed", 0), int):
        return data
    settings = _validated(f"{where}: generate", Generate, data["generate"])
    try:
        made = expanded(settings, data.get("seed", 0))
    except InputError as error:
        raise InputError(f"{where}: generate.{error}") from error
    return {key: value for key, value in data.items() if key != "generate"} | made


def load_section(path: Path | None, name: str, kind: type[S], overrides: Sequence[str]) -> S:
    """One section of a scenario (or its defaults, without a file), with overrides inside it.

    Raises:
        InputError: as `load_scenario`.
    """
    if path is None:
        section = _validated(name, kind, apply_overrides({}, overrides))
        if isinstance(section, Align):
            _warn_of_name_clashes(section)
        return section
    load_scenario(path)
    data = read_mapping(path).get(name) or {}
    return _validated(f"{path}: {name}", kind, apply_overrides(data, overrides))


def _warn_of_name_clashes(align: Align) -> None:
    for method in dict.fromkeys(entry.method for entry in align.aligners):
        if method in name_clashes():
            warnings.warn(name_clashes()[method], NameClashWarning, stacklevel=3)


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
        elsewhere = _paths_like(kind, str(problem["loc"][-1]))
        message += f"; did you mean {' or '.join(elsewhere)}?" if elsewhere else ""
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


def _paths_like(kind: type[BaseModel], name: str) -> list[str]:
    """Dotted keys, wherever they are, whose last part holds this name as a word: n_particles."""
    root = kind.model_json_schema()

    def below(node: dict[str, Any], prefix: str) -> Iterator[str]:
        for key, child in _resolved_node(root, node).get("properties", {}).items():
            if name in key.split("_"):
                yield prefix + key
            yield from below(child, f"{prefix}{key}.")

    return list(below(root, ""))[:_MOST_SUGGESTED]


def _resolved_node(root: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    for option in node.get("anyOf", []):
        if "$ref" in option:
            node = option
    reference = node.get("$ref")
    return root["$defs"][reference.rsplit("/", 1)[1]] if reference else node


def schema_text() -> str:
    """The JSON schema of scenarios, for editors."""
    return json.dumps(Scenario.model_json_schema(), indent=2)
