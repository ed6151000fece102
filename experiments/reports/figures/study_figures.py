"""Figures of the studies: benchmark of aligners, cost of independence, refusal of alignments."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator

from experiments.evaluation.alignment_criteria import MERGEABLE_PAIRS
from experiments.evaluation.tables import UNKNOWN
from experiments.reports.figures import style
from experiments.reports.figures.result_tables import NothingToDraw
from experiments.reports.figures.style import BLACK, GRAY
from experiments.studies.benchmark import crossings
from experiments.studies.independence_trial import STRATEGIES
from experiments.studies.refusal_rates import (
    FEW,
    POSTER_RADII_M,
    VERDICTS,
    Rate,
    mergeable,
    ordinary,
    right_answers,
    share_up_to,
    unchanged_pairs,
    without_common_ground,
)
from mapfusion.align.alignment import Status

# Benchmark
_BAND_ALPHA = 0.14
_DODGE = 0.45  # of the distance between two shares, over which the methods are spread
_MIN_SUCCESSES = 10  # the median error of fewer successes is unreliable
_RATIO_TICKS = (1, 2, 5, 10, 20, 50, 100)
_RATIO_RANGE = (0.9, 11.0)  # smallest range of the axis
_MARGIN = 1.15  # around the values drawn
_ROWS = ("success (%)", "error over the oracle's", "time of one call (ms)")

# Error against the share of false pairs
_LEAST_ERROR_M = 1e-3

# Independence
_HEIGHT_IN = 8.6
# Panels from above: label, column drawn with markers, column of the team's part alone.
_PANELS = (
    ("CPU time (s)", "cpu_s", "team_s"),
    ("peak memory (MB)", "peak_mb", "team_peak_mb"),
    ("sent by all (MB)", "sent_mb", ""),
    ("map, in its frame,\nRMS (mm)", "landmark_rmse_m", ""),
    ("map, after a fit,\nRMS (mm)", "fitted_rmse_m", ""),
    ("paths, after a fit,\nRMS (mm)", "path_rmse_m", ""),
)
_WIDE = 2.2  # points: the line stays visible below another line
_STRATEGY_STYLES: dict[str, dict[str, Any]] = {
    "filters": {"color": style.ORANGE, "linestyle": (0, (1, 1)), "marker": "D"},
    "once": {"color": style.BLUE, "linestyle": "-", "marker": "o", "linewidth": _WIDE},
    "anew": {"color": style.GREEN, "linestyle": (0, (5, 1)), "marker": "^"},
    "together": {"color": style.BLACK, "linestyle": (0, (4, 2)), "marker": "x"},
}
_OF_TEAM: dict[str, Any] = {"linewidth": 0.6, "marker": ""}
_HOLLOW: dict[str, Any] = {"linestyle": "", "markerfacecolor": "white", "zorder": 3}
_TICKS = (1.0, 2.0, 5.0)  # of each decade
_ERROR_TICKS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)  # errors span less than a decade
_MM_PER_M = 1000.0
_LEAST_SPAN = 3.0  # ratio of the ends of a logarithmic axis: keeps differences of a few % small

# Refusal
_THRESHOLDS = np.linspace(-100, 8, 500)  # on log10 of the false alarms
_POSTER_COLOURS = (style.ORANGE, style.VERMILLION, style.PURPLE)
_SUPPORT_OF = "ransac"  # aligner whose number of inliers is swept for comparison
_LEAST_DECADES = 0.5  # shares of zero are drawn this far below one in all pairs
_COLOURS = dict(zip(VERDICTS, (style.BLUE, style.ORANGE, style.PURPLE, style.GRAY), strict=True))
_KIND_IN, _MARGIN_IN = 0.22, 1.3  # height of the bar of one kind, and of the rest of the figure


def draw_benchmark(summary: pd.DataFrame) -> Figure:
    """Draw success, error and time of the aligners, one column for each number of pairs.

    Bands are Wilson's 95 % interval of the success and 10-90 % of the times. The shares of outliers
    are spaced evenly, and the methods are set apart because most lines coincide.
    """
    counts = summary["n_pairs"].unique()
    methods = summary["method"].unique().tolist()
    styles = style.aligner_styles(methods)
    shares = sorted(summary["outlier_share"].unique())
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, 6.6))
    panels = figure.subplots(len(_ROWS), len(counts), sharex=True, sharey="row", squeeze=False)
    ran = summary[summary["status"] != Status.ABSENT].sort_values("outlier_share")
    for column, count in zip(panels.T, counts, strict=True):
        for place, method in enumerate(methods):
            own = ran[(ran["n_pairs"] == count) & (ran["method"] == method)]
            offset = _DODGE * ((place + 0.5) / len(methods) - 0.5)
            x = np.searchsorted(shares, own["outlier_share"]) + offset
            line = styles[method] | {"linewidth": 0.8, "markersize": 2.8}
            success, ratio, elapsed = column
            ends = (100 * own["success_low"], 100 * own["success_high"])
            success.vlines(x, *ends, color=line["color"], linewidth=2.2, alpha=0.35)
            success.plot(x, 100 * own["success"], **line)
            ratio.plot(x, own["ratio_m"].where(own["n_success"] >= _MIN_SUCCESSES), **line)
            ends = (1e3 * own["elapsed_low_s"], 1e3 * own["elapsed_high_s"])
            elapsed.fill_between(x, *ends, color=line["color"], alpha=_BAND_ALPHA, linewidth=0)
            elapsed.plot(x, 1e3 * own["elapsed_s"], **line)
        column[0].set_title(f"{count} pairs")
        column[-1].set_xlabel("outliers (%)")
    axes: Axes
    for row, label in zip(panels, _ROWS, strict=True):
        row[0].set_ylabel(label)
        for axes in row:
            axes.set_xticks(range(len(shares)), [f"{100 * share:g}" for share in shares])
            axes.grid(visible=False, axis="x")
    panels[0, 0].set_ylim(-3, 103)
    for axes in panels[1:].flat:
        axes.set_yscale("log")
        style.write_plainly(axes.yaxis)
    drawn = [line.get_ydata() for axes in panels[1] for line in axes.get_lines()]
    ratios = np.concatenate([*drawn, _RATIO_RANGE])
    panels[1, 0].set_yticks(_RATIO_TICKS)
    panels[1, 0].set_ylim(np.nanmin(ratios) / _MARGIN, np.nanmax(ratios) * _MARGIN)
    panels[1, 0].yaxis.set_minor_locator(NullLocator())
    absent = set(summary["method"][summary["status"] == Status.ABSENT])
    labelled = {f"{m} (absent)" if m in absent else m: styles[m] for m in methods}
    style.aligner_legend(figure, labelled, columns=5)
    return figure


def draw_crossing(rows: pd.DataFrame) -> Figure:
    """Draw the median error against the share of false pairs, a panel per share of unpaired ones.

    Shares are spaced by their rank: the first crossing lies at a few percent. Dotted lines are the
    shares at which the order of SVD and ICP changes.
    """
    unpaired = rows["unpaired_share"].unique()
    methods = rows["method"].unique().tolist()
    styles = style.aligner_styles(methods)
    shares = np.sort(rows["outlier_share"].unique())
    at = crossings(rows, "svd", "icp")
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, 3.2))
    panels = figure.subplots(1, len(unpaired), sharex=True, sharey=True, squeeze=False)[0]
    for axes, of in zip(panels, unpaired, strict=True):
        own = rows[rows["unpaired_share"] == of]
        for method in methods:
            line = own[own["method"] == method].sort_values("outlier_share")
            place = np.searchsorted(shares, line["outlier_share"])
            axes.plot(place, line["error_m"].clip(lower=_LEAST_ERROR_M), **styles[method])
        for share in at[of]:
            place = float(np.interp(share, shares, np.arange(len(shares))))
            axes.axvline(place, color=BLACK, linestyle=":", linewidth=0.8)
            text = {"xytext": (2, -9), "textcoords": "offset points", "fontsize": 7}
            axes.annotate(
                f"{share:.1%}", xy=(place, 1.0), xycoords=("data", "axes fraction"), **text
            )
        axes.set(yscale="log", xlabel="false pairs (%)")
        axes.set_title(f"{of:.0%} of the landmarks without a partner")
        axes.set_xticks(np.arange(len(shares)), [f"{100 * share:g}" for share in shares])
        style.write_plainly(axes.yaxis)
    panels[0].set_ylabel("median translation error (m)")
    style.aligner_legend(figure, {name: styles[name] for name in methods}, 4)
    return figure


def draw_independence(teams: pd.DataFrame, costs: pd.DataFrame) -> Figure:
    """Draw costs and errors of each strategy, one column for each size of team.

    There is a line for each seed. The x axis starts where two maps first have common ground. Thin
    lines are the team's part of the work. Errors are drawn where maps were merged, with hollow
    markers where some robots are missing. "Fused once" and "fused anew" give the same map.
    """
    rows = since_shared_ground(teams, costs)
    sizes = sorted(rows["n_robots"].unique())
    if not sizes:
        raise NothingToDraw("no two robots ever share ground")
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, _HEIGHT_IN))
    panels = figure.subplots(len(_PANELS), len(sizes), sharex="col", sharey="row", squeeze=False)
    for size, column in zip(sizes, panels.T, strict=True):
        of_size = rows[rows["n_robots"] == size]
        for strategy in STRATEGIES:
            line = _STRATEGY_STYLES[strategy.name]
            for _, own in of_size[of_size["strategy"] == strategy.name].groupby("seed"):
                part = own[own["n_merged"] < own["n_robots"]]
                for (_, bold, thin), axes in zip(_PANELS, column, strict=True):
                    unit = _MM_PER_M if _is_error(bold) else 1.0
                    axes.plot(own["since"], own[bold] * unit, **line)
                    if thin:
                        axes.plot(own["since"], own[thin], **line | _OF_TEAM)
                    if _is_error(bold):
                        axes.plot(part["since"], part[bold] * unit, **line | _HOLLOW)
        for axes in column:
            axes.axvline(0.0, color=GRAY, linewidth=0.8)
            axes.set_yscale("log")
        column[0].set_title(f"{size} robots")
        column[-1].set_xlabel("iterations since robots first share ground")
        column[-1].xaxis.set_major_locator(MaxNLocator(6, integer=True))
    for (label, bold, _), row in zip(_PANELS, panels, strict=True):
        axes = row[0]  # the other panels of the row share its axis
        axes.set_ylabel(label)
        axes.yaxis.set_major_locator(LogLocator(subs=_ERROR_TICKS if _is_error(bold) else _TICKS))
        axes.yaxis.set_major_formatter(style.plain_numbers())
        axes.yaxis.set_minor_formatter(NullFormatter())
        low, high = axes.get_ylim()
        wider = np.sqrt(max(1.0, _LEAST_SPAN / (high / low)))
        axes.set_ylim(low / wider, high * wider)
    styles = {strategy.label: _STRATEGY_STYLES[strategy.name] for strategy in STRATEGIES}
    thin = Line2D([], [], color=BLACK, label="the team's part alone", **_OF_TEAM)
    style.aligner_legend(figure, styles, 3, [thin])
    return figure


def since_shared_ground(teams: pd.DataFrame, costs: pd.DataFrame) -> pd.DataFrame:
    """Join both tables and leave out teams that never share ground.

    Further columns: `since` (iterations since the first shared ground, negative before), `team_s`,
    `cpu_s` (with the work of the robots), `peak_mb` (larger value of robots and team).
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


