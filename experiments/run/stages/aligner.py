"""Stage: one aligner's estimates for one pair of robots, refined and held against chance.

Each aligner apart, so a run in which one has changed takes all others' estimates as they are.
"""

from dataclasses import dataclass
from typing import Any

from experiments.methods.aligner_calls import callable_aligner
from experiments.run.estimates import correspondences_of, estimate_row, evidence_of
from experiments.run.frames import at_iteration, read_rows, write_rows
from experiments.run.job import Job
from experiments.run.stage_tables import CORRESPONDENCES, ESTIMATES, RIVALS
from experiments.run.stages import match
from experiments.scenario.randomness import generator
from mapfusion.align.acceptance import Acceptance
from mapfusion.align.refine import Refinement
from mapfusion.align.registration import Registration
from mapfusion.evidence.judge import Judge
from mapfusion.evidence.parameters import EvidenceParameters

LABEL, WRITES = match.LABEL, match.WRITES[:1]


@dataclass(frozen=True)
class AlignerSettings:
    """All that an aligner's estimates depend on, beside the maps and the correspondences."""

    seed: int
    name: str
    method: str
    parameters: dict[str, Any]
    time_limit_s: float
    origin: dict[str, str]  # package, version and files of a method that is not ours
    repetitions: int
    refinement: Refinement
    acceptance: Acceptance
    evidence: EvidenceParameters
    iterations: tuple[int, ...]


def run(settings: AlignerSettings, job: Job) -> None:
    """Let the aligner estimate at one batch of iterations, on what the match stage offers."""
    offered = read_rows(match.batch_path(job.inputs["match"], job.part), CORRESPONDENCES)
    rivals = read_rows(match.rivals_path(job.inputs["match"], job.part), RIVALS)
    aligner = callable_aligner(settings.method, settings.parameters, settings.time_limit_s)
    judge = Judge(settings.acceptance, settings.evidence, settings.refinement)
    registration = Registration(aligner, settings.refinement, judge)
    rows = []
    for k, map_a, map_b in match.pairs_of_maps(job, settings.iterations):
        pairs = correspondences_of(at_iteration(offered, k))
        evidence = evidence_of(at_iteration(rivals, k), (map_a, map_b), settings.evidence)
        on_pair = registration.on(map_a, map_b, pairs, evidence)
        for repetition in range(settings.repetitions if registration.randomised else 1):
            names = {"robot_a": map_a.name, "robot_b": map_b.name, "iteration": k}
            names |= {"aligner": settings.name, "repetition": repetition}
            done = on_pair.register(generator(settings.seed, "align", *names.values()))
            rows.append(names | estimate_row(len(pairs), *done))
    write_rows(match.batch_path(job.output, job.part), ESTIMATES, rows)
