"""Whether a run's maps were merged at all, and whether they should have been."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from experiments.judge import tables
from experiments.judge.criteria import at_the_end, has_common_ground


@dataclass(frozen=True)
class NothingMerged:
    """No two maps of a run became one.

    Attributes:
        common_ground: whether any two of the last maps share enough landmarks for an alignment to
            be right; None where no truth is known.
    """

    common_ground: bool | None

    @property
    def text(self) -> str:
        """The same in one line."""
        if self.common_ground is None:
            return "no two maps were merged (no truth: whether they share ground is unknown)"
        share = "though some share ground" if self.common_ground else "and none share ground"
        return f"no two maps were merged, {share}"

    @property
    def failed(self) -> bool:
        """Whether a check fails by it: only the truth can say that there was nothing to merge."""
        return self.common_ground is not False


def merged_robots(tx_m: pd.Series) -> int:
    """How many of a run's maps became one, by its `fused_motions`; 0 where none were."""
    n_placed = int(tx_m.notna().sum())
    return n_placed if n_placed > 1 else 0  # one is the first map alone


def nothing_merged(result: Path) -> NothingMerged | None:
    """What a result folder says; None where maps were merged, or there is only one robot."""
    motions = tables.read(tables.table_path(result, "fused_motions"), "fused_motions")
    if motions.empty or merged_robots(motions["tx_m"]):
        return None
    errors = tables.read(tables.table_path(result, "errors"), "errors")
    if errors.empty:
        return NothingMerged(None)
    return NothingMerged(bool(has_common_ground(at_the_end(errors)).any()))
