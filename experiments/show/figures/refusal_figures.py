"""Figure of the experiment `refusal`: false merges against missed merges, and the calibration."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.judge.criteria import MERGEABLE_PAIRS, has_common_ground
from experiments.show.figures import style
from experiments.show.figures.style import BLACK, GRAY
from experiments.study.refusal.cases import FEW, POSTER_RADII_M, POSTERS
from experiments.study.refusal.refusal_rates import Rate, mergeable, swept, without_common_ground

_SUPPORT_OF = "ransac"  # whose plain number of inliers is swept for comparison
_LEAST_DECADES = 0.5  # shares of zero are drawn so far below one in all pairs
_THRESHOLDS = np.linspace(-100, 8, 500)  # on log10 of the false alarms
_POSTER_COLOURS = (style.ORANGE, style.VERMILLION, style.PURPLE)


def draw(refusals: pd.DataFrame, calibration: pd.DataFrame, false_alarms: float) -> Figure:
    """False against missed merges; shares accepted against the threshold; the calibration."""
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, 6.2))
    (curve, rates), (calibrated, key) = figure.subplots(2, 2)
    first = refusals["aligner"].iloc[0]
    _draw_curves(curve, refusals)
    _draw_rates(rates, refusals[refusals["aligner"] == first])
    _draw_calibration(calibrated, calibration)
    for axes, threshold in ((rates, np.log10(false_alarms)), (calibrated, false_alarms)):
        axes.axvline(threshold, color=GRAY, linewidth=0.8)
    legend = {"loc": "outside upper center", "ncols": 4, "handlelength": 2.6}
    figure.legend(*curve.get_legend_handles_labels(), **legend)
    key.set_axis_off()
    legend = {"loc": "upper left", "title": f"Above: {first} (pairs of maps)", "alignment": "left"}
    key.legend(*rates.get_legend_handles_labels(), **legend)
    return figure


def _draw_curves(axes: Axes, refusals: pd.DataFrame) -> None:
    """ROC of each method as the threshold moves, and the point it works at."""
    n_of_all = np.array([len(rows(refusals)) for rows in (without_common_ground, mergeable)])
    n_pairs = np.maximum(n_of_all / refusals["aligner"].nunique(), 1)
    floor = 10**-_LEAST_DECADES / n_pairs
    scored = refusals.assign(score=refusals["log10_false_alarms"])
    styles = style.aligner_styles(refusals["aligner"].unique().tolist())
    for name, own in scored.groupby("aligner", sort=False):
        line = styles[str(name)] | {"marker": None, "label": name}
        _draw_sweep(axes, own, floor, **line)
        _draw_point(axes, own, floor, line["color"])
    own = scored[scored["aligner"] == _SUPPORT_OF].assign(score=-refusals["n_inliers"])
    label = f"{_SUPPORT_OF}, number of inliers alone"
    _draw_sweep(axes, own, floor, color=GRAY, linestyle=":", label=label)
    axes.set(xscale="log", yscale="log", xlim=(floor[0] / 1.3, 1.3), ylim=(floor[1] / 1.3, 1.3))
    axes.set_xlabel("false merges: no common ground (left edge: none)")
    axes.set_ylabel(f"missed merges: {MERGEABLE_PAIRS}+ true pairs (bottom: none)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(style.plain_numbers())


def _draw_sweep(axes: Axes, own: pd.DataFrame, floor: np.ndarray, **line: Any) -> None:
    thresholds = np.unique(own["score"].dropna())
    false = swept(without_common_ground(own)["score"], thresholds)
    found = swept(mergeable(own)["score"], thresholds)
    axes.plot(np.maximum(false, floor[0]), np.maximum(1 - found, floor[1]), **line)


def _draw_point(axes: Axes, own: pd.DataFrame, floor: np.ndarray, colour: str) -> None:
    """The operating point with its Wilson intervals."""
    false, missed = without_common_ground(own)["accepted"], ~mergeable(own)["accepted"]
    rates = (Rate.of(false), Rate.of(missed))
    point = np.maximum([rate.share for rate in rates], floor)
    for axis, rate in enumerate(rates):
        ends = np.tile(point, (2, 1))
        low, high = np.clip(rate.interval, floor[0] / 2, None)
        ends[:, axis] = min(low, point[axis]), high
        axes.plot(*ends.T, color=colour, linewidth=3, alpha=0.35)
    axes.plot(*point, marker="o", color=colour, markeredgecolor=BLACK, clip_on=False, zorder=5)


def _draw_rates(axes: Axes, own: pd.DataFrame) -> None:
    """Share accepted by one aligner against the threshold, for each kind of ground."""
    posters = own[(own["ground"] == POSTERS) & ~has_common_ground(own)]
    kinds = [
        (without_common_ground(own), "no common ground", GRAY, "-"),
        (mergeable(own), f"{MERGEABLE_PAIRS} or more true pairs", BLACK, "-"),
        (own[own["ground"] == FEW], "20, in one corner", BLACK, "--"),
        (posters, "posters all over, no common ground", GRAY, "-."),
    ]
    for radius_m, colour in zip(POSTER_RADII_M, _POSTER_COLOURS, strict=True):
        label = f"a {2 * radius_m:g} m picture in both"
        kinds.append((own[own["poster_radius_m"] == radius_m], label, colour, ":"))
    for rows, label, colour, dashes in kinds:
        if len(rows):
            accepted = swept(rows["log10_false_alarms"], _THRESHOLDS)
            text = f"{label} ({len(rows)})"
            axes.plot(_THRESHOLDS, accepted, color=colour, linestyle=dashes, label=text)
    axes.set_xlabel("threshold on log10 of the false alarms")
    axes.set_ylabel(f"share accepted, {own['aligner'].iloc[0]}")


def _draw_calibration(axes: Axes, calibration: pd.DataFrame) -> None:
    stated, measured = calibration["stated"], calibration["motions_a_pair"]
    n = int(calibration["n_pairs"].iloc[0])
    upper = [Rate(k, n).interval[1] for k in calibration["n_accepted"]]
    axes.plot(stated, stated, color=GRAY, linewidth=0.8, label="stated")
    found = measured > 0
    axes.plot(stated[found], measured[found], color=BLACK, marker="o", label="measured")
    label = "pairs of maps with one, upper 97.5 %"
    axes.plot(stated, upper, color=BLACK, linestyle=":", label=label)
    axes.set(xscale="log", yscale="log", xlabel="false alarms stated, a pair of maps")
    axes.set_ylabel(f"measured on {n} pairs of random maps")
    axes.legend(loc="upper left")
