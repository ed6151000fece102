"""Figure of the experiment `refusal`: false merges against missed merges, and the calibration."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.show.figures.drawing import save_figure
from experiments.show.figures.style import (
    BLACK,
    GRAY,
    ORANGE,
    PAGE_WIDTH_IN,
    PURPLE,
    VERMILLION,
    aligner_styles,
    house_style,
    plain_numbers,
)
from experiments.study.refusal.cases import FEW, POSTER_RADII_M, POSTERS
from experiments.study.refusal.refusal_rates import Rate, mergeable, swept, without_common_ground

_SUPPORT_OF = "ransac"  # whose plain number of inliers is swept for comparison
_LEGEND_COLUMNS = 4  # of the methods' names, as wide as the page holds
_LEAST_DECADES = 0.5  # shares of zero are drawn so far below one in all pairs


def draw(refusals: pd.DataFrame, calibration: pd.DataFrame, false_alarms: float) -> Figure:
    """False against missed merges; shares accepted against the threshold; the calibration."""
    figure = Figure(figsize=(PAGE_WIDTH_IN, 6.2))
    (curve, rates), (calibrated, key) = figure.subplots(2, 2)
    names = refusals["aligner"].drop_duplicates().tolist()
    _draw_curves(curve, refusals, names)
    _draw_rates(rates, refusals, names, false_alarms)
    _draw_calibration(calibrated, calibration, false_alarms)
    handles, labels = curve.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=_LEGEND_COLUMNS, handlelength=2.6
    )
    key.set_axis_off()
    key.legend(
        *rates.get_legend_handles_labels(),
        loc="upper left",
        title=f"Above: {names[0]} (pairs of maps)",
        alignment="left",
    )
    return figure


def write(
    folder: Path, refusals: pd.DataFrame, calibration: pd.DataFrame, false_alarms: float
) -> list[Path]:
    """Draw into `FOLDER/figures/refusal.png` and `.svg`; returns them."""
    with house_style():
        return save_figure(draw(refusals, calibration, false_alarms), folder / "figures", "refusal")


def _draw_curves(axes: Axes, refusals: pd.DataFrame, names: list[str]) -> None:
    """ROC of each method as the threshold moves, and the point it works at."""
    floor_x, floor_y = _floor(without_common_ground(refusals)), _floor(mergeable(refusals))
    for name in names:
        own = refusals[refusals["aligner"] == name]
        style: dict[str, Any] = aligner_styles(names)[name] | {"marker": None}
        no, yes = without_common_ground(own), mergeable(own)
        thresholds = np.unique(own["log10_false_alarms"].dropna())
        false = swept(no["log10_false_alarms"], thresholds)
        missed = 1 - swept(yes["log10_false_alarms"], thresholds)
        axes.plot(np.maximum(false, floor_x), np.maximum(missed, floor_y), label=name, **style)
        _draw_point(axes, no, yes, style["color"], (floor_x, floor_y))
    own = refusals[refusals["aligner"] == _SUPPORT_OF]
    no, yes = without_common_ground(own)["n_inliers"], mergeable(own)["n_inliers"]
    supports = np.unique(-own["n_inliers"])
    axes.plot(
        np.maximum(swept(-no, supports), floor_x),
        np.maximum(1 - swept(-yes, supports), floor_y),
        color=GRAY,
        linestyle=":",
        label=f"{_SUPPORT_OF}, number of inliers alone",
    )
    axes.set(xscale="log", yscale="log", xlim=(floor_x / 1.3, 1.3), ylim=(floor_y / 1.3, 1.3))
    axes.set_xlabel("false merges: no common ground (left edge: none)")
    axes.set_ylabel("missed merges: 20+ true pairs (bottom: none)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(plain_numbers())


def _floor(rows: pd.DataFrame) -> float:
    one_in_all = len(rows["aligner"].unique()) / max(len(rows), 1)
    return float(one_in_all * 10**-_LEAST_DECADES)


def _draw_point(
    axes: Axes, no: pd.DataFrame, yes: pd.DataFrame, colour: str, floor: tuple[float, float]
) -> None:
    """The operating point with its Wilson intervals."""
    false = Rate(int(no["accepted"].sum()), len(no))
    missed = Rate(int((~yes["accepted"]).sum()), len(yes))
    x, y = max(false.share, floor[0]), max(missed.share, floor[1])
    for rate, at in ((false, x), (missed, y)):
        low, high = np.clip(rate.interval, floor[0] / 2, None)
        if rate is false:
            axes.plot([min(low, at), high], [y, y], color=colour, linewidth=3, alpha=0.35)
        else:
            axes.plot([x, x], [min(low, at), high], color=colour, linewidth=3, alpha=0.35)
    axes.plot(x, y, marker="o", color=colour, markeredgecolor=BLACK, clip_on=False, zorder=5)


def _draw_rates(axes: Axes, refusals: pd.DataFrame, names: list[str], false_alarms: float) -> None:
    """Share accepted against the threshold, for the first aligner's kinds of ground."""
    own = refusals[refusals["aligner"] == names[0]]
    thresholds = np.linspace(-100, 8, 500)
    kinds: tuple[tuple[pd.DataFrame, str, dict[str, Any]], ...] = (
        (without_common_ground(own), "no common ground", {"color": GRAY}),
        (mergeable(own), "20 or more true pairs", {"color": BLACK}),
        (own[own["ground"] == FEW], "20, in one corner", {"color": BLACK, "linestyle": "--"}),
        (
            own[(own["ground"] == POSTERS) & (own["n_common"] == 0)],
            "posters all over, no common ground",
            {"color": GRAY, "linestyle": "-."},
        ),
        *(
            (
                own[own["poster_radius_m"] == radius_m],
                f"a {2 * radius_m:g} m picture in both",
                {"color": colour, "linestyle": ":"},
            )
            for radius_m, colour in zip(POSTER_RADII_M, (ORANGE, VERMILLION, PURPLE), strict=True)
        ),
    )
    for rows, label, style in kinds:
        if len(rows):
            accepted = swept(rows["log10_false_alarms"], thresholds)
            axes.plot(thresholds, accepted, label=f"{label} ({len(rows)})", **style)
    axes.axvline(np.log10(false_alarms), color=GRAY, linewidth=0.8)
    axes.set_xlabel("threshold on log10 of the false alarms")
    axes.set_ylabel(f"share accepted, {names[0]}")


def _draw_calibration(axes: Axes, calibration: pd.DataFrame, false_alarms: float) -> None:
    stated = calibration["stated"].to_numpy()
    n = int(calibration["n_pairs"].iloc[0])
    axes.plot(stated, stated, color=GRAY, linewidth=0.8, label="stated")
    measured = calibration["motions_a_pair"].to_numpy()
    found = measured > 0
    axes.plot(stated[found], measured[found], color=BLACK, marker="o", label="measured")
    upper = [Rate(k, n).interval[1] for k in calibration["n_accepted"]]
    axes.plot(
        stated, upper, color=BLACK, linestyle=":", label="pairs of maps with one, upper 97.5 %"
    )
    axes.axvline(false_alarms, color=GRAY, linewidth=0.8)
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("false alarms stated, a pair of maps")
    axes.set_ylabel(f"measured on {n} pairs of random maps")
    axes.legend(loc="upper left")
