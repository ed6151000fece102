"""False and missed merges of the experiment `refusal`: rates, intervals, sweeps of thresholds."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.judge import criteria
from experiments.judge.criteria import has_common_ground, right_refined
from experiments.study.refusal.cases import APART, COMMON, FEW, POSTER_RADII_M
from experiments.study.statistics.intervals import wilson
from mapfusion.se2 import Float


class Rate(NamedTuple):
    """A share of n with its Wilson interval; NaN of none."""

    hits: int
    n: int

    @classmethod
    def of(cls, hits: pd.Series) -> "Rate":
        """The share of rows that hold True."""
        return cls(int(hits.sum()), len(hits))

    @property
    def share(self) -> float:
        """Of n."""
        return self.hits / self.n if self.n else np.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval."""
        low, high = wilson(self.hits, self.n)
        return (float(low), float(high)) if self.n else (np.nan, np.nan)


def ordinary(rows: pd.DataFrame) -> pd.DataFrame:
    """Pairs of maps of worlds that do not repeat themselves."""
    return rows[~rows["repeats"]]


def without_common_ground(rows: pd.DataFrame) -> pd.DataFrame:
    """Pairs of maps as they came in which every merge is false."""
    return rows[(rows["ground"] == APART) | ((rows["ground"] == COMMON) & ~has_common_ground(rows))]


def mergeable(rows: pd.DataFrame) -> pd.DataFrame:
    """Pairs of one world as they came, with enough true correspondences for any robust method."""
    return criteria.mergeable(rows[rows["ground"] == COMMON])


def summary(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """One row an aligner, in their order: the rates in ordinary worlds at the operating point."""
    groups = ordinary(refusals).groupby("aligner", sort=False)
    return [{"aligner": name} | _rates(own) for name, own in groups]


def _rates(own: pd.DataFrame) -> dict[str, Rate]:
    accepted, right, ground = own["accepted"], right_refined(own), has_common_ground(own)
    wrong = accepted & ~right
    common, few = (own["ground"] == ground for ground in (COMMON, FEW))
    able = own.index.isin(mergeable(own).index)
    hits = {
        "false": without_common_ground(own)["accepted"],
        "wrong": wrong[common & ground],
        "missed": ~accepted[able],
        "missed_though_right": ~accepted[able & right],
        "few_missed_though_right": ~accepted[few & right],
        "few_wrong": wrong[few],
    }
    for radius_m in POSTER_RADII_M:
        hits[f"poster_{radius_m:g}"] = accepted[own["poster_radius_m"] == radius_m]
    return {name: Rate.of(rows) for name, rows in hits.items()}


def swept(score: pd.Series, thresholds: Float) -> Float:
    """Share of scores up to each threshold (T,); a NaN is never accepted."""
    values = np.sort(score.dropna().to_numpy())
    return np.searchsorted(values, thresholds, side="right") / max(len(score), 1)
