"""Criteria of the evaluation: correct alignment, shared ground, false merge, missed merge.

Metrics, statistics, comparisons, figures and reports all ask here. Their denominators are these:
shares (right, accepted) are of maps with common ground, median errors are over answerable maps, and
ratios to the oracle over rich ones.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from experiments.evaluation import tables

ORACLE = "oracle"  # the aligner that is given the true pairs
# An alignment is right within the reach of the refinement, by its default gate: from there the
# least squares that follows every method finds the true pairs; what is farther off it cannot mend,
# and a merge would double every wall of a room. The drift of two maps is several times less (0.05
# to 0.2 m, 0.01 rad). The limits are the same whatever gate a scenario sets, since no setting of a
# method may decide how the method is judged.
RIGHT_WITHIN_M = 0.5
# A rotation moves a landmark in proportion to its distance: by as much at 5 m, half the width of
# the ground that indoor maps share.
RIGHT_WITHIN_RAD = RIGHT_WITHIN_M / 5.0
# Landmarks of both maps that are one point of the world: two determine a motion, a third confirms
# it. With fewer there is nothing to be right about, and to refuse is right.
COMMON_LANDMARKS = 3
# True pairs among the correspondences that were offered. With fewer than 3 not even the oracle has
# much to go by; with 20 a robust method finds the motion, and refusing it is a miss; with fewer
# than 30 chance dominates a method's error and the oracle's alike, and so their ratio.
ANSWERABLE_PAIRS = 3
MERGEABLE_PAIRS = 20
RICH_PAIRS = 30
_ROBOT_PAIR = ("run_id", "seed", "robot_a", "robot_b")


def is_right(translation_m: pd.Series, rotation_rad: pd.Series) -> pd.Series:
    """Whether errors count as right; a missing estimate never does."""
    return (translation_m <= RIGHT_WITHIN_M) & (rotation_rad.abs() <= RIGHT_WITHIN_RAD)


def right_as_estimated(rows: pd.DataFrame) -> pd.Series:
    """Bool per row of `errors`: the method's own estimate is right."""
    return is_right(rows["translation_error_m"], rows["rotation_error_rad"])


def right_refined(rows: pd.DataFrame) -> pd.Series:
    """Bool per row of `errors`: what the least squares made of the estimate is right."""
    return is_right(rows["refined_translation_error_m"], rows["refined_rotation_error_rad"])


def how_far_off(rows: pd.DataFrame, columns: Sequence[str]) -> dict[str, pd.Series]:
    """Columns of errors, without their sign; what has no estimate is infinitely far off.

    Whatever sums up errors starts here: over the estimates that happen to exist a median flatters
    the methods that fail.
    """
    return {name: rows[name].abs().fillna(math.inf) for name in columns}


def has_common_ground(rows: pd.DataFrame) -> pd.Series:
    """Bool per row: whether the two maps share enough landmarks for an alignment to be right."""
    return rows["n_common"] >= COMMON_LANDMARKS


def is_false_merge(rows: pd.DataFrame) -> pd.Series:
    """Bool per row of `errors`: accepted though refined it is wrong, or without common ground."""
    return (rows["accepted"] == 1) & ~(right_refined(rows) & has_common_ground(rows))


def answerable(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with enough true pairs for an answer."""
    return rows[rows["n_true"] >= ANSWERABLE_PAIRS]


def mergeable(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with so many true pairs that a refusal is a miss."""
    return rows[rows["n_true"] >= MERGEABLE_PAIRS]


def rich(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with so many true pairs that errors can be held against the oracle's."""
    return rows[rows["n_true"] >= RICH_PAIRS]


def at_the_end(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows at the last iteration of each robot pair of each run."""
    return rows[rows["iteration"] == _of_robot_pair(rows, "iteration")]


def that_ever_meet(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of robot pairs that come to share ground in their run.

    Where several scenarios are pooled: errors of pairs that never meet are far off for everyone,
    and would cover what the others have to say.
    """
    return rows[_of_robot_pair(rows, "n_common") >= COMMON_LANDMARKS]


def _of_robot_pair(rows: pd.DataFrame, column: str) -> pd.Series:
    """The largest value that each row's robot pair has in its run."""
    keys = [name for name in _ROBOT_PAIR if name in rows]
    return rows.groupby(keys)[column].transform("max")


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
