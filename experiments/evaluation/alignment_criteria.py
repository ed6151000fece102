"""Criteria of correct alignments, and summaries of alignments by pair of maps and method.

Metrics, statistics, comparisons, figures and reports use these criteria. Shares (right, accepted)
count pairs of maps with common ground. Median errors use answerable pairs, and ratios to the oracle
use rich pairs.

Statistics start from the summary of each run: a pair of maps counts once, however often a method
was repeated on it. The summary is also much smaller than the table `errors`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.evaluation import tables
from experiments.evaluation.tables import SHOWN
from mapfusion.fusion.team_graph import EdgeStatus
from mapfusion.geometry.numerics import chi_square_bound

ORACLE = "oracle"  # the aligner that is given the true correspondences
# An alignment is right if the refinement can correct it: the limit is the default gate of the
# refinement. From a smaller error the least squares of the refinement finds the true pairs. A
# larger error remains, and the fused map has every wall twice. The drift of maps is much smaller.
# The limits do not depend on the scenario: a setting of a method must not change its evaluation.
RIGHT_WITHIN_M = 0.5
# Rotation that moves a landmark by the same distance at 5 m, half the width of the common ground of
# indoor maps.
RIGHT_WITHIN_RAD = RIGHT_WITHIN_M / 5.0
# Landmarks of both maps that are the same point of the world. Two determine a motion, a third
# confirms it. With fewer no alignment is right, and a refusal is correct.
COMMON_LANDMARKS = 3
# True pairs among the correspondences. With fewer than 3 the oracle has no answer either. With 20 a
# robust method finds the motion, and a refusal is a missed merge. With fewer than 30 chance
# dominates the errors of the method and of the oracle, and therefore their ratio.
ANSWERABLE_PAIRS = 3
MERGEABLE_PAIRS = 20
RICH_PAIRS = 30
_ROBOT_PAIR = ("run_id", "seed", "robot_a", "robot_b")


def is_right(translation_m: pd.Series, rotation_rad: pd.Series) -> pd.Series:
    """Return True for errors within the limits; False for missing estimates."""
    return (translation_m <= RIGHT_WITHIN_M) & (rotation_rad.abs() <= RIGHT_WITHIN_RAD)


def right_as_estimated(rows: pd.DataFrame) -> pd.Series:
    """Return True for rows of `errors` whose estimate is right before refinement."""
    return is_right(rows["translation_error_m"], rows["rotation_error_rad"])


def right_refined(rows: pd.DataFrame) -> pd.Series:
    """Return True for rows of `errors` whose refined estimate is right."""
    return is_right(rows["refined_translation_error_m"], rows["refined_rotation_error_rad"])


def absolute_errors(rows: pd.DataFrame, columns: Sequence[str]) -> dict[str, pd.Series]:
    """Return absolute values of error columns; infinite for missing estimates.

    A median over existing estimates alone would favour methods that often fail.
    """
    return {name: rows[name].abs().fillna(math.inf) for name in columns}


def has_common_ground(rows: pd.DataFrame) -> pd.Series:
    """Return True for rows whose maps share enough landmarks for a right alignment."""
    return rows["n_common"] >= COMMON_LANDMARKS


def is_false_merge(rows: pd.DataFrame) -> pd.Series:
    """Return True for accepted alignments that are wrong or lack common ground."""
    return (rows["accepted"] == 1) & ~(right_refined(rows) & has_common_ground(rows))


def answerable(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with enough true pairs for an estimate."""
    return rows[rows["n_true"] >= ANSWERABLE_PAIRS]


