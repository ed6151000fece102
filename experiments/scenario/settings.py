"""Scenario: one validated, frozen value from one YAML file.

`experiments/evaluation/metrics.py` computes them. The names are checked before a run.

Sections contain the parameter classes of the library (`FrontEndParameters`, `FastSlamParameters`,
...), so each parameter is defined and documented once.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from experiments.plugins.discovery import absolute_method, require_usable
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
from mapfusion.camera import StereoCamera
from mapfusion.errors import OutOfRangeError, did_you_mean
from mapfusion.fusion.fusers import USUAL, MergeParameters
from mapfusion.parameters import Range
from mapfusion.robot_log import TRUTH_TABLES
from mapfusion.tables import table_path
from mapfusion.team.link import LinkParameters
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.regions import EvidenceParameters
from mapfusion.verification.verdict import Verifier
from mapfusion.vision.front_end import FrontEndParameters
from sim.odometry import OdometryNoise
from sim.stereo_head import RadiometricNoise
from sim.trajectory import AttitudeNoise

# Metrics of a whole run.
RUN_METRICS = ("path_rmse_m", "odometry_rmse_m", "path_over_odometry")
RUN_METRICS += ("effective_sample_size", "spread_after_closure")
RUN_METRICS += tuple(
    f"smoother.{name}"
    for name in (
        *("path_rmse_m", "filter_over_smoother", "landmark_rmse_m", "gross_share"),
        *("nees_per_dof", "coverage_95"),
    )
)
RUN_METRICS += ("oracle_translation_m", "oracle_rotation_rad", "true_pairs_at_end", "false_merges")
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
# Metrics of robots that exchange maps while they drive.
RUN_METRICS += tuple(
    f"adoption.{name}"
    for name in (
        *(
            "robots",
            "first_iteration",
            "false_adoptions",
            "path_over_alone",
            "path_over_alone_worst",
        ),
        *("landmark_rmse_m", "nees_per_dof", "coverage_95", "shared_share", "sent_kb"),
    )
)
# Metrics of each fuser, after its name: columns of the table `fusers`.
FUSER_METRICS = ("landmark_rmse_m", "gross_share", "fitted_rmse_m", "fitted_median_m")
FUSER_METRICS += ("over_better_parent", "over_better_filter", "nees_per_dof", "frame_nees_per_dof")
FUSER_METRICS += ("coverage_95", "frame_coverage_95", "alignment_nees_per_dof", "duplicate_share")
FUSER_METRICS += ("alignment_error_m", "alignment_error_rad")
FUSER_METRICS += ("alignment_sigma_m", "alignment_sigma_rad")
# Metrics of each aligner, after its name.
ALIGNER_METRICS = (
    "refined_oracle_distance_m",
    "refined_over_oracle",
    "estimated_over_oracle",
    "estimated_translation_m",
    "largest_translation_m",
    "motion_nees_per_dof",
    "motion_coverage_90",
    "lead_over_others",
    "scatter_m",
    "false_merges",
    "missed_merges",
)
# Metrics that each aligner also has for alignments of smoothed maps, after "smoothed_".
SMOOTHED_METRICS = ("refined_over_oracle", "motion_nees_per_dof", "motion_coverage_90")
SMOOTHED_METRICS += ("false_merges", "missed_merges")
ALIGNER_METRICS += tuple(f"smoothed_{name}" for name in SMOOTHED_METRICS)


def known_metrics(aligners: Sequence[str], fusers: Sequence[str]) -> list[str]:
    """Return all metric names for these aligners and fusers."""
    of_fusers = [f"{fuser}.{name}" for fuser in fusers for name in FUSER_METRICS]
    of_aligners = [f"{aligner}.{name}" for aligner in aligners for name in ALIGNER_METRICS]
    return [*RUN_METRICS, *of_fusers, *of_aligners]


def why_unknown(name: str, aligners: Sequence[str], fusers: Sequence[str]) -> str:
    """Return the reason why a metric name is unknown; empty if it is known."""
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


# Larger values do not fit on screens.
MetricValue = Annotated[float, Range(-1e9, 1e9, "the metric's")]


class AlignerEntry(Section):
    """Aligner with a name.

    Attributes:
        name: name of the aligner in tables and figures.
        method: alignment method, built in, from an installed package, or a class in a Python file
            (FILE.py:CLASS, relative to the scenario file).
        parameters: parameters of the method.
        time_limit_s: time limit for one call of an aligner from another package. The default is
            long enough for slow methods on a busy machine.
    """

    name: Annotated[Name, AfterValidator(free)]
    method: Annotated[str, Field(max_length=1000), AfterValidator(absolute_method)]
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
    """Alignment: correspondences, aligners, refinement and verification.

    Attributes:
        match: matching of landmarks.
        aligners: aligners that are compared.
        also: aligners in addition to those of `aligners`.
        refinement: least-squares refinement after each aligner.
        acceptance: test of each alignment against chance.
        evidence: test of each alignment with the observations of both robots.
        repetitions: runs of each randomised aligner on a pair of maps, to measure its spread.
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
    def verifier(self) -> Verifier:
        """Verifier of alignments with these settings."""
        return Verifier(self.acceptance, self.evidence, self.refinement)

    @model_validator(mode="after")
    def _unique(self) -> Self:
        # merge both lists; `object.__setattr__` because the model is frozen
        aligners = different([*self.aligners, *self.also], "aligners: ")
        object.__setattr__(self, "aligners", aligners)
        object.__setattr__(self, "also", [])
        return self


