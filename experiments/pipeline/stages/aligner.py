"""Stage: estimates of one aligner for one pair of robots, refined and tested against chance.

Each aligner has a stage, so a changed aligner does not affect the stored estimates of the others.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.pipeline.stage import Job
from experiments.pipeline.stages import match
from experiments.pipeline.tables import (
    CORRESPONDENCES,
    ESTIMATES,
    RIVALS,
    at_iteration,
    correspondences_of,
    estimate_row,
    evidence_of,
    read_rows,
    write_rows,
)
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.seeds import generator
from mapfusion.align.alignment import Pairs
from mapfusion.align.refinement import Refinement
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.regions import EvidenceParameters
from mapfusion.verification.registration import PairRegistration, VerifiedRefinement
from mapfusion.verification.verdict import Verifier

LABEL, WRITES = match.LABEL, match.WRITES[:1]
_BATCHES_KEPT = 2  # batches in memory of a process: the present one and the next one


@dataclass(frozen=True)
class AlignerSettings:
    """Settings of an aligner's estimates, in addition to maps and correspondences."""

    seed: int
    name: str
    method: str
    parameters: dict[str, Any]
    time_limit_s: float
    origin: dict[str, str]  # package, version and files of a plug-in method
    repetitions: int
    refinement: Refinement
    acceptance: Acceptance
    evidence: EvidenceParameters
    iterations: tuple[int, ...]


def run(settings: AlignerSettings, job: Job) -> None:
    """Run the aligner at one batch of iterations on the correspondences of the match stage."""
    aligner = callable_aligner(settings.method, settings.parameters, settings.time_limit_s)
    judge = Verifier(settings.acceptance, settings.evidence, settings.refinement)
    inputs = tuple(job.inputs.items())
    rows = []
    for k, verifier in _verifiers(inputs, job.part, judge, settings.iterations):
        pairs, on_pair = verifier.pairs, PairRegistration(aligner, verifier)
        for repetition in range(settings.repetitions if aligner.randomised else 1):
            names = {"robot_a": pairs.map_a.name, "robot_b": pairs.map_b.name, "iteration": k}
            names |= {"aligner": settings.name, "repetition": repetition}
            done = on_pair.register(generator(settings.seed, "align", *names.values()))
            rows.append(names | estimate_row(len(pairs), *done))
    write_rows(match.batch_path(job.output, job.part), ESTIMATES, rows)


@functools.lru_cache(maxsize=_BATCHES_KEPT)
def _verifiers(
    inputs: tuple[tuple[str, Path], ...], part: str, judge: Verifier, iterations: tuple[int, ...]
) -> Sequence[tuple[int, VerifiedRefinement]]:
    """Return iterations of a batch with the data that complete an estimate of any aligner.

    Tasks of several aligners follow each other, so the last batches stay in memory. The name of a
    folder determines its content.
    """
    job = Job(dict(inputs), Path(), part)
    offered = read_rows(match.batch_path(job.inputs["match"], part), CORRESPONDENCES)
    rivals = read_rows(match.rivals_path(job.inputs["match"], part), RIVALS)
    verifiers = []
    for k, map_a, map_b in match.pairs_of_maps(job, iterations):
        pairs = Pairs(map_a, map_b, correspondences_of(at_iteration(offered, k)))
        evidence = evidence_of(at_iteration(rivals, k), (map_a, map_b), judge.evidence)
        verifiers.append((k, VerifiedRefinement(pairs, judge.refinement, judge, evidence)))
    return verifiers
