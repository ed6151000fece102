"""Stages `match`, `aligner` and `align`: correspondences and estimates of one pair of robots.

Each aligner has a stage, so a changed aligner does not affect the stored estimates of the others.
"""

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job, StageKind
from experiments.pipeline.stages.smooth import (
    ROBOTS_KEPT,
    RobotFolders,
    folders_of_both,
    latest_at,
    maps_of,
)
from experiments.pipeline.tables import (
    CORRESPONDENCES,
    COVARIANCE,
    ESTIMATES,
    MOTION,
    RIVALS,
    at_iteration,
    read_rows,
    records,
    write_rows,
)
from experiments.plugins.discovery import callable_aligner
from mapfusion.align.alignment import Alignment, Pairs, Status
from mapfusion.align.correspondences import (
    Correspondences,
    MatchParameters,
    match,
    matched_by_geometry,
)
from mapfusion.align.refinement import Refinement
from mapfusion.geometry.numerics import generator
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Acceptance, Verdict
from mapfusion.verification.likelihood import TwinShares
from mapfusion.verification.regions import EvidenceParameters, ViewedMap
from mapfusion.verification.registration import PairRegistration, VerifiedRefinement
from mapfusion.verification.rivals import RepeatedLandmarks
from mapfusion.verification.verdict import PairEvidence, RivalMotion, Verifier, why_not_sought

_RIVAL_COUNTS = ("n_support", "n_confirmed", "n_contradicted", "n_regions")

_UPPER = np.triu_indices(3)

# Evaluated iterations per part: small enough that an interruption loses little and all cores end at
# about the same time, large enough that reading the maps is fast compared to their alignment.
_ITERATIONS_PER_BATCH = 12
_LABEL = "align the maps"
_BATCH_FILE, _RIVALS_FILE = "batch_{part}.parquet", "rivals_{part}.parquet"


@dataclass(frozen=True)
class MatchSettings:
    """Settings of correspondences and rivals, in addition to the maps.

    `smoothed` is true for smoothed maps, false for maps of the filter.
    """

    match: MatchParameters
    acceptance: Acceptance
    evidence: EvidenceParameters
    refinement: Refinement
    smoothed: bool
    iterations: tuple[int, ...]


def run_match(settings: MatchSettings, job: Job) -> None:
    """Find correspondences and rival motions of one batch of iterations."""
    made, rivals = [], []
    verifier = Verifier(settings.acceptance, settings.evidence, settings.refinement)
    for k, map_a, map_b in pairs_of_maps(job, settings.smoothed, settings.iterations):
        pairs = match(map_a, map_b, settings.match, one_floor=True)
        names = {"robot_a": map_a.name, "robot_b": map_b.name, "iteration": k}
        viewed_maps = None
        if not why_not_sought(map_a, map_b):
            a, b = folders_of_both(job)
            of_k = settings.smoothed, k
            viewed_maps = _viewed_map(a, *of_k), _viewed_map(b, *of_k)
        if evidence := verifier.on(Pairs(map_a, map_b, pairs), viewed_maps=viewed_maps).evidence:
            rivals += rival_rows(names, evidence)
        columns = names | {"index_a": pairs.index_a, "index_b": pairs.index_b}
        made.append(pd.DataFrame(columns | {"descriptor_distance": pairs.distance}))
    write_rows(batch_path(job.output, job.part), CORRESPONDENCES, pd.concat(made))
    write_rows(rivals_path(job.output, job.part), RIVALS, rivals)


MATCH_STAGE = StageKind("match", _LABEL, run_match, (_BATCH_FILE, _RIVALS_FILE))


@functools.lru_cache(maxsize=ROBOTS_KEPT * _ITERATIONS_PER_BATCH)
def _viewed_map(folders: RobotFolders, smoothed: bool, iteration: int) -> ViewedMap:
    """Return a robot's map with its cached queries, which all pairs of the robot share."""
    return ViewedMap(latest_at(maps_of(folders, smoothed=smoothed), iteration))


