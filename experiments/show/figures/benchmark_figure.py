"""The benchmark's figure: success, error over the oracle and time against the share of outliers."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from experiments.show.figures.style import (
    PAGE_WIDTH_IN,
    aligner_legend,
    aligner_styles,
    plain_numbers,
)
from mapfusion.align.result import Status

_HEIGHT_IN = 6.6
_LEGEND_COLUMNS = 5
_BAND_ALPHA = 0.14
_DODGE = 0.45  # of the distance between two shares, over which the methods are spread
_MIN_SUCCESSES = 10  # the median error of fewer says little
_RATIO_TICKS = (1, 2, 5, 10, 20, 50, 100)
_RATIO_RANGE = (0.9, 11.0)  # shown at least
_MARGIN = 1.15  # about what is drawn
_ROWS = ("success (%)", "error over the oracle's", "time of one call (ms)")


def draw(summary: pd.DataFrame) -> Figure:
    """One column of panels for each number of pairs; the rows as in `_ROWS`.

    Bands: Wilson's 95 % interval of the success, 10-90 % of the trials' times. The shares are
    spaced evenly and the methods set a little apart, as most lie on one another.
    """
    counts = summary["n_pairs"].drop_duplicates().tolist()
    methods = summary["method"].drop_duplicates().tolist()
    styles = aligner_styles(methods)
    shares = sorted(summary["outlier_share"].unique())
    figure = Figure(figsize=(PAGE_WIDTH_IN, _HEIGHT_IN))
    panels = figure.subplots(len(_ROWS), len(counts), sharex=True, sharey="row", squeeze=False)
    for column, count in enumerate(counts):
        for place, method in enumerate(methods):
            own = summary[(summary["n_pairs"] == count) & (summary["method"] == method)]
            own = own[own["status"] != Status.ABSENT].sort_values("outlier_share")
            offset = _DODGE * ((place + 0.5) / len(methods) - 0.5)
            x = np.searchsorted(shares, own["outlier_share"].to_numpy()) + offset
            _add_method(panels[:, column], x, own, styles[method])
        panels[0, column].set_title(f"{count} pairs")
        panels[-1, column].set_xlabel("outliers (%)")
    _lay_out(panels, shares)
    absent = set(summary["method"][summary["status"] == Status.ABSENT])
    labels = {name: f"{name} (absent)" if name in absent else name for name in methods}
    aligner_legend(figure, labels, styles, _LEGEND_COLUMNS)
    return figure


def _add_method(axes: np.ndarray, x: np.ndarray, own: pd.DataFrame, style: dict) -> None:
    success, ratio, elapsed = axes
    style = style | {"linewidth": 0.8, "markersize": 2.8}
    low, high = (100 * own[f"success_{end}"].to_numpy() for end in ("low", "high"))
    success.vlines(x, low, high, color=style["color"], linewidth=2.2, alpha=0.35)
    success.plot(x, 100 * own["success"].to_numpy(), **style)
    shown = own["n_success"].to_numpy() >= _MIN_SUCCESSES
    ratio.plot(x, np.where(shown, own["ratio_m"].to_numpy(), np.nan), **style)
    low, high = (1e3 * own[f"elapsed_{end}_s"].to_numpy() for end in ("low", "high"))
    elapsed.fill_between(x, low, high, color=style["color"], alpha=_BAND_ALPHA, linewidth=0)
    elapsed.plot(x, 1e3 * own["elapsed_s"].to_numpy(), **style)


def _lay_out(panels: np.ndarray, shares: list[float]) -> None:
    for row, label in enumerate(_ROWS):
        panels[row, 0].set_ylabel(label)
    axes: Axes
    for axes in panels.flat:
        axes.set_xticks(range(len(shares)), [f"{100 * share:g}" for share in shares])
        axes.grid(visible=False, axis="x")
    for axes in panels[0]:
        axes.set_ylim(-3, 103)
    for axes in panels[1:].flat:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(plain_numbers())
    drawn = [line.get_ydata() for axes in panels[1] for line in axes.get_lines()]
    ratios = np.concatenate([*drawn, _RATIO_RANGE])
    panels[1, 0].set_yticks(_RATIO_TICKS)
    panels[1, 0].set_ylim(np.nanmin(ratios) / _MARGIN, np.nanmax(ratios) * _MARGIN)
    panels[1, 0].yaxis.set_minor_locator(NullLocator())
