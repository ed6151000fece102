"""Figure 6: time of the aligners against the number of overlapping points."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.judge.metrics import ORACLE
from experiments.show.figures.error_curves import BAND
from experiments.show.figures.result_tables import NothingToDraw, ResultTables
from experiments.show.figures.runs_tables import RunsTables
from experiments.show.figures.style import PAGE_WIDTH_IN, aligner_styles, plain_numbers

# The line that guides the eye joins the points of one run while they are few, else medians of so
# many groups.
_MAX_JOINED = 16
_GROUPS = 8
_LEGEND_COLUMNS = 5


def draw(data: ResultTables | RunsTables) -> Figure:
    """Medians and 10-90 % of the repeats; beside it the same against the correspondences given.

    Of several runs the points are too many for bars: a band holds 10-90 % of them.
    """
    timings = data.table("aligner_timings").dropna(subset="elapsed_s")
    if timings.empty:
        raise NothingToDraw("no aligner was timed")
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.4))
    panels = figure.subplots(1, 2, sharey=True)
    found = set(timings["aligner"])
    names = [name for name in data.aligners if name in found]
    for axes, column, label in (
        (panels[0], "n_common", "overlapping points (true common landmarks)"),
        (panels[1], "n_correspondences", "correspondences given to the aligner"),
    ):
        for name in names:
            rows = timings[timings["aligner"] == name]
            _add_aligner(axes, rows, column, data.aligners, isinstance(data, RunsTables))
        axes.set_xlabel(label)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(plain_numbers())
    panels[0].set_ylabel("time of one alignment (s)")
    styles = aligner_styles(data.aligners)
    shown = [name for name in data.aligners if name in found or data.label_of(name) != name]
    handles = [Line2D([], [], label=data.label_of(name), **styles[name]) for name in shown]
    columns = min(len(handles), _LEGEND_COLUMNS)
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, handlelength=3.2)
    return figure


def _add_aligner(
    axes: Axes, rows: pd.DataFrame, column: str, aligners: list[str], several_runs: bool
) -> None:
    name = rows["aligner"].iloc[0]
    style = aligner_styles(aligners)[name]
    count, elapsed = rows[column].to_numpy(), rows["elapsed_s"].to_numpy()
    groups = len(count) if len(count) <= _MAX_JOINED and not several_runs else _GROUPS
    if several_runs:
        middle, low = binned_quantiles(count, elapsed, groups, BAND[0])
        _, high = binned_quantiles(count, elapsed, groups, BAND[1])
        axes.fill_between(middle, low, high, color=style["color"], alpha=0.16, linewidth=0)
    else:
        axes.vlines(
            count,
            rows["elapsed_low_s"],
            rows["elapsed_high_s"],
            color=style["color"],
            linewidth=0.5,
            alpha=0.5,
            rasterized=True,
        )
    axes.plot(
        count,
        elapsed,
        color=style["color"],
        marker=style["marker"],
        linestyle="none",
        markersize=1.5 if several_runs else 2.5,
        alpha=0.3 if several_runs else 0.6,
        rasterized=True,
    )
    guide = binned_quantiles(count, elapsed, groups)
    axes.plot(*guide, label=name, zorder=4 if name == ORACLE else 3, **style)


def binned_quantiles(
    count: np.ndarray, elapsed_s: np.ndarray, groups: int, quantile: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Median counts and quantiles of the times of groups of about equal size along the count.

    Ties are never split.
    """
    rank = pd.Series(count).rank(pct=True).to_numpy()
    frame = pd.DataFrame({"group": np.ceil(rank * groups), "count": count, "elapsed": elapsed_s})
    grouped = frame.groupby("group")
    return grouped["count"].median().to_numpy(), grouped["elapsed"].quantile(quantile).to_numpy()
