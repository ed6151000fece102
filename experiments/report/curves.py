"""Series behind the interactive charts, as JSON-able values."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from experiments.figures.error_curves import BAND
from experiments.report.standing import MAP_PAIR, MIN_TRUE_PAIRS
from experiments.report.success import correct
from experiments.statistics.intervals import wilson

_DIGITS = 5  # significant; more than any chart can show, and a third of the bytes of all of them
_MAX_POINTS = 400  # of a curve: a chart is about a thousand pixels wide
_ERRORS = {
    "translation": ("translation_error_m", "refined_translation_error_m"),
    "rotation": ("rotation_error_rad", "refined_rotation_error_rad"),
}
_TRUE_PAIR_EDGES = (0, 1, MIN_TRUE_PAIRS, 5, 10, 20, 50, 100, 200, 500, 1000, math.inf)
_OUTLIER_EDGES = (0.0, 0.2, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0)
_ITERATION_BINS = 12


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
    enough = maps["n_true"].apply(lambda n: float((n >= MIN_TRUE_PAIRS).mean()))
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


def success_curves(errors: pd.DataFrame, aligners: Sequence[str]) -> list[dict[str, Any]]:
    """Success rates with their intervals against true pairs, outlier share and iteration."""
    judged = errors.assign(correct=correct(errors))
    offered = judged["n_correspondences"].to_numpy(dtype=np.float64)
    outliers = 1 - judged["n_true"].to_numpy() / np.where(offered > 0, offered, np.nan)
    last = int(errors["iteration"].max())
    by_iteration = np.linspace(0, last + 1, _ITERATION_BINS + 1).round().tolist()
    against = (
        ("true pairs among the correspondences", judged["n_true"], _TRUE_PAIR_EDGES, _counts),
        ("share of false correspondences", pd.Series(outliers), _OUTLIER_EDGES, _shares),
        ("iteration", judged["iteration"], sorted(set(by_iteration)), _counts),
    )
    return [
        _binned(judged, aligners, label, values.to_numpy(dtype=np.float64), edges, name)
        for label, values, edges, name in against
    ]


def _counts(low: float, high: float) -> str:
    if math.isinf(high):
        return f"≥ {low:g}"
    return f"{low:g}" if high - low == 1 else f"{low:g}–{high - 1:g}"


def _shares(low: float, high: float) -> str:
    return f"{100 * low:g}–{100 * high:g} %"


def _binned(
    judged: pd.DataFrame,
    aligners: Sequence[str],
    label: str,
    values: np.ndarray,
    edges: Sequence[float],
    name: Any,
) -> dict[str, Any]:
    place = np.searchsorted(np.array(edges[1:-1]), values, side="right")
    rows = judged[np.isfinite(values)].assign(bin=place[np.isfinite(values)])
    filled = sorted(rows["bin"].unique())
    curves = {}
    for aligner in aligners:
        # repetitions on the same maps are one trial: they are no independent evidence
        share = rows[rows["aligner"] == aligner].groupby(["bin", *MAP_PAIR])["correct"].mean()
        by_bin = share.groupby("bin").agg(["sum", "count"]).reindex(filled)
        trials = by_bin["count"].fillna(0)
        low, high = wilson(by_bin["sum"].fillna(0), trials)
        known = trials > 0
        curves[aligner] = {
            "rate": rounded(by_bin["sum"] / trials),
            "low": rounded(np.where(known, low, np.nan)),
            "high": rounded(np.where(known, high, np.nan)),
            "n": trials.astype(int).tolist(),
        }
    return {
        "label": label,
        "bins": [name(edges[b], edges[b + 1]) for b in filled],
        "aligners": curves,
    }


def time_curves(timings: pd.DataFrame, aligners: Sequence[str]) -> dict[str, Any]:
    """Time of one alignment against the number of correspondences, in milliseconds."""
    curves = {}
    for aligner in aligners:
        rows = timings[timings["aligner"] == aligner].sort_values("n_correspondences")
        if len(rows):
            curves[aligner] = {
                "n": rows["n_correspondences"].tolist(),
                "median": rounded(1e3 * rows["elapsed_s"]),
                "low": rounded(1e3 * rows["elapsed_low_s"]),
                "high": rounded(1e3 * rows["elapsed_high_s"]),
            }
    return curves
