"""Figure of the experiment `refusal`: false merges against missed merges, and the calibration."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.judge.criteria import MERGEABLE_PAIRS, has_common_ground
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
_LOG10_RANGE = (-100, 8)  # of the thresholds
_POSTER_COLOURS = (ORANGE, VERMILLION, PURPLE)


def write(
    folder: Path, refusals: pd.DataFrame, calibration: pd.DataFrame, false_alarms: float
) -> list[Path]:
    """Draw into `FOLDER/figures/refusal.png` and `.svg`; returns them."""
    with house_style():
        return save_figure(draw(refusals, calibration, false_alarms), folder / "figures", "refusal")


def draw(refusals: pd.DataFrame, calibration: pd.DataFrame, false_alarms: float) -> Figure:
    """False against missed merges; shares accepted against the threshold; the calibration."""
    figure = Figure(figsize=(PAGE_WIDTH_IN, 6.2))
    (curve, rates), (calibrated, key) = figure.subplots(2, 2)
    _draw_curves(curve, refusals)
    first = refusals["aligner"].iloc[0]
    _draw_rates(rates, refusals[refusals["aligner"] == first], false_alarms)
    _draw_calibration(calibrated, calibration, false_alarms)
    legend = {"loc": "outside upper center", "ncols": _LEGEND_COLUMNS, "handlelength": 2.6}
    figure.legend(*curve.get_legend_handles_labels(), **legend)
    key.set_axis_off()
    legend = {"loc": "upper left", "title": f"Above: {first} (pairs of maps)", "alignment": "left"}
    key.legend(*rates.get_legend_handles_labels(), **legend)
    return figure


def _draw_curves(axes: Axes, refusals: pd.DataFrame) -> None:
    """ROC of each method as the threshold moves, and the point it works at."""
    no, yes = without_common_ground(refusals), mergeable(refusals)
    floor = np.array([_floor(no), _floor(yes)])
    styles = aligner_styles(refusals["aligner"].drop_duplicates().tolist())

    def sweep(name: str, score: pd.Series, thresholds: np.ndarray, **style: Any) -> None:
        own = (score[rows.index[rows["aligner"] == name]] for rows in (no, yes))
        false, found = (swept(each, thresholds) for each in own)
        axes.plot(np.maximum(false, floor[0]), np.maximum(1 - found, floor[1]), **style)

    for name, own in refusals.groupby("aligner", sort=False):
        style = styles[str(name)] | {"marker": None, "label": name}
        thresholds = np.unique(own["log10_false_alarms"].dropna())
        sweep(str(name), refusals["log10_false_alarms"], thresholds, **style)
        _draw_point(axes, without_common_ground(own), mergeable(own), style["color"], floor)
    score = -refusals["n_inliers"]
    label = f"{_SUPPORT_OF}, number of inliers alone"
    thresholds = np.unique(score[refusals["aligner"] == _SUPPORT_OF])
    sweep(_SUPPORT_OF, score, thresholds, color=GRAY, linestyle=":", label=label)
    axes.set(xscale="log", yscale="log", xlim=(floor[0] / 1.3, 1.3), ylim=(floor[1] / 1.3, 1.3))
    axes.set_xlabel("false merges: no common ground (left edge: none)")
    axes.set_ylabel(f"missed merges: {MERGEABLE_PAIRS}+ true pairs (bottom: none)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(plain_numbers())


def _floor(rows: pd.DataFrame) -> float:
    one_in_all = len(rows["aligner"].unique()) / max(len(rows), 1)
    return float(one_in_all * 10**-_LEAST_DECADES)


def _draw_point(
    axes: Axes, no: pd.DataFrame, yes: pd.DataFrame, colour: str, floor: np.ndarray
) -> None:
    """The operating point with its Wilson intervals."""
    rates = (
        Rate(int(no["accepted"].sum()), len(no)),
        Rate(int((~yes["accepted"]).sum()), len(yes)),
    )
    point = np.maximum([rate.share for rate in rates], floor)
    for axis, rate in enumerate(rates):
        ends = np.tile(point, (2, 1))
        low, high = np.clip(rate.interval, floor[0] / 2, None)
        ends[:, axis] = min(low, point[axis]), high
        axes.plot(*ends.T, color=colour, linewidth=3, alpha=0.35)
    axes.plot(*point, marker="o", color=colour, markeredgecolor=BLACK, clip_on=False, zorder=5)


def _draw_rates(axes: Axes, own: pd.DataFrame, false_alarms: float) -> None:
    """Share accepted by one aligner against the threshold, for each kind of ground."""
    posters = own[(own["ground"] == POSTERS) & ~has_common_ground(own)]
    kinds: list[tuple[pd.DataFrame, str, dict[str, Any]]] = [
        (without_common_ground(own), "no common ground", {"color": GRAY}),
        (mergeable(own), f"{MERGEABLE_PAIRS} or more true pairs", {"color": BLACK}),
        (own[own["ground"] == FEW], "20, in one corner", {"color": BLACK, "linestyle": "--"}),
        (posters, "posters all over, no common ground", {"color": GRAY, "linestyle": "-."}),
    ]
    for radius_m, colour in zip(POSTER_RADII_M, _POSTER_COLOURS, strict=True):
        label = f"a {2 * radius_m:g} m picture in both"
        style = {"color": colour, "linestyle": ":"}
        kinds.append((own[own["poster_radius_m"] == radius_m], label, style))
    thresholds = np.linspace(*_LOG10_RANGE, 500)
    for rows, label, style in kinds:
        if len(rows):
            accepted = swept(rows["log10_false_alarms"], thresholds)
            axes.plot(thresholds, accepted, label=f"{label} ({len(rows)})", **style)
    axes.axvline(np.log10(false_alarms), color=GRAY, linewidth=0.8)
    axes.set_xlabel("threshold on log10 of the false alarms")
    axes.set_ylabel(f"share accepted, {own['aligner'].iloc[0]}")


def _draw_calibration(axes: Axes, calibration: pd.DataFrame, false_alarms: float) -> None:
    stated, measured = (calibration[name].to_numpy() for name in ("stated", "motions_a_pair"))
    n = int(calibration["n_pairs"].iloc[0])
    upper = [Rate(k, n).interval[1] for k in calibration["n_accepted"]]
    found = measured > 0
    axes.plot(stated, stated, color=GRAY, linewidth=0.8, label="stated")
    axes.plot(stated[found], measured[found], color=BLACK, marker="o", label="measured")
    label = "pairs of maps with one, upper 97.5 %"
    axes.plot(stated, upper, color=BLACK, linestyle=":", label=label)
    axes.axvline(false_alarms, color=GRAY, linewidth=0.8)
    axes.set(xscale="log", yscale="log", xlabel="false alarms stated, a pair of maps")
    axes.set_ylabel(f"measured on {n} pairs of random maps")
    axes.legend(loc="upper left")