class Merge(Section):
    """Fused map of a result.

    Attributes:
        aligner: aligner whose refined alignments are used; a name of `align.aligners`.
        fuser: fuser whose map is in figure 10 and in `maps/fused.parquet`; a name of
            `fuse.fusers`.
        parameters: parameters of the fusion.
    """

    aligner: Name = "ransac"
    fuser: Name = USUAL
    parameters: MergeParameters = MergeParameters()


class Evaluate(Section):
    """Evaluation of aligners.

    Attributes:
        every: interval between frames at which maps are aligned and evaluated; the last frame is
            always evaluated.
        true_pair_radius_m: distance of true points below which two landmarks are the same.
        timing_points: number of pairs of maps for timing aligners, evenly spread over the run.
        timing_repeats: number of timings on each pair.
    """

    every: Annotated[int, Range(1, MAX_COUNT, "frames")] = 25
    true_pair_radius_m: Annotated[float, Range(1e-3, 10, "m")] = 0.10
    timing_points: Annotated[int, Range(1, 1000, "pairs of maps")] = 8
    timing_repeats: Annotated[int, Range(1, 1000, "repetitions")] = 5


class Team(Section):
    """Robots that exchange maps while they drive.

    Attributes:
        link: link between the robots.
        starts: frame of the team in which a robot's log starts, by the name of the robot; 0 for the
            others.
        carried: for robots that are the same as another one after it was carried elsewhere, the
            name of that one. Their logs start when that one ends. They know its maps, but not
            where they are.
    """

    link: LinkParameters = LinkParameters()
    starts: dict[Name, Annotated[int, Range(0, MAX_COUNT, "frames")]] = Field(default_factory=dict)
    carried: dict[Name, Name] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _once(self) -> Self:
        for name, before in self.carried.items():
            if name in self.starts:
                raise ValueError(f"starts.{name}: {name} starts when the log of {before} ends")
            chain = [name]
            while chain[-1] in self.carried:
                chain.append(self.carried[chain[-1]])
                if chain[-1] in chain[:-1]:
                    raise ValueError(f"carried.{name}: a robot comes before itself")
        return self


class Bound(Section):
    """Range of a metric, including both ends.

    Attributes:
        min: smallest value that passes.
        max: largest value that passes.
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


# Stereo errors in images that PyBullet renders without texture filtering: edges are staircases, and
# matches of a wall seen at right angles lock onto its texels. With these values the stated standard
# deviations agree with the rendered depth, and most windows of a plane pass.
_UNFILTERED = {"plane_misfit_px": 0.7, "residual_correlation_px": 3.0, "sigma_floor_px": 0.06}
# Corners lock onto texels, too.
_UNFILTERED_STRAY_M = 0.003


# A rule about several sections. Its arguments are the sections by name. It yields lines that begin
# with the wrong key.
Rule = Callable[..., Iterator[str]]


class ContradictingSections(ValueError):  # noqa: N818  # pydantic names the error
    """Contradiction of valid sections; `problems` has one line for each."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = tuple(problems)


