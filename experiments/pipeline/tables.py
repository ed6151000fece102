"""Tables of stages and their schemas, without the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from mapfusion.files import covariances_from, read_table, schema, write_table

# Commands that only read tables are quicker without pandas and the library's methods.
if TYPE_CHECKING:
    import pandas as pd

    from mapfusion.align.alignment import Alignment
    from mapfusion.align.correspondences import Correspondences
    from mapfusion.geometry.numerics import Float
    from mapfusion.landmark_map import LandmarkMap
    from mapfusion.verification.false_alarms import Verdict
    from mapfusion.verification.regions import EvidenceParameters
    from mapfusion.verification.verdict import PairEvidence


TEXT, INT, FLOAT, BOOL = pa.string(), pa.int32(), pa.float64(), pa.bool_()


def fields(**types: pa.DataType) -> list[pa.Field]:
    """Return schema fields from names and types."""
    return [pa.field(name, kind) for name, kind in types.items()]


def write_rows(
    path: Path,
    table_schema: pa.Schema,
    rows: pd.DataFrame | list[dict[str, Any]],
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write rows as a table with a schema and further text attributes."""
    import pandas as pd

    frame = pd.DataFrame(rows, columns=pd.Index(table_schema.names))
    columns = {column: frame[column].to_numpy() for column in frame}
    write_table(path, columns, table_schema, attributes)


def read_rows(path: Path, table_schema: pa.Schema) -> pd.DataFrame:
    """Read a table with a schema; raises InputError that names the file."""
    table, _ = read_table(path, table_schema)
    return table.to_pandas(use_threads=False)


def at_iteration(rows: pd.DataFrame, iteration: int) -> pd.DataFrame:
    """Return the rows of one iteration from a table that is sorted by iteration."""
    return rows.iloc[slice(*rows["iteration"].searchsorted([iteration, iteration + 1]))]


def records(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows as dicts, for few rows and many columns faster than pandas."""
    names = rows.columns.tolist()
    columns = (rows[name].tolist() for name in names)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


MOTION = ("tx_m", "ty_m", "theta_rad")
COVARIANCE = ("cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt")  # m2, m rad, rad2
_MAPS = {"robot_a": TEXT, "robot_b": TEXT, "iteration": INT}
_ANSWER = {"status": TEXT, "reason": TEXT} | dict.fromkeys(MOTION, FLOAT)

# Estimates of the aligners, written by the align stage.
ESTIMATES = schema(
    "result.estimates",
    3,
    fields(
        **_MAPS,
        aligner=TEXT,
        repetition=INT,
        n_correspondences=INT,
        **_ANSWER,
        **{f"refined_{name}": kind for name, kind in _ANSWER.items()},
        # of the refined alignment; NaN without an alignment or without evidence
        verdict=TEXT,
        accepted=BOOL,
        log10_false_alarms=FLOAT,
        log10_evidence=FLOAT,
        n_confirmed=INT,
        n_contradicted=INT,
        probability=FLOAT,
        acceptance_reason=TEXT,
        drift_sigma_m=FLOAT,
        # upper triangle of the refined alignment's covariance
        **dict.fromkeys(COVARIANCE, FLOAT),
        # one bit per correspondence, most significant first (numpy.packbits)
        inliers=pa.binary(),
        refined_inliers=pa.binary(),
    ),
)

# Correspondences given to the aligners: rows of the two maps at the iteration.
_OFFERED = fields(**_MAPS, index_a=INT, index_b=INT, descriptor_distance=FLOAT)
CORRESPONDENCES = schema("result.correspondences", 1, _OFFERED)

# Best distinct motions between two maps (of: "a b"), and of each map onto itself ("a", "b").
# log10_evidence: evidence of the first motion, as in the estimates; own_share, copied_share: shares
# of landmarks that a wrong motion maps to similar ones, in regions without and with another motion;
# region_m: side of a region; copied_a, copied_b: landmarks that a motion maps to similar ones, one
# bit each.
RIVALS = schema(
    "result.rivals",
    3,
    fields(
        **_MAPS,
        of=TEXT,
        **dict.fromkeys(MOTION, FLOAT),
        log10_false_alarms=FLOAT,
        n_support=INT,
        n_confirmed=INT,
        n_contradicted=INT,
        n_regions=INT,
        log10_evidence=FLOAT,
        own_share=FLOAT,
        copied_share=FLOAT,
        region_m=FLOAT,
        copied_a=pa.binary(),
        copied_b=pa.binary(),
    ),
)

# Harris points of a few consecutive frames, for figure 1.
_POINT = fields(robot=TEXT, iteration=INT, track=pa.int64(), length=INT, u_px=FLOAT, v_px=FLOAT)
TRACKS = schema("result.tracks", 1, _POINT)


_RIVAL_COUNTS = ("n_support", "n_confirmed", "n_contradicted", "n_regions")
_UPPER = np.triu_indices(3)


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
    """Return the mask (n,) that was packed by `numpy.packbits`."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=n).astype(bool)


def covariances_of(rows: pd.DataFrame) -> Float:
    """Return covariances (n, 3, 3) of motions from the columns COVARIANCE."""
    columns = {name: rows[name].to_numpy(dtype=np.float64) for name in COVARIANCE}
    return covariances_from(pa.table(columns), COVARIANCE)


def alignment_of(row: Mapping[Any, Any], n_correspondences: int) -> Alignment:
    """Return the refined alignment of a row of `estimates`, with the status of the verdict."""
    from mapfusion.align.alignment import Alignment, Status
    from mapfusion.verification.false_alarms import Verdict

    covariance = np.empty((3, 3))
    covariance[_UPPER] = covariance.T[_UPPER] = [row[name] for name in COVARIANCE]
    sureness, reason = row["log10_false_alarms"], row["acceptance_reason"]
    verdict = Verdict(Status(row["verdict"]), sureness, reason)
    T_a_b = np.array([row[f"refined_{name}"] for name in MOTION])
    inlier = unpacked(row["refined_inliers"], n_correspondences)
    outcome = (Status(row["refined_status"]), row["refined_reason"], row["drift_sigma_m"])
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
    from mapfusion.verification.likelihood import TwinShares
    from mapfusion.verification.rivals import RepeatedLandmarks
    from mapfusion.verification.verdict import PairEvidence, RivalMotion

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
    from mapfusion.align.correspondences import Correspondences

    return Correspondences(
        rows["index_a"].to_numpy(dtype=np.int64),
        rows["index_b"].to_numpy(dtype=np.int64),
        rows["descriptor_distance"].to_numpy(dtype=np.float64),
    )
