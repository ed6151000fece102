"""What `align` and `merge` show."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.judge.user_files import Merged, verdict_on
from experiments.run.estimates import covariances_of
from experiments.show.numbers import two_digits
from experiments.show.terminal.layout import columns, print_frame, print_lines
from mapfusion.fused_map import FusedMap
from mapfusion.se2 import motion_sigma

_MOTIONS = columns("", aligner="aligner")
_MOTIONS |= columns(".3f", tx_m="estim.\ntx, m", ty_m="\nty, m")
_MOTIONS |= columns(".4f", theta_rad="\ntheta, rad")
_MOTIONS |= columns(".3f", refined_tx_m="refined\ntx, m", refined_ty_m="\nty, m")
_MOTIONS |= columns(".4f", refined_theta_rad="\ntheta, rad")
_MOTIONS |= columns(".3f", sigma_m="sigma\nm") | columns(".4f", sigma_rad="\nrad")
_VERDICTS = columns("", aligner="aligner", verdict="verdict") | columns(">", inliers="inliers")
_VERDICTS |= columns(".0f", log10_false_alarms="NFA\nlog10")
_VERDICTS |= columns("+.1f", log10_evidence="evidence\nlog10")
_VERDICTS |= columns(".2f", probability="prob.\nright") | columns(">", time="time\nms")


def print_estimates(rows: Sequence[dict[str, Any]]) -> None:
    """Estimates of all aligners on two maps, and what is to be said of each."""
    found = pd.DataFrame(rows)
    sigma_m, sigma_rad = motion_sigma(covariances_of(found))
    stated = found.assign(sigma_m=sigma_m, sigma_rad=sigma_rad)
    note = "sigma: as stated for the refined one, of the distance and of the angle"
    print_frame(stated, _MOTIONS, "T_a_b, as estimated and refined", note)
    inliers = found["n_inliers"].map(str) + "/" + found["n_correspondences"].map(str)
    verdicts = [verdict_on(row) for row in rows]
    times = (1e3 * found["elapsed_s"]).map(two_digits)
    print_frame(
        found.assign(inliers=inliers, time=times, verdict=[str(status) for status, _ in verdicts]),
        _VERDICTS,
        "Verdicts on the refined ones",
        "NFA: expected number of alignments that chance alone supports as well; evidence:\n"
        "how much likelier what both robots saw is if it is right; time: of the estimate",
    )
    for row, (status, why) in zip(rows, verdicts, strict=True):
        if reason := why or row["reason"]:
            print_lines([f"  {row['aligner']}: {status}: {reason}"])


def print_fused(path: Path, fused: FusedMap, maps: Sequence[Path]) -> None:
    """What a fused map was made of."""
    several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
    n_maps = len(fused.members)
    lines = [
        f"{len(fused.landmarks)} landmarks in {path}: fused from {n_maps} maps; {several} "
        f"landmarks are of several maps, {fused.duplicate_share:.1%} look like duplicates that "
        "remain"
    ]
    sigmas = zip(*motion_sigma(fused.motion_covariance), strict=True)
    for name, (x_m, y_m, theta_rad), sigma in zip(maps, fused.T_first_map, sigmas, strict=True):
        if not math.isnan(x_m):
            stated = f"sigma {sigma[0]:.3f} m, {sigma[1]:.4f} rad" if any(sigma) else "the frame"
            T = f"({x_m:.3f} m, {y_m:.3f} m, {theta_rad:.4f} rad)"
            lines.append(f"  {name}: T_first_map = {T}, {stated}")
    lines += [f"  {name}: left out ({reason})" for name, reason in fused.left_out]
    print_lines(lines)


def print_unmerged(merged: Merged, maps: Sequence[Path]) -> None:
    """Why each two maps were not merged."""
    print_lines(
        f"  {maps[a]} and {maps[b]}: not merged: {reason}"
        for (a, b), reason in merged.reasons().items()
    )
