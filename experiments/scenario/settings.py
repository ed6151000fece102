"""Scenario: one validated, frozen value from one YAML file.

`experiments/evaluation/metrics.py` computes them; here they are known before anything is computed.

The stages' own parameter classes (`FrontEndParameters`, `FastSlamParameters`, ...) are used as they
are: pydantic validates them in place, so a parameter is named and explained once, where it is used.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from experiments.plugins.discovery import require_usable
from experiments.scenario.world_settings import (
    MAX_COUNT,
    MAX_NAMED,
    Drive,
    Fuse,
    Generate,
    Keep,
    Name,
    Render,
    Robot,
    Section,
    Slam,
    Smooth,
    World,
    different,
    free,
)
from mapfusion.align.correspondences import MatchParameters
from mapfusion.align.refinement import Refinement
from mapfusion.errors import OutOfRangeError, did_you_mean
from mapfusion.fusion.fused_map import MergeParameters
from mapfusion.fusion.fusers import USUAL
from mapfusion.geometry.camera import StereoCamera
from mapfusion.parameters import Range
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.parameters import EvidenceParameters
from mapfusion.verification.verdict import Judge
from mapfusion.vision.front_end import FrontEndParameters
from sim.odometry import OdometryNoise
from sim.stereo_head import RadiometricNoise
from sim.sway import AttitudeNoise

# Of a whole run.
RUN_METRICS = ("path_rmse_m", "odometry_rmse_m", "path_over_odometry")
RUN_METRICS += tuple(
    f"smoother.{name}"
    for name in (
        *("path_rmse_m", "filter_over_smoother", "landmark_rmse_m", "gross_share"),
        *("nees_per_dof", "coverage_95"),
    )
)
RUN_METRICS += ("oracle_translation_m", "oracle_rotation_rad", "true_pairs_at_end")
RUN_METRICS += (
    "fused_over_parents",
    "fused_nees_with_drift",
    "fused_nees_without_drift",
    "landmark_rmse_median_m",
    "landmark_rmse_worst_m",
    "fused_landmark_rmse_m",
    "team.merged_robots",
    "team.ate_rmse_m",
    "team.translation_m",
    "team.rotation_rad",
    "team.edge_precision",
    "team.edge_recall",
)
# Of each fuser that runs, under its name: columns of the table `fusers`.
FUSER_METRICS = ("landmark_rmse_m", "gross_share", "fitted_rmse_m", "fitted_median_m")
FUSER_METRICS += ("over_better_parent", "over_better_filter", "nees_per_dof", "frame_nees_per_dof")
FUSER_METRICS += ("coverage_95", "frame_coverage_95", "alignment_nees_per_dof", "duplicate_share")
FUSER_METRICS += ("alignment_error_m", "alignment_error_rad")
FUSER_METRICS += ("alignment_sigma_m", "alignment_sigma_rad")
# Of each aligner, under its name.
ALIGNER_METRICS = (
    "refined_oracle_distance_m",
    "refined_over_oracle",
    "estimated_over_oracle",
    "estimated_translation_m",
    "lead_over_others",
    "scatter_m",
    "false_merges",
    "missed_merges",
)


def known_metrics(aligners: Sequence[str], fusers: Sequence[str]) -> list[str]:
    """Return every metric name that a scenario with these aligners and fusers may use."""
    of_fusers = [f"{fuser}.{name}" for fuser in fusers for name in FUSER_METRICS]
    of_aligners = [f"{aligner}.{name}" for aligner in aligners for name in ALIGNER_METRICS]
    return [*RUN_METRICS, *of_fusers, *of_aligners]


def why_unknown(name: str, aligners: Sequence[str], fusers: Sequence[str]) -> str:
    """Return the reason why a scenario may not expect a metric of this name; empty if it may."""
    known = known_metrics(aligners, fusers)
    if name in known:
        return ""
    method, _, of_method = name.rpartition(".")
    if method and of_method in ALIGNER_METRICS:
        return f"unknown aligner {method}; align.aligners has {', '.join(aligners)}"
    if method and of_method in FUSER_METRICS:
        return f"unknown fuser {method}; fuse.fusers has {', '.join(fusers)}"
    forms = ", ".join((*RUN_METRICS, "ALIGNER.NAME", "FUSER.NAME"))
    return f"unknown{did_you_mean(name, known) or f'; known: {forms}'}"


# Of whatever metrics measure; beyond, the screens' numbers say nothing.
MetricValue = Annotated[float, Range(-1e9, 1e9, "the metric's")]


class AlignerEntry(Section):
    """An aligner under the name that tables and figures use.

    Attributes:
        name: what tables and figures call it.
        method: an alignment method, built in or of an installed package.
        parameters: the method's own.
        time_limit_s: of one call of an aligner that is not our own. TEASER++ takes 0.6 s for 5000
            pairs: a hundred times that, so that a busy machine is not taken for a method that
            hangs.
    """

    name: Annotated[Name, AfterValidator(free)]
    method: Annotated[str, Field(max_length=100)]
    parameters: dict[str, Any] = Field(default_factory=dict)
    time_limit_s: Annotated[float, Range(0.01, 86_400, "s")] = 60.0

    @model_validator(mode="after")
    def _known(self) -> Self:
        try:
            require_usable(self.method, self.parameters)
        except OutOfRangeError as error:
            raise OutOfRangeError(f"parameters.{error.name}", error.problem) from error
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
    """Correspondences, the aligners on them, the least squares after each, the verdict on each.

    Attributes:
        match: how landmarks are paired.
        aligners: the aligners that are compared.
        also: aligners beside those of `aligners`, which need not be repeated then.
        refinement: least squares after each aligner.
        acceptance: the test of each alignment against chance.
        evidence: what both robots saw, for and against it, and how sure it has to be.
        repetitions: of randomised aligners on each pair of maps, so that their own spread is seen.
    """

    match: MatchParameters = MatchParameters()
    aligners: Annotated[list[AlignerEntry], Field(min_length=1, max_length=MAX_NAMED)] = (
        DEFAULT_ALIGNERS
    )
    also: list[AlignerEntry] = Field(default_factory=list, max_length=MAX_NAMED)
    refinement: Refinement = Refinement()
    acceptance: Acceptance = Acceptance()
    evidence: EvidenceParameters = EvidenceParameters()
    repetitions: Annotated[int, Range(1, 1000, "repetitions")] = 20

    @property
    def judge(self) -> Judge:
        """What gives the verdict on each alignment."""
        return Judge(self.acceptance, self.evidence, self.refinement)

    @model_validator(mode="after")
    def _unique(self) -> Self:
        # One list from here on; pydantic freezes models for their users, not for their validators.
        aligners = different([*self.aligners, *self.also], "aligners: ")
        object.__setattr__(self, "aligners", aligners)
        object.__setattr__(self, "also", [])
        return self


class Merge(Section):
    """The fused map.

    Attributes:
        aligner: whose refined result the maps are merged with; a name of `align.aligners`.
        fuser: whose map is the fused one, of figure 10 and of `maps/fused.parquet`; a name of
            `fuse.fusers`.
        parameters: how they are merged.
    """

    aligner: Name = "ransac"
    fuser: Name = USUAL
    parameters: MergeParameters = MergeParameters()


class Evaluate(Section):
    """When aligners are compared, and what counts as truly the same landmark.

    Attributes:
        every: maps are aligned and judged at every so-manieth frame, and at the last.
        true_pair_radius_m: landmarks whose true points lie this near are one.
        timing_points: pairs of maps, evenly spread over the run, on which aligners are timed.
        timing_repeats: timings on each.
    """

    every: Annotated[int, Range(1, MAX_COUNT, "frames")] = 25
    true_pair_radius_m: Annotated[float, Range(1e-3, 10, "m")] = 0.10
    timing_points: Annotated[int, Range(1, 1000, "pairs of maps")] = 8
    timing_repeats: Annotated[int, Range(1, 1000, "repetitions")] = 5


class Bound(Section):
    """The range a metric must lie in; both ends included.

    Attributes:
        min: the least value that passes.
        max: the largest value that passes.
    """

    min: MetricValue | None = None
    max: MetricValue | None = None

    @model_validator(mode="after")
    def _one_end(self) -> Self:
        if self.min is None and self.max is None:
            raise ValueError("give min, max or both")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is above max {self.max:g}")
        return self


# Errors in pictures that PyBullet samples without a filter: edges are staircases, a wall that is
# seen straight on locks onto its texels (4 mm; two or three to a pixel at usual distances): all of
# a window then matches the better the more it is off. With these, standard deviations hold against
# rendered depth, and most windows of one plane pass, though fewer than of white noise would.
_UNFILTERED = {"plane_misfit_px": 0.7, "residual_correlation_px": 3.0, "sigma_floor_px": 0.06}
# Corners, too, settle on texels.
_UNFILTERED_STRAY_M = 0.003


# A rule about several sections: its arguments are sections by their names, its answers are lines
# that begin with the key at fault.
Rule = Callable[..., Iterator[str]]


class ContradictingSections(ValueError):  # noqa: N818  # pydantic calls it an error itself
    """Sections that are right by themselves contradict each other; `problems` has a line each."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = tuple(problems)


