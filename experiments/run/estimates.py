"""What the aligners said, without any truth: rows of the table `estimates` as values."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.run.frames import records
from experiments.run.stage_tables import COVARIANCE, MOTION
from mapfusion.align.acceptance import Verdict
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.result import Alignment, Status
from mapfusion.evidence.copies import Copies
from mapfusion.evidence.likelihood import TwinShares
from mapfusion.evidence.pair_evidence import PairEvidence, RivalMotion
from mapfusion.evidence.parameters import EvidenceParameters
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float
from mapfusion.storage import covariances_from

_RIVAL_COUNTS = ("n_support", "n_confirmed", "n_contradicted", "n_regions")
_UPPER = np.triu_indices(3)


def estimate_row(
    n_correspondences: int, estimated: Alignment, refined: Alignment, verdict: Verdict
) -> dict[str, Any]:
    """One estimate, its refinement and the verdict on it as columns of the table `estimates`."""
    row = {
        "n_correspondences": n_correspondences,
        "verdict": str(verdict.status),
        "accepted": verdict.accepted,
        "log10_false_alarms": verdict.log10_false_alarms,
        "log10_evidence": verdict.log10_evidence,
        "n_confirmed": verdict.n_confirmed,
        "n_contradicted": verdict.n_contradicted,
        "probability": verdict.probability,
        "acceptance_reason": verdict.reason,
        "drift_sigma_m": refined.drift_sigma_m,
        **dict(zip(COVARIANCE, refined.covariance[_UPPER], strict=True)),
    }
    for prefix, found in (("", estimated), ("refined_", refined)):
        row |= {f"{prefix}status": str(found.status), f"{prefix}reason": found.reason}
        row |= {f"{prefix}{name}": x for name, x in zip(MOTION, found.T_a_b, strict=True)}
        row[f"{prefix}inliers"] = np.packbits(found.inlier).tobytes()
    return row


def unpacked(bits: bytes, n: int) -> np.ndarray:
    """The mask (n,) that `numpy.packbits` made these of."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=n).astype(bool)


def covariances_of(rows: pd.DataFrame) -> Float:
    """(n, 3, 3) of motions, from the columns COVARIANCE that hold their upper halves."""
    columns = {name: rows[name].to_numpy(dtype=np.float64) for name in COVARIANCE}
    return covariances_from(pa.table(columns), COVARIANCE)


def alignment_of(row: Mapping[Any, Any], n_correspondences: int) -> Alignment:
    """The refined alignment a row of `estimates` tells of, with the status of the verdict."""
    covariance = np.empty((3, 3))
    covariance[_UPPER] = covariance.T[_UPPER] = [row[name] for name in COVARIANCE]
    sureness, reason = row["log10_false_alarms"], row["acceptance_reason"]
    verdict = Verdict(Status(row["verdict"]), sureness, reason)
    T_a_b = np.array([row[f"refined_{name}"] for name in MOTION])
    inlier = unpacked(row["refined_inliers"], n_correspondences)
    outcome = (Status(row["refined_status"]), row["refined_reason"], row["drift_sigma_m"])
    return verdict.applied_to(Alignment(T_a_b, covariance, inlier, np.nan, *outcome))


def rival_rows(names: Mapping[str, Any], evidence: PairEvidence) -> list[dict[str, Any]]:
    """Rows of the table `rivals` of one pair of maps."""
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
    """What rows of `rivals` of one pair and iteration hold: nothing, where no motion was found."""
    n_a, n_b = map(len, maps)
    motions = tuple(
        RivalMotion(
            row["of"],
            np.array([row[name] for name in MOTION]),
            row["log10_false_alarms"],
            **{name: row[name] for name in _RIVAL_COUNTS},
            log10_evidence=row["log10_evidence"],
            copies=Copies(unpacked(row["copied_a"], n_a), unpacked(row["copied_b"], n_b)),
        )
        for row in records(rows)
    )
    if not motions:
        return PairEvidence.of_nothing(parameters)
    first = rows.iloc[0]
    shares = TwinShares(float(first["own_share"]), float(first["copied_share"]))
    return PairEvidence(motions, shares, float(first["region_m"]))


def correspondences_of(rows: pd.DataFrame) -> Correspondences:
    """The correspondences that rows of one pair and iteration hold."""
    return Correspondences(
        rows["index_a"].to_numpy(dtype=np.int64),
        rows["index_b"].to_numpy(dtype=np.int64),
        rows["descriptor_distance"].to_numpy(dtype=np.float64),
    )
