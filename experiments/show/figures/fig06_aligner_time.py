"""Figure 6: time of the aligners against the number of overlapping points."""

from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.judge.criteria import ORACLE
from experiments.show.figures.result_tables import NothingToDraw, ResultTables
from experiments.show.figures.style import PAGE_WIDTH_IN, aligner_legend, plain_numbers
from experiments.study.statistics.error_bands import TIME_GROUPS, time_bands

# The line that guides the eye joins the points of one run while they are few, else medians of
# groups of them.
_MAX_JOINED = 16
_LEGEND_COLUMNS = 5
_AXES = {
    "n_common": "overlapping points (true common landmarks)",
    "n_correspondences": "correspondences given to the aligner",
}


def draw(data: ResultTables) -> Figure:
    """Medians and 10-90 % of the repeats; beside it the same against the correspondences given.

    Of several runs the points are too many for bars: a band holds 10-90 % of them.
    """
    timings = data.table("aligner_timings").dropna(subset="elapsed_s")
    if timings.empty:
        raise NothingToDraw("no aligner was timed")
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.4))
    panels = figure.subplots(1, 2, sharey=True)
    timed = dict(list(timings.groupby("aligner")))
    for axes, (column, label) in zip(panels, _AXES.items(), strict=True):
        for name in data.aligners:
            if name in timed:
                style = data.styles[name]
                _add_aligner(axes, timed[name], column, style, data.several_runs)
        axes.set_xlabel(label)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(plain_numbers())
    panels[0].set_ylabel("time of one alignment (s)")
    shown = {name: text for name, text in data.labels.items() if name in timed or text != name}
    aligner_legend(figure, shown, data.styles, _LEGEND_COLUMNS)
    return figure


def _add_aligner(
    axes: Axes, rows: pd.DataFrame, column: str, style: dict[str, Any], several_runs: bool
) -> None:
    colour, x = style["color"], rows[column]
    joined = len(rows) if len(rows) <= _MAX_JOINED and not several_runs else TIME_GROUPS
    bands = time_bands(rows, column, joined)
    dots: dict[str, Any]
    if several_runs:
        ends = (bands["elapsed_low_s"], bands["elapsed_high_s"])
        axes.fill_between(bands[column], *ends, color=colour, alpha=0.16, linewidth=0)
        dots = {"markersize": 1.5, "alpha": 0.3}
    else:
        ends = (rows["elapsed_low_s"], rows["elapsed_high_s"])
        axes.vlines(x, *ends, color=colour, linewidth=0.5, alpha=0.5, rasterized=True)
        dots = {"markersize": 2.5, "alpha": 0.6}
    dots |= {"color": colour, "marker": style["marker"], "linestyle": "none"}
    axes.plot(x, rows["elapsed_s"], rasterized=True, **dots)
    name = rows["aligner"].iloc[0]
    zorder = 4 if name == ORACLE else 3
    axes.plot(bands[column], bands["elapsed_s"], label=name, zorder=zorder, **style)
