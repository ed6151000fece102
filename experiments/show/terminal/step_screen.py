"""What `slam`, `align` and `merge` show."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from experiments.show.terminal.layout import LAYOUT, number
from mapfusion.align.result import NOT_RUN, Status

if TYPE_CHECKING:
    from mapfusion.landmark_map import LandmarkMap
    from mapfusion.merge import FusedMap


def print_map(path: Path, landmarks: "LandmarkMap") -> None:
    """What a map holds and where it is."""
    Console().print(f"{len(landmarks)} landmarks of {landmarks.name} in {path}", soft_wrap=True)


def print_estimates(rows: Sequence[dict[str, Any]]) -> None:
    """Estimates of all aligners on two maps, and why those were not accepted that were not."""
    table = Table(
        title="T_a_b, as estimated and refined",
        caption="NFA: expected number of alignments that chance alone supports as well",
        **LAYOUT,
    )
    headings = ["\naligner", "tx\nm", "ty\nm", "theta\nrad"]
    headings += ["refined\nm", "ty\nm", "theta\nrad", "\ninliers", "NFA\nlog10", "time\nms"]
    for heading in headings:
        table.add_column(heading, justify="left" if "aligner" in heading else "right", no_wrap=True)
    for row in rows:
        table.add_row(
            row["aligner"],
            *(number(row[name], ".2f") for name in ("tx_m", "ty_m", "theta_rad")),
            *(number(row[f"refined_{name}"], ".2f") for name in ("tx_m", "ty_m")),
            number(row["refined_theta_rad"], ".3f"),
            f"{row['n_inliers']}/{row['n_correspondences']}",
            number(row["log10_false_alarms"], ".0f"),
            f"{1e3 * row['elapsed_s']:.1f}",
        )
    console = Console()
    console.print(table)
    for row in rows:
        reason = row["reason"] or row["acceptance_reason"]
        if reason:
            refused = row["status"] if row["status"] in NOT_RUN else Status.REFUSED
            status = Status.ACCEPTED if row["accepted"] else refused
            console.print(f"  {row['aligner']}: {status}: {reason}", soft_wrap=True, markup=False)


def print_fused(path: Path, fused: "FusedMap", names: Sequence[str]) -> None:
    """What a fused map was made of."""
    console = Console()
    several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
    console.print(
        f"{len(fused.landmarks)} landmarks in {path}, {several} of them fused from several maps; "
        f"{fused.duplicate_share:.1%} look like duplicates that remain",
        soft_wrap=True,
    )
    for name, motion in zip(names, fused.T_first_map, strict=True):
        if not math.isnan(motion[0]):
            text = f"({motion[0]:.3f} m, {motion[1]:.3f} m, {motion[2]:.4f} rad)"
            console.print(f"  {name}: T_first_map = {text}")
    for name, reason in fused.left_out:
        console.print(f"  {name}: left out, its alignment was not accepted ({reason})")
