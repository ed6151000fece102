"""Alignments of one run in summary: one row per pair of maps and method.

All further statistics start from these rows: a pair of maps counts once, however often a method was
repeated on it, and the table of a run shrinks to a tenth before the next is read.
"""

import numpy as np
import pandas as pd

from experiments.evaluation import criteria
from experiments.evaluation.criteria import ORACLE
from experiments.evaluation.tables import SHOWN

RUN_KEYS = ("run_id", "scenario", "seed")
MAP_KEYS = ("robot_a", "robot_b", "iteration")
MAP_PAIR = ["run_id", *MAP_KEYS]  # two maps, given to all aligners alike
_ERRORS = ("translation_error_m", "rotation_error_rad")
ERROR_COLUMNS = (*_ERRORS, *(f"refined_{name}" for name in _ERRORS))
COUNTS = ("n_correspondences", "n_true", "n_common")
NEEDED = (*MAP_KEYS, "aligner", "repetition", *ERROR_COLUMNS, *COUNTS)
_MADE_HERE = ("estimated_share", "refined_share")
OPTIONAL = tuple(
    name for name in SHOWN if name not in (*NEEDED, *_MADE_HERE)
)  # older runs may lack them


def maps_of(errors: pd.DataFrame) -> pd.DataFrame:
    """One row per run, pair of maps and aligner, from the tables `errors` of some runs.

    Columns: the run's, robot_a, robot_b, iteration, aligner; n_repetitions; as shares of the
    repetitions estimated_success and refined_success (NaN for maps without common ground, where
    there is nothing to be right about), estimated_share and refined_share (an estimate is there),
    accepted, false_accepted (see `is_false_merge`) and
    refused_apart (NaN for maps with common ground), the last three NaN for runs without an
    acceptance test; the median absolute errors, infinite where most repetitions gave no estimate;
    further columns that are shown; n_correspondences, n_true, n_common, outlier_share.
    """
    ground = criteria.has_common_ground(errors)
    accepted = errors.get("accepted", pd.Series(np.nan, errors.index)).astype(float)
    false = criteria.is_false_merge(errors.assign(accepted=accepted))
    shares = {
        "estimated_success": criteria.right_as_estimated(errors).astype(float).where(ground),
        "refined_success": criteria.right_refined(errors).astype(float).where(ground),
        "estimated_share": errors["translation_error_m"].notna().astype(float),
        "refined_share": errors["refined_translation_error_m"].notna().astype(float),
        "accepted": accepted,
        "false_accepted": false.astype(float).where(accepted.notna()),
        "refused_apart": (1.0 - accepted).where(~ground),
    }
    off = [name for name in SHOWN if name in errors and SHOWN[name].kind == "error"]
    off = list(dict.fromkeys([*ERROR_COLUMNS, *off]))
    judged = errors.assign(**shares, **criteria.how_far_off(errors, off))
    further = [name for name in SHOWN if name in errors and name not in (*shares, *off)]
    keys = [name for name in RUN_KEYS if name in errors]
    keys += [*setting_columns(errors), *MAP_KEYS, "aligner"]
    groups = judged.groupby(keys, sort=False, dropna=False)
    parts = [groups.size().rename("n_repetitions"), groups[[*shares, *further]].mean()]
    parts += [groups[off].median(), groups[list(COUNTS)].first()]
    maps = pd.concat(parts, axis=1).reset_index()
    n_offered = maps["n_correspondences"]
    false_share = 1 - maps["n_true"] / n_offered.where(n_offered > 0)
    return maps.assign(outlier_share=false_share.fillna(1.0))


def error_over_oracle(maps: pd.DataFrame, column: str) -> pd.Series:
    """By aligner, the median of an error of `maps_of` over the oracle's, which is its refined one.

    `column` names a translation error; give it rich maps.
    """
    of_oracle = maps.loc[maps["aligner"] == ORACLE, "refined_translation_error_m"].median()
    medians = maps.groupby("aligner", sort=False)[column].median()
    return medians / (of_oracle if of_oracle > 0 else np.nan)


def setting_columns(frame: pd.DataFrame) -> list[str]:
    """What the sweeps varied: columns that are named as settings are, with a dot."""
    return [name for name in frame.columns if "." in name]


def methods_in(maps: pd.DataFrame, oracle: bool = False) -> list[str]:
    """Aligners in the order of their appearance; the oracle, if wanted, last."""
    found = maps["aligner"].drop_duplicates().tolist()
    return [name for name in found if name != ORACLE] + [ORACLE] * (oracle and ORACLE in found)
