"""Stage: what aligning the maps of two robots costs, matching and acceptance with it."""

from dataclasses import dataclass

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.aligner import AlignerSettings
from experiments.pipeline.stages.match import known_at, maps_of_both
from experiments.pipeline.tables import write_rows
from experiments.pipeline.workers import single_threaded
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.seeds import generator
from experiments.studies.independence.measured_work import (
    COSTS_FILE,
    WORK_COSTS,
    Cost,
    Meter,
    cost_row,
)
from mapfusion.align.correspondences import MatchParameters, match
from mapfusion.landmark_map import LandmarkMap
from mapfusion.registration import Registration
from mapfusion.verification.verdict import Judge

LABEL = "measure the team's work"
ALIGNMENT = "alignment"
WRITES = (COSTS_FILE,)


@dataclass(frozen=True)
class PairCostSettings:
    """Those of the stages whose work it is, and when maps are fused."""

    match: MatchParameters
    aligner: AlignerSettings
    iterations: tuple[int, ...]


def run(settings: PairCostSettings, job: Job) -> None:
    """Write what aligning costs at each iteration."""
    single_threaded()
    maps_a, maps_b = maps_of_both(job)
    both = {k: (known_at(maps_a, k), known_at(maps_b, k)) for k in settings.iterations}
    _align(settings, *both[settings.iterations[-1]])  # compiles, and fills caches
    costs = [cost_row(k, ALIGNMENT, _align(settings, *maps)) for k, maps in both.items()]
    write_rows(job.output / COSTS_FILE, WORK_COSTS, [dict(row) for row in costs])


def _align(settings: PairCostSettings, map_a: LandmarkMap, map_b: LandmarkMap) -> Cost:
    own = settings.aligner
    aligner = callable_aligner(own.method, own.parameters, own.time_limit_s)
    registration = Registration(
        aligner, own.refinement, Judge(own.acceptance, own.evidence, own.refinement)
    )
    rng, meter = generator(own.seed, "align", map_a.name, map_b.name), Meter()
    pairs = match(map_a, map_b, settings.match)
    registration.on(map_a, map_b, pairs).register(rng)
    return meter.read()
