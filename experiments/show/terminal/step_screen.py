"""What `align` and `merge` show."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.show.numbers import two_digits
from experiments.show.terminal.layout import columns, print_frame, print_lines
from mapfusion.align.result import NOT_RUN, Status
from mapfusion.merge import FusedMap

_ESTIMATES = columns("", aligner="aligner")
_ESTIMATES |= columns(".2f", tx_m="tx\nm", ty_m="ty\nm", theta_rad="theta\nrad")
_ESTIMATES |= columns(".2f", refined_tx_m="refined\nm", refined_ty_m="ty\nm")
_ESTIMATES |= columns(".3f", refined_theta_rad="theta\nrad") | columns(">", inliers="inliers")
_ESTIMATES |= columns(".0f", log10_false_alarms="NFA\nlog10") | columns(">", time="time\nms")


def print_estimates(rows: Sequence[dict[str, Any]]) -> None:
    """Estimates of all aligners on two maps, and why those were not accepted that were not."""
    found = pd.DataFrame(rows)
    inliers = found["n_inliers"].map(str) + "/" + found["n_correspondences"].map(str)
    print_frame(
        found.assign(inliers=inliers, time=(1e3 * found["elapsed_s"]).map(two_digits)),
        _ESTIMATES,
        "T_a_b, as estimated and refined",
        "NFA: expected number of alignments that chance alone supports as well",
    )
    for row in rows:
        if reason := row["reason"] or row["acceptance_reason"]:
            refused = row["status"] if row["status"] in NOT_RUN else Status.REFUSED
            status = Status.ACCEPTED if row["accepted"] else refused
            print_lines([f"  {row['aligner']}: {status}: {reason}"])


def print_fused(path: Path, fused: FusedMap, maps: Sequence[Path]) -> None:
    """What a fused map was made of."""
    several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
    lines = [
        f"{len(fused.landmarks)} landmarks in {path}, {several} of them fused from several maps; "
        f"{fused.duplicate_share:.1%} look like duplicates that remain"
    ]
    for name, (x_m, y_m, theta_rad) in zip(maps, fused.T_first_map, strict=True):
        if not math.isnan(x_m):
            lines.append(f"  {name}: T_first_map = ({x_m:.3f} m, {y_m:.3f} m, {theta_rad:.4f} rad)")
    for name, reason in fused.left_out:
        lines.append(f"  {name}: left out, its alignment was not accepted ({reason})")
    print_lines(lines)