def sections_of(rules: Sequence[Rule]) -> set[str]:
    """Return the names of the sections that some of the rules need."""
    return {name for rule in rules for name in inspect.signature(rule).parameters}


def broken_rules(rules: Sequence[Rule], sections: Mapping[str, Any]) -> list[str]:
    """Apply the rules whose sections are all there; return the lines of those broken."""
    broken = []
    for rule in rules:
        needed = sections_of([rule])
        if sections.keys() >= needed:
            broken += rule(**{name: sections[name] for name in needed})
    return broken


def merged_by_what_is_aligned(align: Align, merge: Merge, fuse: Fuse) -> Iterator[str]:
    """Tell if the merge builds on an aligner or a fuser that does not run."""
    aligners = [entry.name for entry in align.aligners]
    if merge.aligner not in aligners:
        known = f"is not among align.aligners ({', '.join(aligners)})"
        yield f"merge.aligner: {merge.aligner} {known}"
    if merge.fuser not in fuse.fusers:
        known = f"is not among fuse.fusers ({', '.join(fuse.fusers)})"
        yield f"merge.fuser: {merge.fuser} {known}"


def _fused_when_evaluated(fuse: Fuse, evaluate: Evaluate) -> Iterator[str]:
    if fuse.every is not None and fuse.every % evaluate.every:
        wanted = f"must be a multiple of evaluate.every ({evaluate.every} frames)"
        yield f"fuse.every: is {fuse.every}, {wanted}"


