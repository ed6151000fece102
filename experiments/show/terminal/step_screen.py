"""What `slam`, `align` and `merge` show."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.show.terminal.layout import milliseconds, print_lines, print_table
from mapfusion.align.result import NOT_RUN, Status

if TYPE_CHECKING:
    from mapfusion.landmark_map import LandmarkMap
    from mapfusion.merge import FusedMap

_ESTIMATE_COLUMNS = {
    "aligner": ("\naligner", ""),
    "tx_m": ("tx\nm", ".2f"),
    "ty_m": ("ty\nm", ".2f"),
    "theta_rad": ("theta\nrad", ".2f"),
    "refined_tx_m": ("refined\nm", ".2f"),
    "refined_ty_m": ("ty\nm", ".2f"),
    "refined_theta_rad": ("theta\nrad", ".3f"),
    "inliers": ("\ninliers", ">"),
    "log10_false_alarms": ("NFA\nlog10", ".0f"),
    "time": ("time\nms", ">"),
}


def print_map(path: Path, landmarks: "LandmarkMap") -> None:
    """What a map holds and where it is."""
    print_lines([f"{len(landmarks)} landmarks of {landmarks.name} in {path}"])


def print_estimates(rows: Sequence[dict[str, Any]]) -> None:
    """Estimates of all aligners on two maps, and why those were not accepted that were not."""
    shown = [
        row
        | {"inliers": f"{row['n_inliers']}/{row['n_correspondences']}"}
        | {"time": milliseconds(row["elapsed_s"])}
        for row in rows
    ]
    print_table(
        list(_ESTIMATE_COLUMNS.values()),
        [[row[name] for name in _ESTIMATE_COLUMNS] for row in shown],
        "T_a_b, as estimated and refined",
        "NFA: expected number of alignments that chance alone supports as well",
    )
    for row in rows:
        reason = row["reason"] or row["acceptance_reason"]
        if reason:
            refused = row["status"] if row["status"] in NOT_RUN else Status.REFUSED
            status = Status.ACCEPTED if row["accepted"] else refused
            print_lines([f"  {row['aligner']}: {status}: {reason}"])


def print_fused(path: Path, fused: "FusedMap", names: Sequence[str]) -> None:
    """What a fused map was made of."""
    several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
    lines = [
        f"{len(fused.landmarks)} landmarks in {path}, {several} of them fused from several maps; "
        f"{fused.duplicate_share:.1%} look like duplicates that remain"
    ]
    for name, (x_m, y_m, theta_rad) in zip(names, fused.T_first_map, strict=True):
        if not math.isnan(x_m):
            lines.append(f"  {name}: T_first_map = ({x_m:.3f} m, {y_m:.3f} m, {theta_rad:.4f} rad)")
    for name, reason in fused.left_out:
        lines.append(f"  {name}: left out, its alignment was not accepted ({reason})")
    print_lines(lines)