def draw_refusal(refusals: pd.DataFrame, calibration: pd.DataFrame, false_alarms: float) -> Figure:
    """Draw false against missed merges, the shares accepted, and the calibration.

    Only worlds without repetition are drawn; at least one is required.
    """
    refusals = ordinary(refusals)
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, 6.2))
    (curve, rates), (calibrated, key) = figure.subplots(2, 2)
    first = refusals["aligner"].iloc[0]
    _draw_roc_curves(curve, refusals)
    # For comparison: the curve of a threshold on the number of inliers.
    own = refusals[refusals["aligner"] == _SUPPORT_OF]
    label = f"{_SUPPORT_OF}, number of inliers alone"
    line = {"color": GRAY, "linestyle": ":", "label": label}
    _draw_sweep(curve, own.assign(score=-own["n_inliers"]), _floor(refusals), **line)
    # Share accepted by the first aligner against the threshold, by kind of ground
    own = refusals[refusals["aligner"] == first]
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
            accepted = share_up_to(rows["log10_false_alarms"], _THRESHOLDS)
            line = {"color": colour, "linestyle": dashes, "label": f"{label} ({len(rows)})"}
            rates.plot(_THRESHOLDS, accepted, **line)
    rates.set_xlabel("threshold on log10 of the false alarms")
    rates.set_ylabel(f"share accepted, {first}")
    # Measured against stated number of false alarms
    stated, measured = calibration["stated"], calibration["motions_a_pair"]
    n = int(calibration["n_pairs"].iloc[0])
    upper = [Rate(k, n).interval[1] for k in calibration["n_accepted"]]
    calibrated.plot(stated, stated, color=GRAY, linewidth=0.8, label="stated")
    found = measured > 0
    calibrated.plot(stated[found], measured[found], color=BLACK, marker="o", label="measured")
    label = "pairs of maps with one, upper 97.5 %"
    calibrated.plot(stated, upper, color=BLACK, linestyle=":", label=label)
    calibrated.set(xscale="log", yscale="log", xlabel="false alarms stated, a pair of maps")
    calibrated.set_ylabel(f"measured on {n} pairs of random maps")
    calibrated.legend(loc="upper left")
    for axes, threshold in ((rates, np.log10(false_alarms)), (calibrated, false_alarms)):
        axes.axvline(threshold, color=GRAY, linewidth=0.8)
    legend = {"loc": "outside upper center", "ncols": 4, "handlelength": 2.6}
    figure.legend(*curve.get_legend_handles_labels(), **legend)
    key.set_axis_off()
    legend = {"loc": "upper left", "title": f"Above: {first} (pairs of maps)", "alignment": "left"}
    key.legend(*rates.get_legend_handles_labels(), **legend)
    return figure