def sections_of(rules: Sequence[Rule]) -> set[str]:
    """Return the names of the sections that the rules use."""
    return {name for rule in rules for name in inspect.signature(rule).parameters}


def broken_rules(rules: Sequence[Rule], sections: Mapping[str, Any]) -> list[str]:
    """Apply the rules whose sections are all given; return the lines of broken rules."""
    broken = []
    for rule in rules:
        needed = sections_of([rule])
        if sections.keys() >= needed:
            broken += rule(**{name: sections[name] for name in needed})
    return broken


def merged_by_what_is_aligned(align: Align, merge: Merge, fuse: Fuse) -> Iterator[str]:
    """Yield lines if the merge uses an aligner or a fuser that does not run."""
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
    """Settings of simulations and recordings.

    Attributes:
        schema_version: version of the file format.
        name: name of the scenario and of its results.
        description: short description.
        tags: words that commands accept instead of the scenario's name.
        seed: seed of all random numbers.
        slam: filter and map.
        smooth: batch smoother.
        align: alignment of two maps.
        merge: fused map.
        fuse: fusers and their frames.
        evaluate: evaluation of aligners.
        team: exchange of maps while the robots drive; the robots that merge go on in the joint map.
            None: the robots stay alone.
        keep: data that is stored for figures.
        expect: bounds of metrics, which `mapfusion check` tests.
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
    team: Team | None = None
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
        """Return all settings with defaults as JSON values."""
        return self.model_dump(mode="json")

    def why_no_truth(self) -> str:
        """Return a reason why nothing can be judged; empty if the truth of any robot is known."""
        return ""


def has_truth(log: Path) -> bool:
    """Return True if true poses or true points are beside a log."""
    return any(table_path(log, name).is_file() for name in TRUTH_TABLES)


class Recording(Scenario):
    """Experiment on recorded logs.

    Attributes:
        logs: folders of robots' logs, relative to the scenario file.
    """

    logs: Annotated[list[str], Field(min_length=1, max_length=MAX_NAMED), AfterValidator(different)]

    def why_no_truth(self) -> str:
        """Return a text about the first log; empty if any log has true poses or points."""
        logs = [log for log in map(Path, self.logs) if log.is_dir()]
        if any(map(has_truth, logs)) or not logs:
            return ""
        lacking = " or ".join(f"{name}.parquet" for name in TRUTH_TABLES)
        return f"no truth is known: {logs[0]} has no {lacking} (or .csv)"


class SimulatedScenario(Scenario):
    """Settings of simulations in given and generated worlds.

    Attributes:
        drive: drive of the robots.
        render: renderer of the images.
        camera: stereo camera of all robots.
        radiometry: noise of the images.
        odometry: noise of the wheel encoders.
        attitude: noise of the measured roll and pitch of swaying robots.
        vision: front end, from images to observations. With a renderer without texture filtering
            (tiny, egl) the defaults of `stereo.plane_misfit_px`, `residual_correlation_px` and
            `sigma_floor_px` are 0.7, 3 and 0.06.
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
            else getattr(render, "renderer", None)  # other types are refused later
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
    """Simulation whose world and robots are drawn from the seed.

    Attributes:
        generate: parameters of the random world.
        render: renderer of the images; raycast by default, because generated worlds are many.
    """

    generate: Generate
    render: Render = Render(renderer="raycast")


class Generated(Section):
    """Origin of a generated world, for information only.

    Attributes:
        plan_seed: seed of the floor plan.
        overlap_asked: overlap in the `generate` section.
        overlap: overlap achieved: area that both of two robots visit over the area that either
            visits, mean over pairs.
    """

    plan_seed: Annotated[int, Range(0, 2**32 - 1, "1")]
    overlap_asked: Annotated[float, Range(0, 1, "1")]
    overlap: Annotated[float, Range(0, 1, "1")]


class Simulation(SimulatedScenario):
    """Experiment in a simulated world.

    Attributes:
        world: walls and textures.
        robots: the robots.
        generated: origin of a generated world.
    """

    world: World
    robots: Annotated[list[Robot], Field(min_length=1, max_length=32), AfterValidator(different)]
    generated: Generated | None = None

    RULES: ClassVar[tuple[Rule, ...]] = (*Scenario.RULES, _drawn_from_below_the_walls)


AnyScenario = Simulation | Recording
