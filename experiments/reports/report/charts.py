"""The summaries behind the interactive charts, as JSON-able values."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.alignment_summary import MAP_PAIR
from experiments.studies.error_bands import error_bands, scarce_spans, time_bands
from experiments.studies.method_comparison import success_rates

_DIGITS = 5  # significant; more than any chart can show, and a third of the bytes of all of them
_MAX_POINTS = 400  # of a curve: a chart is about a thousand pixels wide
_MAX_TIMES = 40  # points of an aligner in the chart of times
_OFFERED = ["n_true", "n_correspondences"]
_ERRORS = {
    "translation_estimated": "translation_error_m",
    "translation_refined": "refined_translation_error_m",
    "rotation_estimated": "rotation_error_rad",
    "rotation_refined": "refined_rotation_error_rad",
}


def rounded(values: Any) -> list[float | None]:
    """Floats with a few significant digits; None for what is not finite."""
    return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in np.ravel(values)]


def thinned(values: np.ndarray, n: int) -> np.ndarray:
    """At most n of some values, evenly spread; the last one stays."""
    last = len(values) - 1
    return values[np.linspace(last, 0, min(n, last + 1)).round().astype(int)[::-1]]


def _band(rows: pd.DataFrame, column: str, scale: float = 1.0) -> dict[str, list[float | None]]:
    """Low, median and high, from columns named with "_low", "" and "_high" in their braces."""
    ends = {"low": "_low", "median": "", "high": "_high"}
    return {name: rounded(scale * rows[column.format(end)]) for name, end in ends.items()}


def error_curves(rows: pd.DataFrame, aligners: Sequence[str]) -> dict[str, Any]:
    """Median and band of the errors of each aligner against the iteration, and what was offered.

    Of rows of the table `errors`, or of `medians_of_run`; those of one iteration are pooled.
    """
    iterations = thinned(np.unique(rows["iteration"]), _MAX_POINTS)
    rows = rows[rows["iteration"].isin(iterations)]
    offered = rows.drop_duplicates(MAP_PAIR).groupby("iteration")[_OFFERED].median()
    # the sign of a rotation has no place on a logarithmic axis
    bands = error_bands(rows, by=(), absolute=True).set_index("iteration")
    of_aligner = {name: bands[bands["aligner"] == name].reindex(iterations) for name in aligners}
    return {
        "iteration": iterations.tolist(),
        **{name: rounded(offered[name]) for name in _OFFERED},
        "scarce": scarce_spans(rows),
        "aligners": {
            name: {curve: _band(own, f"{column}{{}}") for curve, column in _ERRORS.items()}
            for name, own in of_aligner.items()
        },
    }


def success_curves(maps: pd.DataFrame, aligners: Sequence[str]) -> list[dict[str, Any]]:
    """Success rates with their intervals against what makes an alignment hard.

    Of rows of `maps_of` with the column overlap_share, which may be unknown. Bins whose maps have
    no common ground, where there is nothing to be right about, are left out.
    """
    curves = []
    for by, (label, name) in _SUCCESS_AGAINST.items():
        rates = success_rates(maps, by)
        if rates.empty or rates["refined_success"].isna().all():
            continue
        rates = rates[rates["n_maps"] > rates["n_apart"]]
        bins = rates[["from", "to"]].drop_duplicates().sort_values("from")
        by_aligner = {}
        for aligner in aligners:
            own = rates[rates["aligner"] == aligner].set_index("from").reindex(bins["from"])
            band = _band(own, "refined_success{}")
            n_maps = (own["n_maps"] - own["n_apart"]).fillna(0).astype(int)
            by_aligner[aligner] = {"rate": band.pop("median"), **band, "n": n_maps.tolist()}
        labels = [name(*ends) for ends in bins.itertuples(index=False)]
        curves.append({"label": label, "bins": labels, "aligners": by_aligner})
    return curves


def _counts(low: float, high: float) -> str:
    """A bin of whole numbers, which holds its lower end alone."""
    if math.isinf(high):
        return f"≥ {low:g}"
    return f"{low:g}" if high == low + 1 else f"{low:g}–{high - 1:g}"


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

    Where there are too many maps to tell apart, those of similar numbers are taken together, and
    the band holds their medians in place of the repeats.
    """
    curves = {}
    for aligner in aligners:
        rows = timings[timings["aligner"] == aligner].dropna(subset="elapsed_s")
        if len(rows) > _MAX_TIMES:
            rows = time_bands(rows, "n_correspondences", _MAX_TIMES)
        if len(rows):
            rows = rows.sort_values("n_correspondences")
            band = _band(rows, "elapsed{}_s", scale=1e3)
            curves[aligner] = band | {"n": rounded(rows["n_correspondences"])}
    return curves