def draw_refusal_kinds(refusals: pd.DataFrame) -> Figure:
    """Draw the verdicts on right and on wrong answers, by kind of world, all methods together."""
    rows = unchanged_pairs(refusals)
    right, wrong = right_answers(rows), rows[rows["beats_chance"] & ~rows["right"]]
    kinds = sorted(rows["kind"].unique())[::-1]
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, _MARGIN_IN + _KIND_IN * len(kinds)))
    panels = figure.subplots(1, 2, sharey=True)
    titles = (f"right, {MERGEABLE_PAIRS} or more true pairs", "wrong, though more than chance")
    for axes, own, title in zip(panels, (right, wrong), titles, strict=True):
        # A bar for each kind of world, followed by the number of answers
        table = pd.crosstab(own["kind"], own["verdict"]).reindex(
            index=kinds, columns=list(VERDICTS), fill_value=0
        )
        n = table.sum(axis=1)
        left = np.zeros(len(kinds))
        for verdict in VERDICTS:
            share = (100 * table[verdict] / n.clip(lower=1)).to_numpy()
            colour = _COLOURS[verdict]
            axes.barh(kinds, share, left=left, color=colour, label=verdict, height=0.75)
            left += share
        for place, count in enumerate(n):
            axes.text(101, place, f"{count}", va="center", fontsize=6.5, clip_on=False)
        axes.grid(visible=False)
        axes.set(title=title, xlabel="share of answers (%)", xlim=(0, 100))
    handles, labels = panels[0].get_legend_handles_labels()
    shown = [label.replace("_", " ") for label in labels]
    figure.legend(handles, shown, loc="outside upper center", ncols=len(VERDICTS))
    return figure


