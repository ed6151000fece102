"""One row per pair of maps and method: the repetitions of one run reduced, and judged.

All further statistics start from these rows: a pair of maps counts once, however often a method was
repeated on it, and the table of a run shrinks to a tenth before the next is read.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.judge.metrics import ORACLE
from experiments.study.statistics.run_tables import RUN_KEYS, Runs, setting_columns
from mapfusion.align.refine import Refinement

# An error in rotation moves a landmark in proportion to its distance; half the width of the ground
# that indoor maps share is about this far.
LEVER_M = 5.0
# As figures 4 and 5 shade: with fewer true pairs not even the oracle has much to go by, and maps
# that share fewer landmarks have no common ground.
ANSWERABLE_PAIRS = 3
MAP_KEYS = ("robot_a", "robot_b", "iteration")
_ERRORS = ("translation_error_m", "rotation_error_rad")
ERROR_COLUMNS = (*_ERRORS, *(f"refined_{name}" for name in _ERRORS))
_COUNTS = ("n_correspondences", "n_true", "n_common")
NEEDED = (*MAP_KEYS, "aligner", "repetition", *ERROR_COLUMNS, *_COUNTS)
OPTIONAL = ("accepted",)


@dataclass(frozen=True)
class Criteria:
    """When an alignment counts as right: its errors lie within the reach of the refinement.

    From there the local least squares that follows every method finds the true pairs: they lie in
    its gate (0.5 m by default), also those that a wrong angle moves by a lever of 5 m (0.1 rad).
    What is farther off the least squares cannot mend, and would be merged wrongly.

    Attributes:
        translation_m: largest error of the translation.
        rotation_rad: largest error of the rotation, either way.
    """

    translation_m: float = Refinement().gate_m
    rotation_rad: float = Refinement().gate_m / LEVER_M

    @classmethod
    def of(cls, runs: Runs) -> "Criteria":
        """From the scenarios of results: the smallest gate, so that all are judged alike."""
        gates = [result.gate_m for result in runs.results if result.gate_m is not None]
        gate_m = min(gates, default=Refinement().gate_m)
        return cls(gate_m, gate_m / LEVER_M)

    def met(self, translation_m: pd.Series, rotation_rad: pd.Series) -> pd.Series:
        """Whether errors count as right; a missing estimate never does."""
        return (translation_m <= self.translation_m) & (rotation_rad.abs() <= self.rotation_rad)


DEFAULT_CRITERIA = Criteria()


def maps_of(errors: pd.DataFrame, criteria: Criteria) -> pd.DataFrame:
    """One row per run, pair of maps and aligner.

    Args:
        errors: the table `errors` of some runs, with the columns of `read_runs` in front.
        criteria: what counts as right.

    Returns:
        The run's columns, robot_a, robot_b, iteration, aligner; n_repetitions; as shares of the
        repetitions estimated_success and refined_success (NaN for maps without common ground, where
        there is nothing to be right about), accepted, false_accepted (wrong, or without common
        ground) and refused_apart (NaN for maps with common ground), the last three NaN for runs
        without an acceptance test; the median absolute errors, infinite where most repetitions gave
        no estimate; n_correspondences, n_true, n_common, outlier_share.
    """
    ground = has_common_ground(errors)
    right = criteria.met(errors["translation_error_m"], errors["rotation_error_rad"])
    refined = criteria.met(
        errors["refined_translation_error_m"], errors["refined_rotation_error_rad"]
    )
    has_test = "accepted" in errors and bool(errors["accepted"].notna().any())
    accepted = errors["accepted"].astype(float) if has_test else np.nan
    judged = errors.assign(
        estimated_success=right.astype(float).where(ground),
        refined_success=refined.astype(float).where(ground),
        accepted=accepted,
        false_accepted=accepted * (1.0 - (refined & ground)),
        refused_apart=(1.0 - pd.Series(accepted, errors.index)).where(~ground),
        **{name: errors[name].abs().fillna(np.inf) for name in ERROR_COLUMNS},
    )
    keys = [*RUN_KEYS, *setting_columns(errors), *MAP_KEYS, "aligner"]
    groups = judged.groupby(keys, sort=False, dropna=False)
    shares = ["estimated_success", "refined_success", "accepted", "false_accepted"]
    shares += ["refused_apart"]
    maps = pd.concat(
        [
            groups.size().rename("n_repetitions"),
            groups[shares].mean(),
            groups[list(ERROR_COLUMNS)].median(),
            groups[list(_COUNTS)].first(),
        ],
        axis=1,
    ).reset_index()
    n_offered = maps["n_correspondences"]
    return maps.assign(
        outlier_share=(1 - maps["n_true"] / n_offered.where(n_offered > 0)).fillna(1.0)
    )


def has_common_ground(rows: pd.DataFrame) -> pd.Series:
    """Bool per row: whether the two maps share enough landmarks for an alignment to be right."""
    return rows["n_common"] >= ANSWERABLE_PAIRS


def that_ever_meet(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of the robot pairs that come to share ground in their run.

    Where several scenarios are pooled: errors of pairs that never meet are far off for everyone,
    and would cover what the others have to say.
    """
    most = rows.groupby(["run_id", "robot_a", "robot_b"])["n_common"].transform("max")
    return rows[most >= ANSWERABLE_PAIRS]


def read_maps(runs: Runs, criteria: Criteria) -> pd.DataFrame:
    """The same for all runs, one run in memory at a time."""
    parts = [maps_of(errors, criteria) for errors in runs.each("errors", NEEDED, OPTIONAL)]
    # a run of one robot has no rows, and must not decide the columns' types
    return pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)


def at_the_end(maps: pd.DataFrame) -> pd.DataFrame:
    """The rows at each robot pair's last iteration."""
    last = maps.groupby(["run_id", "robot_a", "robot_b"])["iteration"].transform("max")
    return maps[maps["iteration"] == last]


def methods_in(maps: pd.DataFrame, oracle: bool = False) -> list[str]:
    """Aligners in the order of their appearance; the oracle, if wanted, last."""
    found: Sequence[str] = maps["aligner"].drop_duplicates().tolist()
    return [name for name in found if name != ORACLE] + [ORACLE] * (oracle and ORACLE in found)
