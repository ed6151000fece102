"""Figure 6: time of the aligners against the number of overlapping points."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.evaluation.criteria import ORACLE
from experiments.evaluation.tables import UNKNOWN
from experiments.reports.figures.result_tables import NothingToDraw, ResultTables
from experiments.reports.figures.style import PAGE_WIDTH_IN, aligner_legend, write_plainly
from experiments.studies.error_bands import TIME_GROUPS, time_bands

READS = ("aligner_timings", "errors", "estimates")

# The line that guides the eye joins the points of one run while they are few, else medians of
# groups of them.
_MAX_JOINED = 16
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
        for name in filter(timed.__contains__, data.aligners):
            known = timed[name][timed[name][column] != UNKNOWN]
            if len(known):
                _add_aligner(axes, data, name, known, column)
        if not axes.lines:
            axes.text(0.5, 0.5, "no truth: unknown", ha="center", transform=axes.transAxes)
        axes.set(xlabel=label, yscale="log")
        write_plainly(axes.yaxis)
    panels[0].set_ylabel("time of one alignment (s)")
    shown = [(n, label) for n, label in data.labels.items() if n in timed or label != n]
    aligner_legend(figure, {label: data.styles[name] for name, label in shown}, columns=5)
    return figure


def _add_aligner(
    axes: Axes, data: ResultTables, name: str, rows: pd.DataFrame, column: str
) -> None:
    style = data.styles[name]
    joined = len(rows) if len(rows) <= _MAX_JOINED and not data.several_runs else TIME_GROUPS
    bands = time_bands(rows, column, joined)
    spread = bands if data.several_runs else rows
    ends = (spread[column], spread["elapsed_low_s"], spread["elapsed_high_s"])
    dots = {"color": style["color"], "marker": style["marker"], "linestyle": "none"}
    if data.several_runs:
        axes.fill_between(*ends, color=style["color"], alpha=0.16, linewidth=0)
        dots |= {"markersize": 1.5, "alpha": 0.3}
    else:
        axes.vlines(*ends, color=style["color"], linewidth=0.5, alpha=0.5, rasterized=True)
        dots |= {"markersize": 2.5, "alpha": 0.6}
    axes.plot(rows[column], rows["elapsed_s"], rasterized=True, **dots)
    zorder = 4 if name == ORACLE else 3
    axes.plot(bands[column], bands["elapsed_s"], label=name, zorder=zorder, **style)
