"""What the aligners said, without any truth: rows of the table `estimates` as values."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from mapfusion.align.acceptance import Verdict
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.result import Alignment, Status

_UPPER = np.triu_indices(3)
_COVARIANCE_COLUMNS = ("cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt")


def estimate_row(
    n_correspondences: int, estimated: Alignment, refined: Alignment, verdict: Verdict
) -> dict[str, Any]:
    """One estimate, its refinement and the verdict on it as columns of the table `estimates`."""
    upper = refined.covariance[_UPPER]
    return {
        "n_correspondences": n_correspondences,
        "status": str(estimated.status),
        "reason": estimated.reason,
        "tx_m": estimated.T_a_b[0],
        "ty_m": estimated.T_a_b[1],
        "theta_rad": estimated.T_a_b[2],
        "refined_status": str(refined.status),
        "refined_reason": refined.reason,
        "refined_tx_m": refined.T_a_b[0],
        "refined_ty_m": refined.T_a_b[1],
        "refined_theta_rad": refined.T_a_b[2],
        "accepted": verdict.accepted,
        "log10_false_alarms": verdict.log10_false_alarms,
        "acceptance_reason": verdict.reason,
        "drift_sigma_m": refined.drift_sigma_m,
        **dict(zip(_COVARIANCE_COLUMNS, upper, strict=True)),
        "inliers": np.packbits(estimated.inlier).tobytes(),
        "refined_inliers": np.packbits(refined.inlier).tobytes(),
    }


def inlier_mask(bits: bytes, n_correspondences: int) -> np.ndarray:
    """The mask (n,) that `estimate_row` packed."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=n_correspondences).astype(bool)


def alignment_of(row: Mapping[Any, Any], n_correspondences: int) -> Alignment:
    """The refined alignment a row of `estimates` tells of, refused where the verdict says so."""
    covariance = np.empty((3, 3))
    covariance[_UPPER] = [row[name] for name in _COVARIANCE_COLUMNS]
    covariance.T[_UPPER] = covariance[_UPPER]
    verdict = Verdict(bool(row["accepted"]), row["log10_false_alarms"], row["acceptance_reason"])
    refined = Alignment(
        np.array([row["refined_tx_m"], row["refined_ty_m"], row["refined_theta_rad"]]),
        covariance,
        inlier_mask(row["refined_inliers"], n_correspondences),
        np.nan,
        Status(row["refined_status"]),
        row["refined_reason"],
        row["drift_sigma_m"],
    )
    return verdict.applied_to(refined)


def correspondences_of(rows: pd.DataFrame) -> Correspondences:
    """The correspondences that rows of one pair and iteration hold."""
    return Correspondences(
        rows["index_a"].to_numpy(dtype=np.int64),
        rows["index_b"].to_numpy(dtype=np.int64),
        rows["descriptor_distance"].to_numpy(dtype=np.float64),
    )