def mergeable(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with so many true pairs that a refusal is a missed merge."""
    return rows[rows["n_true"] >= MERGEABLE_PAIRS]


def rich(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with enough true pairs for a ratio to the oracle's error."""
    return rows[rows["n_true"] >= RICH_PAIRS]


CONSISTENCY_COLUMNS = ("aligner", "repetition", "accepted", "lower_bound", "alignment_nees")
_MOTION_DOF, _INSIDE = 3, 0.9  # degrees of freedom of T_a_b; probability of the ellipsoid


def alignment_consistency(errors: pd.DataFrame) -> pd.DataFrame:
    """Return the consistency of accepted alignments, one row per pair of maps and aligner.

    Alignments whose covariance is a lower bound do not count. Columns are added: `nees_per_dof`, 1
    on average if the covariance is right, and `inside`, whether the true motion lies in the 90 %
    ellipsoid.
    """
    rows = errors[errors["accepted"] & ~errors["lower_bound"] & (errors["repetition"] == 0)]
    nees = rows["alignment_nees"]
    inside = nees <= chi_square_bound(_INSIDE, _MOTION_DOF)
    return rows.assign(nees_per_dof=nees / _MOTION_DOF, inside=inside)[nees.notna()]


def at_last_iteration(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows at the last iteration of each robot pair of each run."""
    return rows[rows["iteration"] == _largest_of_robot_pair(rows, "iteration")]


def with_common_ground_at_any_time(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of robot pairs that have common ground at any iteration of their run.

    For pools of several scenarios: large errors of pairs without common ground would hide the
    differences between methods.
    """
    return rows[_largest_of_robot_pair(rows, "n_common") >= COMMON_LANDMARKS]


def _largest_of_robot_pair(rows: pd.DataFrame, column: str) -> pd.Series:
    """Return the largest value of a column over the rows with the same robot pair and run."""
    keys = [name for name in _ROBOT_PAIR if name in rows]
    return rows.groupby(keys)[column].transform("max")


def repetition_spread_m(rows: pd.DataFrame) -> float:
    """Return the 10-90 % range of one aligner's translation error over repetitions.

    Errors are before refinement, of repetitions that gave an estimate. The result is the median
    over seeds, robot pairs and iterations.
    """
    keys = [name for name in (*_ROBOT_PAIR, "iteration") if name in rows]
    groups = rows.groupby(keys)["translation_error_m"]
    return float((groups.quantile(0.9) - groups.quantile(0.1)).median())


@dataclass(frozen=True)
class NothingMerged:
    """Run in which no two maps were merged.

    Attributes:
        common_ground: True if any two of the last maps have common ground; None without truth.
    """

    common_ground: bool | None

    @property
    def text(self) -> str:
        """Message for the user."""
        if self.common_ground is None:
            return "no two maps were merged (no truth: whether they share ground is unknown)"
        share = "though some share ground" if self.common_ground else "and none share ground"
        return f"no two maps were merged, {share}"

    @property
    def failed(self) -> bool:
        """True if this fails a check: with common ground, and without truth."""
        return self.common_ground is not False


def merged_robots(tx_m: pd.Series) -> int:
    """Return the number of merged maps from column `tx_m` of `fused_motions`; 0 if none were."""
    n_placed = int(tx_m.notna().sum())
    return n_placed if n_placed > 1 else 0  # a single map is not merged


def nothing_merged(result: Path) -> NothingMerged | None:
    """Return the failure to merge of a result; None if maps were merged, or for one robot."""
    motions = tables.read(tables.table_path(result, "fused_motions"), "fused_motions")
    if motions.empty or merged_robots(motions["tx_m"]):
        return None
    fusers = tables.read(tables.table_path(result, "fusers"), "fusers")
    if (fusers["n_robots"] > 1).any():  # smoothed maps were merged
        return None
    errors = tables.read(tables.table_path(result, "errors"), "errors")
    if errors.empty:
        return NothingMerged(None)
    return NothingMerged(bool(has_common_ground(at_last_iteration(errors)).any()))


RUN_KEYS = ("run_id", "scenario", "seed")
MAP_KEYS = ("robot_a", "robot_b", "iteration")
MAP_PAIR = ["run_id", *MAP_KEYS]  # keys of two maps that all aligners were given
_ERRORS = ("translation_error_m", "rotation_error_rad")
ERROR_COLUMNS = (*_ERRORS, *(f"refined_{name}" for name in _ERRORS))
COUNTS = ("n_correspondences", "n_true", "n_common")
NEEDED = (*MAP_KEYS, "aligner", "repetition", *ERROR_COLUMNS, *COUNTS)
_COMPUTED = ("estimated_share", "refined_share")
# Columns that tables of earlier versions may lack.
OPTIONAL = tuple(name for name in SHOWN if name not in (*NEEDED, *_COMPUTED))


def summarise_alignments(errors: pd.DataFrame) -> pd.DataFrame:
    """Summarise rows of the table `errors` of one or more runs over the repetitions.

    Returns:
        One row per run, pair of maps and aligner. Columns:

        - the columns of the run, robot_a, robot_b, iteration, aligner, n_repetitions;
        - shares of the repetitions: estimated_success and refined_success (NaN without common
          ground), estimated_share and refined_share (an estimate exists), accepted, false_accepted
          (see `is_false_merge`) and refused_apart (refused without common ground, else NaN). The
          last three are NaN for runs without an acceptance test;
        - median absolute errors, infinite if most repetitions gave no estimate;
        - further columns that screens show;
        - n_correspondences, n_true, n_common and outlier_share.
    """
    ground = has_common_ground(errors)
    accepted = errors.get("accepted", pd.Series(np.nan, errors.index)).astype(float)
    false = is_false_merge(errors.assign(accepted=accepted))
    shares = {
        "estimated_success": right_as_estimated(errors).astype(float).where(ground),
        "refined_success": right_refined(errors).astype(float).where(ground),
        "estimated_share": errors["translation_error_m"].notna().astype(float),
        "refined_share": errors["refined_translation_error_m"].notna().astype(float),
        "accepted": accepted,
        "false_accepted": false.astype(float).where(accepted.notna()),
        "refused_apart": (1.0 - accepted).where(~ground),
    }
    of_errors = [name for name in SHOWN if name in errors and SHOWN[name].kind == "error"]
    of_errors = list(dict.fromkeys([*ERROR_COLUMNS, *of_errors]))
    evaluated = errors.assign(**shares, **absolute_errors(errors, of_errors))
    further = [name for name in SHOWN if name in errors and name not in (*shares, *of_errors)]
    keys = [name for name in RUN_KEYS if name in errors]
    keys += [*setting_columns(errors), *MAP_KEYS, "aligner"]
    groups = evaluated.groupby(keys, sort=False, dropna=False)
    parts = [groups.size().rename("n_repetitions"), groups[[*shares, *further]].mean()]
    parts += [groups[of_errors].median(), groups[list(COUNTS)].first()]
    maps = pd.concat(parts, axis=1).reset_index()
    n_offered = maps["n_correspondences"]
    false_share = 1 - maps["n_true"] / n_offered.where(n_offered > 0)
    return maps.assign(outlier_share=false_share.fillna(1.0))


def error_over_oracle(maps: pd.DataFrame, column: str) -> pd.Series:
    """Return by aligner the median of a translation error over the oracle's refined median.

    Args:
        maps: rows of `summarise_alignments`; should be rich.
        column: name of the translation error.
    """
    of_oracle = maps.loc[maps["aligner"] == ORACLE, "refined_translation_error_m"].median()
    medians = maps.groupby("aligner", sort=False)[column].median()
    return medians / (of_oracle if of_oracle > 0 else np.nan)


def setting_columns(frame: pd.DataFrame) -> list[str]:
    """Return the columns of settings that a sweep varied; their names contain a dot."""
    return [name for name in frame.columns if "." in name]


def methods_in(maps: pd.DataFrame, oracle: bool = False) -> list[str]:
    """Return the aligners in order of appearance; the oracle, if wanted, last."""
    found = maps["aligner"].drop_duplicates().tolist()
    return [name for name in found if name != ORACLE] + [ORACLE] * (oracle and ORACLE in found)


def rms(values: pd.Series) -> float:
    """Return the root mean square of the known values; NaN if none is known."""
    return float(np.sqrt(np.mean(np.square(values.dropna())))) if values.notna().any() else np.nan


def path_rms(robots: pd.DataFrame, by: Sequence[str] = ("robot",)) -> pd.DataFrame:
    """Return RMS position errors of FastSLAM's online paths and of odometry alone.

    Args:
        robots: rows of the table `robots`.
        by: columns that identify a robot of a run.

    Returns:
        One row for each robot. Columns: those of `by`, path_m, odometry_m, over_odometry (their
        ratio), n_landmarks at the end and n_frames.
    """
    groups = robots.groupby(list(by), sort=False)
    path_m, odometry_m = (groups[f"{of}_error_m"].agg(rms) for of in ("path", "odometry"))
    columns = {"path_m": path_m, "odometry_m": odometry_m, "n_frames": groups.size()}
    columns |= {"over_odometry": path_m / odometry_m.where(odometry_m > 0)}
    if "n_landmarks" in robots:
        columns |= {"n_landmarks": groups["n_landmarks"].last()}
    return pd.DataFrame(columns).reset_index()


def is_used_by_team(pairs: pd.DataFrame) -> pd.Series:
    """Return True for rows of `team_pairs` whose alignment moved maps in the fusion."""
    return pairs["place"].isin([EdgeStatus.CONFIRMED, EdgeStatus.BRIDGE])


def edge_precision(pairs: pd.DataFrame) -> float:
    """Return the share of right alignments among those that the team uses; NaN if it uses none."""
    used = pairs[is_used_by_team(pairs)]
    return float(1 - is_false_merge(used).mean())


def edge_recall(pairs: pd.DataFrame) -> float:
    """Return the share of pairs with common ground whose right alignment the team uses."""
    overlapping = pairs[has_common_ground(pairs)]
    return float((right_refined(overlapping) & is_used_by_team(overlapping)).mean())
