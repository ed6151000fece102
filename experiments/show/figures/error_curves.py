"""Errors against the iteration, for all aligners and robot pairs: figures 4 and 5."""

from collections.abc import Callable

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.judge.metrics import ORACLE
from experiments.show.figures.result_tables import NothingToDraw, Pair, ResultTables, of_pair
from experiments.show.figures.runs_tables import RunsTables
from experiments.show.figures.style import BLUE, PAGE_WIDTH_IN, PALE_GRAY, aligner_styles
from mapfusion.se2 import Float

BAND = (0.1, 0.9)  # quantiles of the repetitions, or of the runs where there are several
MIN_TRUE_PAIRS = 3  # below, even the oracle has hardly anything to go by
_PANEL_HEIGHT_IN = 1.9
_EXTRA_HEIGHT_IN = 0.9  # legend and the common x label
_MARKERS_PER_LINE = 8
_LEGEND_COLUMNS = 4
_BAND_ALPHA = 0.16
# Bands, and lines of more points, are drawn as pixels: evaluated at each iteration, their outlines
# alone would make an SVG of megabytes.
_MAX_VECTOR_POINTS = 200


def draw_error_curves(
    data: ResultTables | RunsTables,
    columns: tuple[str, str],
    label: str,
    note: str,
    scale: Callable[[Axes, Float], None],
) -> Figure:
    """One row of panels per robot pair: as estimated on the left, refined on the right.

    Args:
        data: the result, or several runs.
        columns: columns of the `errors` table, as estimated and refined.
        label: the y axis' label, with its unit.
        note: a line below the x axis; may be empty.
        scale: sets the y axis' scale and limits from all values drawn.
    """
    if not data.pairs:
        raise NothingToDraw("no robot pair was aligned")
    errors = data.table("errors")
    summaries = [summarise(errors, column) for column in columns]
    shown = [summary[["low", "median", "high"]].to_numpy().ravel() for summary in summaries]
    drawn = np.concatenate(shown)
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):
        raise NothingToDraw("no aligner found an estimate at any iteration")
    n_pairs = len(data.pairs)
    figure = Figure(figsize=(PAGE_WIDTH_IN, n_pairs * _PANEL_HEIGHT_IN + _EXTRA_HEIGHT_IN))
    panels = figure.subplots(n_pairs, 2, sharex=True, sharey=True, squeeze=False)
    for row, pair in enumerate(data.pairs):
        for column, kind in enumerate(("as estimated", "refined")):
            axes = panels[row, column]
            _shade_scarce(axes, of_pair(errors, pair))
            _draw_panel(axes, summaries[column], pair, data.aligners)
            axes.set_title(f"{pair[0]} - {pair[1]}, {kind}")
        panels[row, 0].set_ylabel(label)
    scale(panels[0, 0], drawn)
    figure.supxlabel("FastSLAM iteration k" + (f"\n{note}" if note else ""), fontsize=8)
    _add_legend(figure, data)
    return figure


def summarise(errors: pd.DataFrame, column: str) -> pd.DataFrame:
    """Median and band over the repetitions (of several runs: over the runs) with an estimate.

    Returns:
        Columns robot_a, robot_b, aligner, iteration, low, median, high; NaN where none did.
    """
    by = ["robot_a", "robot_b", "aligner", "iteration"]
    groups = errors.groupby(by)[column]
    return pd.DataFrame(
        {
            "low": groups.quantile(BAND[0]),
            "median": groups.median(),
            "high": groups.quantile(BAND[1]),
        }
    ).reset_index()


def _draw_panel(axes: Axes, summary: pd.DataFrame, pair: Pair, aligners: list[str]) -> None:
    styles = aligner_styles(aligners)
    curves = of_pair(summary, pair)
    for place, name in enumerate(aligners):
        curve = curves[curves["aligner"] == name]
        iteration = curve["iteration"].to_numpy()
        axes.fill_between(
            iteration,
            curve["low"].to_numpy(),
            curve["high"].to_numpy(),
            color=styles[name]["color"],
            alpha=_BAND_ALPHA,
            linewidth=0,
            zorder=1,
            rasterized=True,
        )
        step = max(1, len(curve) // _MARKERS_PER_LINE)
        axes.plot(
            iteration,
            curve["median"].to_numpy(),
            label=name,
            markevery=(place * step // len(aligners), step),
            zorder=3 if name == ORACLE else 2,
            rasterized=len(curve) > _MAX_VECTOR_POINTS,
            **styles[name],
        )


def _shade_scarce(axes: Axes, errors: pd.DataFrame) -> None:
    """Shade the iterations with fewer than MIN_TRUE_PAIRS true pairs, out to half way between.

    All rows of one run agree on their number; of several runs the median counts.
    """
    n_true = errors.groupby("iteration")["n_true"].median()
    iteration = n_true.index.to_numpy(dtype=np.float64)
    half = np.diff(iteration) / 2 if len(iteration) > 1 else np.array([0.5])
    start = iteration - np.concatenate([half[:1], half])[: len(iteration)]
    stop = iteration + np.concatenate([half, half[-1:]])[: len(iteration)]
    scarce = n_true.to_numpy() < MIN_TRUE_PAIRS
    edges = np.flatnonzero(np.diff(np.concatenate([[False], scarce, [False]]).astype(int)))
    for first, end in edges.reshape(-1, 2):
        axes.axvspan(
            float(start[first]),
            float(stop[end - 1]),
            color=PALE_GRAY,
            alpha=0.5,
            linewidth=0,
            zorder=0,
        )


def _add_legend(figure: Figure, data: ResultTables | RunsTables) -> None:
    styles = aligner_styles(data.aligners)
    handles: list[Line2D | Patch] = []
    for name in data.aligners:
        handles.append(Line2D([], [], label=data.label_of(name), **styles[name]))
    handles.append(
        Patch(color=BLUE, alpha=_BAND_ALPHA, linewidth=0, label=f"10-90 % of {data.bands_over}")
    )
    handles.append(
        Patch(color=PALE_GRAY, alpha=0.5, linewidth=0, label=f"< {MIN_TRUE_PAIRS} true pairs")
    )
    figure.legend(
        handles=handles, loc="outside upper center", ncols=_LEGEND_COLUMNS, handlelength=3.2
    )