def draw_refusal_roc(refusals: pd.DataFrame) -> Figure:
    """Draw false against missed merges as the number of false alarms moves.

    The panels show ordinary worlds and worlds with repetition.
    """
    worlds = {
        "ordinary worlds": ordinary(refusals),
        "worlds that repeat themselves": refusals[refusals["repeats"]],
    }
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, 3.7))
    panels = figure.subplots(1, 2)
    for axes, (title, own) in zip(panels, worlds.items(), strict=True):
        if len(own):
            _draw_roc_curves(axes, own)
        axes.set_title(title)
    labelled = [axes.get_legend_handles_labels() for axes in panels]
    legend = {"loc": "outside upper center", "ncols": 5, "handlelength": 3.2}
    figure.legend(*max(labelled, key=lambda both: len(both[1])), **legend)
    return figure


def _draw_roc_curves(axes: Axes, refusals: pd.DataFrame) -> None:
    """Draw false against missed merges for each method, as the number of false alarms moves.

    A point with Wilson intervals marks the threshold in use.
    """
    floor = _floor(refusals)
    scored = refusals.assign(score=refusals["log10_false_alarms"])
    styles = style.aligner_styles(refusals["aligner"].unique().tolist())
    for name, own in scored.groupby("aligner", sort=False):
        line = styles[str(name)] | {"marker": None, "label": name}
        _draw_sweep(axes, own, floor, **line)
        rates = (
            Rate.of(without_common_ground(own)["accepted"]),
            Rate.of(~mergeable(own)["accepted"]),
        )
        point = np.maximum([rate.share for rate in rates], floor)
        for axis, rate in enumerate(rates):
            ends = np.tile(point, (2, 1))
            low, high = np.clip(rate.interval, floor[0] / 2, None)
            ends[:, axis] = min(low, point[axis]), high
            axes.plot(*ends.T, color=line["color"], linewidth=3, alpha=0.35)
        in_use = {"color": line["color"], "markeredgecolor": BLACK, "clip_on": False, "zorder": 5}
        axes.plot(*point, marker="o", **in_use)
    axes.set(xscale="log", yscale="log", xlim=(floor[0] / 1.3, 1.3), ylim=(floor[1] / 1.3, 1.3))
    axes.set_xlabel("false merges: no common ground (left edge: none)")
    axes.set_ylabel(f"missed merges: {MERGEABLE_PAIRS}+ true pairs (bottom: none)")
    for axis in (axes.xaxis, axes.yaxis):
        style.write_plainly(axis)


def _floor(refusals: pd.DataFrame) -> np.ndarray:
    """Return the positions at which shares of zero (false, missed) are drawn, shape (2,)."""
    n_of_all = np.array([len(rows(refusals)) for rows in (without_common_ground, mergeable)])
    n_pairs = np.maximum(n_of_all / refusals["aligner"].nunique(), 1)
    return 10**-_LEAST_DECADES / n_pairs


def _draw_sweep(axes: Axes, own: pd.DataFrame, floor: np.ndarray, **line: Any) -> None:
    """Draw false against missed merges as the threshold on the column `score` moves."""
    thresholds = np.unique(own["score"].dropna())
    false = share_up_to(without_common_ground(own)["score"], thresholds)
    found = share_up_to(mergeable(own)["score"], thresholds)
    axes.plot(np.maximum(false, floor[0]), np.maximum(1 - found, floor[1]), **line)
