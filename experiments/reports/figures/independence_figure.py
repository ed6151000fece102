"""Figure of the study `independence`: costs and errors since robots first share ground."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from experiments.evaluation.tables import UNKNOWN
from experiments.reports.figures import style
from experiments.reports.figures.result_tables import NothingToDraw
from experiments.studies.independence.independence_trial import STRATEGIES

_HEIGHT_IN = 8.6
# Panels from above: label, the column drawn with markers, and what of it is the team's alone.
_PANELS = (
    ("CPU time (s)", "cpu_s", "team_s"),
    ("peak memory (MB)", "peak_mb", "team_peak_mb"),
    ("sent by all (MB)", "sent_mb", ""),
    ("map, in its frame,\nRMS (mm)", "landmark_rmse_m", ""),
    ("map, after a fit,\nRMS (mm)", "fitted_rmse_m", ""),
    ("paths, after a fit,\nRMS (mm)", "path_rmse_m", ""),
)
_LOOKS: dict[str, tuple[Any, ...]] = {
    "filters": (style.ORANGE, (0, (1, 1)), "D"),
    "once": (style.BLUE, "-", "o"),
    "anew": (style.GREEN, (0, (5, 1)), "^"),
    "together": (style.BLACK, (0, (4, 2)), "x"),
}
_WIDE = 2.2  # points, of what another line may lie upon
_OF_TEAM: dict[str, Any] = {"linewidth": 0.6, "marker": ""}
_HOLLOW: dict[str, Any] = {"linestyle": "", "markerfacecolor": "white", "zorder": 3}
_TICKS = (1.0, 2.0, 5.0)  # of each decade, and more where an axis spans less than one
_MANY_TICKS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
_MM_A_M = 1000.0
_LEAST_SPAN = 3.0  # of a logarithmic axis, end over end: differences of a few per cent stay small


def draw(teams: pd.DataFrame, costs: pd.DataFrame) -> Figure:
    """A column for each size of team, a line for each strategy and seed; logarithmic axes.

    Zero is where two robots' maps first have common ground. Thin: the team's part of the work
    alone. Errors are drawn where robots' maps were merged, hollow where not those of all robots.
    Fused once and fused anew give the same map.
    """
    rows = since_shared_ground(teams, costs)
    sizes = sorted(rows["n_robots"].unique())
    if not sizes:
        raise NothingToDraw("no two robots ever share ground")
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, _HEIGHT_IN))
    panels = figure.subplots(len(_PANELS), len(sizes), sharex="col", sharey="row", squeeze=False)
    for size, column in zip(sizes, panels.T, strict=True):
        for (_, bold, thin), axes in zip(_PANELS, column, strict=True):
            _add_lines(axes, rows[rows["n_robots"] == size], bold, thin)
        column[0].set_title(f"{size} robots")
        column[-1].set_xlabel("iterations since robots first share ground")
        column[-1].xaxis.set_major_locator(MaxNLocator(6, integer=True))
    for (label, bold, _), row in zip(_PANELS, panels, strict=True):
        _finish(row[0], label, _MANY_TICKS if _is_error(bold) else _TICKS)
    looks = {strategy.label: _look(strategy.name) for strategy in STRATEGIES}
    thin = Line2D([], [], color=style.BLACK, label="the team's part alone", **_OF_TEAM)
    style.aligner_legend(figure, looks, 3, [thin])
    return figure


def since_shared_ground(teams: pd.DataFrame, costs: pd.DataFrame) -> pd.DataFrame:
    """Both tables, joined, with what is drawn; without teams that never share ground.

    Columns beside theirs: since (iterations since the first shared ground, negative before),
    team_s, cpu_s (with the robots' own work), peak_mb (of whichever needs more).
    """
    keys = ["scenario", "seed", "n_robots", "strategy", "iteration"]
    rows = teams.merge(costs, "left", keys)
    rows = rows[rows["first_shared"] != UNKNOWN]
    team_s = rows["alignment_s"] + rows["fusion_s"]
    return rows.assign(
        since=rows["iteration"] - rows["first_shared"],
        team_s=team_s,
        cpu_s=rows["filter_s"] + rows["smoothing_s"] + team_s,
        peak_mb=rows[["robot_peak_mb", "team_peak_mb"]].max(axis=1),
    )


def _is_error(column: str) -> bool:
    return column.endswith("rmse_m")


def _look(name: str) -> dict[str, Any]:
    look = dict(zip(("color", "linestyle", "marker"), _LOOKS[name], strict=True))
    return look | ({"linewidth": _WIDE} if name == "once" else {})


def _add_lines(axes: Axes, rows: pd.DataFrame, bold: str, thin: str) -> None:
    for strategy in STRATEGIES:
        mine, look = rows[rows["strategy"] == strategy.name], _look(strategy.name)
        for _, own in mine.groupby("seed"):
            axes.plot(own["since"], own[bold] * (_MM_A_M if _is_error(bold) else 1.0), **look)
            if thin:
                axes.plot(own["since"], own[thin], **look | _OF_TEAM)
            part = own[own["n_merged"] < own["n_robots"]]
            if _is_error(bold):
                axes.plot(part["since"], part[bold] * _MM_A_M, **look | _HOLLOW)
    axes.axvline(0.0, color=style.GRAY, linewidth=0.8)
    axes.set_yscale("log")


def _finish(axes: Axes, label: str, ticks: Sequence[float]) -> None:
    """The first of a row, whose axis the others share."""
    axes.set_ylabel(label)
    axes.yaxis.set_major_locator(LogLocator(subs=ticks))
    axes.yaxis.set_major_formatter(style.plain_numbers())
    axes.yaxis.set_minor_formatter(NullFormatter())
    low, high = axes.get_ylim()
    wider = np.sqrt(max(1.0, _LEAST_SPAN / (high / low)))
    axes.set_ylim(low / wider, high * wider)
