"""Series behind the interactive charts, as JSON-able values."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import ANSWERABLE_PAIRS, has_common_ground
from experiments.judge.judged_maps import MAP_PAIR
from experiments.study.statistics.error_bands import BAND
from experiments.study.statistics.success_rates import success_rates

_DIGITS = 5  # significant; more than any chart can show, and a third of the bytes of all of them
_MAX_POINTS = 400  # of a curve: a chart is about a thousand pixels wide
_MAX_TIMES = 40  # points of an aligner in the chart of times
_ERRORS = {
    "translation": ("translation_error_m", "refined_translation_error_m"),
    "rotation": ("rotation_error_rad", "refined_rotation_error_rad"),
}


def rounded(values: Any) -> list[float | None]:
    """Floats with a few significant digits; None for what is not finite."""
    return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in np.ravel(values)]


def error_curves(errors: pd.DataFrame, aligners: Sequence[str]) -> dict[str, Any]:
    """Median and band of the errors of each aligner against the iteration.

    Args:
        errors: rows of the table `errors`; those of one iteration are pooled.
        aligners: in display order.

    Returns:
        `iteration`, what was offered there, `scarce` spans, and for each aligner the curves.
    """
    iterations = np.unique(errors["iteration"].to_numpy())
    if len(iterations) > _MAX_POINTS:
        picked = np.linspace(0, len(iterations) - 1, _MAX_POINTS).round().astype(int)
        iterations = iterations[picked]
        errors = errors[errors["iteration"].isin(iterations)]
    maps = errors.drop_duplicates(MAP_PAIR).groupby("iteration")
    enough = maps["n_true"].apply(lambda n: float((n >= ANSWERABLE_PAIRS).mean()))
    return {
        "iteration": iterations.tolist(),
        "n_true": rounded(maps["n_true"].median()),
        "n_correspondences": rounded(maps["n_correspondences"].median()),
        "scarce": _spans(iterations, enough.to_numpy() < 0.5),
        "aligners": {name: _curves_of(errors, name, iterations) for name in aligners},
    }


def _curves_of(errors: pd.DataFrame, aligner: str, iterations: np.ndarray) -> dict[str, Any]:
    groups = errors[errors["aligner"] == aligner].groupby("iteration")
    curves: dict[str, Any] = {}
    for quantity, columns in _ERRORS.items():
        for stage, column in zip(("estimated", "refined"), columns, strict=True):
            # the sign of a rotation has no place on a logarithmic axis
            values = groups[column].agg(lambda v: list(v[np.isfinite(v)].abs())).reindex(iterations)
            at = [v if isinstance(v, list) and v else [math.nan] for v in values]
            low, median, high = np.array([np.quantile(v, [BAND[0], 0.5, BAND[1]]) for v in at]).T
            curves[f"{quantity}_{stage}"] = {
                "low": rounded(low),
                "median": rounded(median),
                "high": rounded(high),
            }
    return curves


def _spans(iterations: np.ndarray, scarce: np.ndarray) -> list[list[float]]:
    """First and last iteration of each stretch that is scarce, out to half way to the next."""
    middle = (iterations[1:] + iterations[:-1]) / 2
    left = np.concatenate([iterations[:1], middle])
    right = np.concatenate([middle, iterations[-1:]])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], scarce, [False]]).astype(int)))
    return [
        [float(left[first]), float(right[end - 1])] for first, end in edges.reshape(-1, 2).tolist()
    ]


def success_curves(maps: pd.DataFrame, aligners: Sequence[str]) -> list[dict[str, Any]]:
    """Success rates with their intervals against what makes an alignment hard.

    Args:
        maps: rows of `maps_of`, with or without the column overlap_share; those without common
            ground are left out.
        aligners: in display order.
    """
    maps = maps[has_common_ground(maps)]
    curves = []
    for by, (label, name) in _SUCCESS_AGAINST.items():
        if by not in maps or maps[by].isna().all():
            continue
        rates = success_rates(maps[maps[by].notna()], by)
        bins = rates[["from", "to"]].drop_duplicates().sort_values("from")
        labels = [name(*ends) for ends in bins.itertuples(index=False)]
        by_bin = {aligner: _rates_of(rates, aligner, bins["from"]) for aligner in aligners}
        curves.append({"label": label, "bins": labels, "aligners": by_bin})
    return curves


def _rates_of(rates: pd.DataFrame, aligner: str, starts: pd.Series) -> dict[str, Any]:
    own = rates[rates["aligner"] == aligner].set_index("from").reindex(starts)
    return {
        "rate": rounded(own["refined_success"]),
        "low": rounded(own["refined_success_low"]),
        "high": rounded(own["refined_success_high"]),
        "n": own["n_maps"].fillna(0).astype(int).tolist(),
    }


def _counts(low: float, high: float) -> str:
    """A bin of whole numbers, which holds its lower end alone."""
    if math.isinf(high):
        return f"≥ {low:g}"
    top = high - 1
    return f"{low:g}" if top == low else f"{low:g}–{top:g}"


def _shares(low: float, high: float) -> str:
    return f"{100 * low:g}–{100 * high:g} %"


_SUCCESS_AGAINST = {
    "n_true": ("true pairs among the correspondences", _counts),
    "outlier_share": ("share of false correspondences", _shares),
    "overlap_share": ("common landmarks, share of the smaller map", _shares),
    "iteration": ("iteration", _counts),
}


def time_curves(timings: pd.DataFrame, aligners: Sequence[str]) -> dict[str, Any]:
    """Time of one alignment against the number of correspondences, in milliseconds.

    Rows of similar numbers are taken together where there are too many to tell apart: their median,
    and 10-90 % of their medians in place of the repeats' own band.
    """
    curves = {}
    for aligner in aligners:
        rows = timings[timings["aligner"] == aligner].dropna(subset="elapsed_s")
        if len(rows) > _MAX_TIMES:
            place = rows["n_correspondences"].rank(pct=True) * _MAX_TIMES
            groups = rows.groupby(np.ceil(place.to_numpy()))
            rows = pd.DataFrame(
                {
                    "n_correspondences": groups["n_correspondences"].median(),
                    "elapsed_s": groups["elapsed_s"].median(),
                    "elapsed_low_s": groups["elapsed_s"].quantile(BAND[0]),
                    "elapsed_high_s": groups["elapsed_s"].quantile(BAND[1]),
                }
            )
        rows = rows.sort_values("n_correspondences")
        if len(rows):
            curves[aligner] = {
                "n": rounded(rows["n_correspondences"]),
                "median": rounded(1e3 * rows["elapsed_s"]),
                "low": rounded(1e3 * rows["elapsed_low_s"]),
                "high": rounded(1e3 * rows["elapsed_high_s"]),
            }
    return curves