def _known_metrics_expected(align: Align, fuse: Fuse, expect: dict[str, Bound]) -> Iterator[str]:
    aligners = [entry.name for entry in align.aligners]
    for name in expect:
        if unknown := why_unknown(name, aligners, fuse.fusers):
            yield f"expect.{name}: {unknown}"


def _drawn_from_below_the_walls(
    world: World, camera: StereoCamera, render: Render
) -> Iterator[str]:
    top_m, camera_m = world.wall_height_m, camera.mount_z_m
    if render.renderer == "raycast" and camera_m >= top_m:
        what = f"raycast draws from below the walls' upper edge ({top_m:g} m) only"
        yield f"render.renderer: {what}; camera.mount_z_m is {camera_m:g}"


class Scenario(Section):
    """What a simulation and a recording have in common.

    Attributes:
        schema_version: of this file's format.
        name: of the result's folder.
        description: one line for people.
        tags: words that commands take in place of this scenario's name.
        seed: of all that is random.
        slam: how maps are made.
        smooth: the batch smoother beside it.
        align: alignment of two maps.
        merge: the fused map.
        fuse: when maps are fused.
        evaluate: when and how it is judged.
        keep: what is kept for the figures.
        expect: bounds by metric, which `mapfusion check` holds runs to.
    """

    schema_version: Literal[1]
    name: Name
    description: Annotated[str, Field(max_length=2000)] = ""
    tags: list[Name] = Field(default_factory=list, max_length=MAX_NAMED)
    seed: Annotated[int, Range(0, 2**32 - 1, "1")] = 0
    slam: Slam = Slam()
    smooth: Smooth = Smooth()
    align: Align = Align()
    merge: Merge = Merge()
    fuse: Fuse = Fuse()
    evaluate: Evaluate = Evaluate()
    keep: Keep = Keep()
    expect: dict[str, Bound] = Field(default_factory=dict)

    RULES: ClassVar[tuple[Rule, ...]] = (
        merged_by_what_is_aligned,
        _fused_when_evaluated,
        _known_metrics_expected,
    )

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if problems := broken_rules(self.RULES, vars(self)):
            raise ContradictingSections(problems)
        return self

    def resolved(self) -> dict[str, Any]:
        """All settings, defaults filled in, as JSON-able values."""
        return self.model_dump(mode="json")