def batches(iterations: tuple[int, ...]) -> tuple[str, ...]:
    """Return the numbered parts of this stage and of the aligners' stages."""
    return tuple(f"{i:03d}" for i in range(-(-len(iterations) // _ITERATIONS_PER_BATCH)))


def batch_path(folder: Path, part: str) -> Path:
    """Return the path of one batch of a stage."""
    return folder / _BATCH_FILE.format(part=part)


def read_batches(folder: Path, table_schema: pa.Schema) -> pd.DataFrame:
    """Read all batches of a folder of this stage or of an aligner, in order."""
    paths = sorted(folder.glob(_BATCH_FILE.format(part="*")))
    return pd.concat([read_rows(path, table_schema) for path in paths], ignore_index=True)


def rivals_path(folder: Path, part: str) -> Path:
    """Return the path of the rivals of one batch."""
    return folder / _RIVALS_FILE.format(part=part)


def pairs_of_maps(
    job: Job, smoothed: bool, iterations: tuple[int, ...]
) -> Iterator[tuple[int, LandmarkMap, LandmarkMap]]:
    """Yield (iteration, map a, map b) of the job's batch."""
    a, b = (maps_of(folders, smoothed=smoothed) for folders in folders_of_both(job))
    start = int(job.part) * _ITERATIONS_PER_BATCH
    for k in iterations[start : start + _ITERATIONS_PER_BATCH]:
        yield k, latest_at(a, k), latest_at(b, k)


def estimate_row(
    n_correspondences: int, estimated: Alignment, refined: Alignment, verdict: Verdict
) -> dict[str, Any]:
    """Return an estimate, its refinement and their verdict as a row of the table `estimates`."""
    row = {
        "n_correspondences": n_correspondences,
        "verdict": str(verdict.status),
        "accepted": verdict.accepted,
        "log10_false_alarms": verdict.log10_false_alarms,
        "log10_evidence": verdict.log10_evidence,
        "log10_ratio_passed": verdict.log10_ratio_passed,
        "n_confirmed": verdict.n_confirmed,
        "n_contradicted": verdict.n_contradicted,
        "acceptance_reason": verdict.reason,
        "drift_sigma_m": refined.drift_sigma_m,
        **dict(zip(COVARIANCE, refined.covariance[_UPPER], strict=True)),
        "lower_bound": refined.lower_bound,
    }
    for prefix, found in (("", estimated), ("refined_", refined)):
        row |= {f"{prefix}status": str(found.status), f"{prefix}reason": found.reason}
        row |= {f"{prefix}{name}": x for name, x in zip(MOTION, found.T_a_b, strict=True)}
        row[f"{prefix}inliers"] = np.packbits(found.inlier).tobytes()
    return row


def unpacked(bits: bytes, n: int) -> np.ndarray:
    """Return the mask (n,) that was packed by `numpy.packbits`."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=n).astype(bool)


def alignment_of(row: Mapping[Any, Any], n_correspondences: int) -> Alignment:
    """Return the refined alignment of a row of `estimates`, with the status of the verdict."""
    covariance = np.empty((3, 3))
    covariance[_UPPER] = covariance.T[_UPPER] = [row[name] for name in COVARIANCE]
    sureness, reason = row["log10_false_alarms"], row["acceptance_reason"]
    verdict = Verdict(Status(row["verdict"]), sureness, reason)
    T_a_b = np.array([row[f"refined_{name}"] for name in MOTION])
    inlier = unpacked(row["refined_inliers"], n_correspondences)
    outcome = (Status(row["refined_status"]), row["refined_reason"], row["drift_sigma_m"])
    outcome += (bool(row["lower_bound"]),)
    return verdict.applied_to(Alignment(T_a_b, covariance, inlier, np.nan, *outcome))


def rival_rows(names: Mapping[str, Any], evidence: PairEvidence) -> list[dict[str, Any]]:
    """Return rows of the table `rivals` for one pair of maps."""
    own, copied = evidence.shares
    both = {"own_share": own, "copied_share": copied, "region_m": evidence.region_m}
    return [
        {
            **names,
            "of": motion.of,
            **dict(zip(MOTION, motion.T_a_b, strict=True)),
            "log10_false_alarms": motion.log10_false_alarms,
            **{name: getattr(motion, name) for name in _RIVAL_COUNTS},
            "log10_evidence": motion.log10_evidence,
            "copied_a": np.packbits(motion.copies.in_a).tobytes(),
            "copied_b": np.packbits(motion.copies.in_b).tobytes(),
            **both,
        }
        for motion in evidence.motions
    ]


def evidence_of(
    rows: pd.DataFrame, maps: Sequence[LandmarkMap], parameters: EvidenceParameters
) -> PairEvidence:
    """Return the evidence in rows of `rivals` of one pair and iteration; empty without rows."""
    n_a, n_b = map(len, maps)
    motions = tuple(
        RivalMotion(
            row["of"],
            np.array([row[name] for name in MOTION]),
            row["log10_false_alarms"],
            **{name: row[name] for name in _RIVAL_COUNTS},
            log10_evidence=row["log10_evidence"],
            copies=RepeatedLandmarks(
                unpacked(row["copied_a"], n_a), unpacked(row["copied_b"], n_b)
            ),
        )
        for row in records(rows)
    )
    if not motions:
        return PairEvidence.of_nothing(parameters)
    first = rows.iloc[0]
    shares = TwinShares(float(first["own_share"]), float(first["copied_share"]))
    return PairEvidence(motions, shares, float(first["region_m"]))


def correspondences_of(rows: pd.DataFrame) -> Correspondences:
    """Return the correspondences in rows of one pair and iteration."""
    return Correspondences(
        rows["index_a"].to_numpy(dtype=np.int64),
        rows["index_b"].to_numpy(dtype=np.int64),
        rows["descriptor_distance"].to_numpy(dtype=np.float64),
    )


_BATCHES_KEPT = 2  # batches in memory of a process: the present one and the next one


@dataclass(frozen=True)
class AlignerSettings:
    """Settings of an aligner's estimates, in addition to maps and correspondences.

    `smoothed` is true for smoothed maps, false for maps of the filter.
    """

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
    smoothed: bool
    iterations: tuple[int, ...]


def run_aligner(settings: AlignerSettings, job: Job) -> None:
    """Run the aligner at one batch of iterations on the correspondences of the match stage."""
    aligner = callable_aligner(settings.method, settings.parameters, settings.time_limit_s)
    verifier = Verifier(settings.acceptance, settings.evidence, settings.refinement)
    inputs = tuple(job.inputs.items())
    rows = []
    maps = settings.smoothed, settings.iterations
    for k, refinement in _refinements(inputs, job.part, verifier, *maps):
        pairs, on_pair = refinement.pairs, PairRegistration(aligner, refinement)
        for repetition in range(settings.repetitions if aligner.randomised else 1):
            names = {"robot_a": pairs.map_a.name, "robot_b": pairs.map_b.name, "iteration": k}
            names |= {"aligner": settings.name, "repetition": repetition}
            done = on_pair.register(generator(settings.seed, "align", *names.values()))
            rows.append(names | estimate_row(len(pairs), *done))
    write_rows(batch_path(job.output, job.part), ESTIMATES, rows)


ALIGNER_STAGE = StageKind("aligner", _LABEL, run_aligner, (_BATCH_FILE,))


@functools.lru_cache(maxsize=_BATCHES_KEPT)
def _refinements(
    inputs: tuple[tuple[str, Path], ...],
    part: str,
    verifier: Verifier,
    smoothed: bool,
    iterations: tuple[int, ...],
) -> Sequence[tuple[int, VerifiedRefinement]]:
    """Return iterations of a batch with the data that complete an estimate of any aligner.

    Tasks of several aligners follow each other, so the last batches stay in memory. The name of a
    folder determines its content.
    """
    job = Job(dict(inputs), Path(), part)
    offered = read_rows(batch_path(job.inputs["match"], part), CORRESPONDENCES)
    rivals = read_rows(rivals_path(job.inputs["match"], part), RIVALS)
    refinements = []
    for k, map_a, map_b in pairs_of_maps(job, smoothed, iterations):
        stored = correspondences_of(at_iteration(offered, k))
        if matched_by_geometry(map_a, map_b):
            stored = replace(stored, size_tolerance=MatchParameters().size_tolerance)
        pairs = Pairs(map_a, map_b, stored)
        evidence = evidence_of(at_iteration(rivals, k), (map_a, map_b), verifier.evidence)
        refinements.append((k, VerifiedRefinement(pairs, verifier.refinement, verifier, evidence)))
    return refinements


_JOINED_FILES = ("estimates.parquet", "correspondences.parquet", "rivals.parquet")


@dataclass(frozen=True)
class JoinSettings:
    """Batches of the aligners' stages."""

    batches: tuple[str, ...]


def run_align(settings: JoinSettings, job: Job) -> None:
    """Write one table of estimates, one of correspondences and one of rivals."""
    aligners = [folder for name, folder in job.inputs.items() if name != "match"]
    matched = [job.inputs["match"]]
    tables = (
        (ESTIMATES, batch_path, aligners),
        (CORRESPONDENCES, batch_path, matched),
        (RIVALS, rivals_path, matched),
    )
    for file, (schema, path_of, folders) in zip(_JOINED_FILES, tables, strict=True):
        paths = [path_of(folder, part) for part in settings.batches for folder in folders]
        joined = pd.concat([read_rows(path, schema) for path in paths], ignore_index=True)
        # a stable sort keeps the order of the aligners within an iteration
        joined = joined.sort_values("iteration", kind="stable", ignore_index=True)
        write_rows(job.output / file, schema, joined)


ALIGN_STAGE = StageKind("align", _LABEL, run_align, _JOINED_FILES)
