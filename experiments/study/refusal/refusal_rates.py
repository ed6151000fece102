"""False and missed merges of the experiment `refusal`: rates, intervals, sweeps of thresholds."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from experiments.judge import criteria
from experiments.judge.criteria import has_common_ground, right_refined
from experiments.study.refusal.cases import APART, COMMON, FEW, POSTER_RADII_M, POSTERS
from mapfusion.se2 import Float

CONFIDENCE = 0.95


class Rate(NamedTuple):
    """A share of n with its Wilson interval; NaN of none."""

    hits: int
    n: int

    @property
    def share(self) -> float:
        """The share itself."""
        return self.hits / self.n if self.n else np.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval."""
        if not self.n:
            return np.nan, np.nan
        found = binomtest(self.hits, self.n).proportion_ci(CONFIDENCE, "wilson")
        return float(found.low), float(found.high)


def without_common_ground(rows: pd.DataFrame) -> pd.DataFrame:
    """Pairs of maps in which every merge is false; those with repeated posters are apart."""
    return rows[(rows["ground"] == APART) | ((rows["ground"] == COMMON) & ~has_common_ground(rows))]


def mergeable(rows: pd.DataFrame) -> pd.DataFrame:
    """Pairs of one world as they came, with 20 or more true correspondences."""
    return criteria.mergeable(rows[rows["ground"] == COMMON])


def summary(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """One row an aligner, in their order: the rates that the operating point has."""
    rows = []
    for name in refusals["aligner"].drop_duplicates():
        own = refusals[refusals["aligner"] == name]
        able, few = mergeable(own), own[own["ground"] == FEW]
        some = own[(own["ground"] == COMMON) & has_common_ground(own)]
        hung = own[own["ground"] == POSTERS]
        hung_common = hung[has_common_ground(hung)]
        rows.append(
            {
                "aligner": name,
                "false": _accepted(without_common_ground(own)),
                "wrong": _rate(some["accepted"] & ~right_refined(some)),
                "missed": _refused(able),
                "missed_though_right": _refused(able[right_refined(able)]),
                "few_missed_though_right": _refused(few[right_refined(few)]),
                "few_wrong": _rate(few["accepted"] & ~right_refined(few)),
                "posters_false": _accepted(hung[~has_common_ground(hung)]),
                "posters_wrong": _rate(hung_common["accepted"] & ~right_refined(hung_common)),
            }
            | {
                f"poster_{radius_m:g}": _accepted(own[own["poster_radius_m"] == radius_m])
                for radius_m in POSTER_RADII_M
            }
        )
    return rows


def _rate(hits: pd.Series) -> Rate:
    return Rate(int(hits.sum()), len(hits))


def _accepted(rows: pd.DataFrame) -> Rate:
    return _rate(rows["accepted"])


def _refused(rows: pd.DataFrame) -> Rate:
    return _rate(~rows["accepted"])


def swept(score: pd.Series, thresholds: Float) -> Float:
    """Share of scores up to each threshold (T,); a NaN is never accepted."""
    values = np.sort(score.dropna().to_numpy())
    return np.searchsorted(values, thresholds, side="right") / max(len(score), 1)