class Recording(Scenario):
    """An experiment on recorded logs.

    Attributes:
        logs: folders of robots' logs, relative to the scenario's file.
    """

    logs: Annotated[list[str], Field(min_length=1, max_length=MAX_NAMED), AfterValidator(different)]


class SimulatedScenario(Scenario):
    """What simulations have in common, whoever draws their world.

    Attributes:
        drive: how the robots drive.
        render: what draws the images.
        camera: the stereo head of all robots.
        radiometry: noise of the images.
        odometry: noise of the wheels' counts.
        attitude: what robots whose bodies sway are told of their roll and pitch.
        vision: from images to observations. Where a renderer without filter draws (tiny, egl) and
            they are not named, `stereo.plane_misfit_px` is 0.7, `residual_correlation_px` 3 and
            `sigma_floor_px` 0.06.
    """

    drive: Drive
    render: Render = Render()
    camera: StereoCamera = StereoCamera()
    radiometry: RadiometricNoise = RadiometricNoise()
    odometry: OdometryNoise = OdometryNoise()
    attitude: AttitudeNoise = AttitudeNoise()
    vision: FrontEndParameters = FrontEndParameters()

    @model_validator(mode="before")
    @classmethod
    def _unfiltered_pictures_tell_places_less_well(cls, given: object) -> object:
        if not isinstance(given, dict):
            return given
        render = given.get("render", cls.model_fields["render"].default)
        renderer = (
            render.get("renderer", Render().renderer)
            if isinstance(render, dict)
            else getattr(render, "renderer", None)  # what else is no section is refused later
        )
        if renderer not in ("tiny", "egl"):
            return given
        vision, smooth = given.get("vision", {}), given.get("smooth", {})
        stereo = vision.get("stereo", {}) if isinstance(vision, dict) else None
        if isinstance(stereo, dict):
            given = given | {"vision": vision | {"stereo": _UNFILTERED | stereo}}
        if isinstance(smooth, dict):
            given = given | {"smooth": {"stray_m": _UNFILTERED_STRAY_M} | smooth}
        return given


class GeneratedScenario(SimulatedScenario):
    """A simulation as its file has it, whose world and robots the seed draws.

    Attributes:
        generate: what is drawn.
        render: what draws the images; drawn worlds are many, so the fast one unless it is named.
    """

    generate: Generate
    render: Render = Render(renderer="raycast")


class Generated(Section):
    """Where a generated world came from; written by the program, read by nobody but people.

    Attributes:
        plan_seed: what the plan was drawn from.
        overlap_asked: of the `generate` section.
        overlap: the one achieved: ground that two robots both visit over the ground that either
            visits, mean over pairs.
    """

    plan_seed: Annotated[int, Range(0, 2**32 - 1, "1")]
    overlap_asked: Annotated[float, Range(0, 1, "1")]
    overlap: Annotated[float, Range(0, 1, "1")]


class Simulation(SimulatedScenario):
    """An experiment in a simulated world.

    Attributes:
        world: walls and how they are painted.
        robots: the robots.
        generated: where a drawn world came from.
    """

    world: World
    robots: Annotated[list[Robot], Field(min_length=1, max_length=32), AfterValidator(different)]
    generated: Generated | None = None

    RULES: ClassVar[tuple[Rule, ...]] = (*Scenario.RULES, _drawn_from_below_the_walls)


AnyScenario = Simulation | Recording
