"""Figure `refusal`: false against missed merges in ordinary worlds, and the calibration."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.evaluation.criteria import MERGEABLE_PAIRS
from experiments.reports.figures import style
from experiments.reports.figures.roc_curves import draw_curves, draw_support
from experiments.reports.figures.style import BLACK, GRAY
from experiments.studies.refusal.cases import FEW, POSTER_RADII_M
from experiments.studies.refusal.rates import (
    Rate,
    mergeable,
    ordinary,
    swept,
    without_common_ground,
)

_SCORE = "log10_false_alarms"
_THRESHOLDS = np.linspace(-100, 8, 500)  # on log10 of the false alarms
_POSTER_COLOURS = (style.ORANGE, style.VERMILLION, style.PURPLE)


def draw(refusals: pd.DataFrame, calibration: pd.DataFrame, false_alarms: float) -> Figure:
    """False against missed merges; shares accepted against the threshold; the calibration.

    Of worlds that do not repeat themselves, of which there must be some.
    """
    refusals = ordinary(refusals)
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, 6.2))
    (curve, rates), (calibrated, key) = figure.subplots(2, 2)
    first = refusals["aligner"].iloc[0]
    draw_curves(curve, refusals, _SCORE)
    draw_support(curve, refusals)
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


def _draw_rates(axes: Axes, own: pd.DataFrame) -> None:
    """Share accepted by one aligner against the threshold, for each kind of ground."""
    kinds = [
        (without_common_ground(own), "no common ground", GRAY, "-"),
        (mergeable(own), f"{MERGEABLE_PAIRS} or more true pairs", BLACK, "-"),
        (own[own["ground"] == FEW], "20, in one corner", BLACK, "--"),
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
