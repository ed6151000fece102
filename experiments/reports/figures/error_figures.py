"""Figures of measured errors and times: aligners (4 to 6), fusers (11, 12) and teams (13)."""

import math
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    PercentFormatter,
)

from experiments.evaluation.adoption import NO_TEAM
from experiments.evaluation.alignment_criteria import ANSWERABLE_PAIRS, ORACLE
from experiments.evaluation.map_errors import FILTERED, FUSED, SMOOTHED
from experiments.evaluation.tables import UNKNOWN
from experiments.reports.figures.result_tables import (
    NothingToDraw,
    ResultTables,
    of_pair,
)
from experiments.reports.figures.style import (
    BLACK,
    BLUE,
    GIVEN_STYLES,
    GRAY,
    GREEN,
    ORANGE,
    PAGE_WIDTH_IN,
    PALE_GRAY,
    VERMILLION,
    aligner_legend,
    fuser_styles,
    plain_numbers,
    write_plainly,
)
from experiments.studies.statistics import TIME_GROUPS, error_bands, scarce_spans, time_bands
from mapfusion.fusion.fusers import name_order

# Figures 4 and 5
_PANEL_HEIGHT_IN, _EXTRA_HEIGHT_IN = 1.9, 0.9  # the latter for legend and common x label
_MOST_PAIRS = 10  # gives a figure of half a metre; 190 pairs would take minutes to draw
_MARKERS_PER_LINE = 8
_BAND_STYLE = {"alpha": 0.16, "linewidth": 0}
_SCARCE_STYLE = {"color": PALE_GRAY, "alpha": 0.5, "linewidth": 0}
# Bands and long lines are drawn as pixels: with one point per iteration, their outlines alone would
# make an SVG of megabytes.
_MAX_VECTOR_POINTS = 200
_HEADROOM = 1.3  # ratio of the end of an axis to the largest value
_FLOOR_M = 1e-4  # a tenth of a millimetre: smaller errors do not matter to a robot
# The axis is linear up to here and logarithmic beyond: good alignments err by a few thousandths of
# a radian, bad ones by tenths or more, and both must be legible.
_LINEAR_RAD = 0.001
# Lines that coincide stay visible: each is drawn above the one before, and narrower.
_WIDEST, _NARROWEST = 3.2, 0.9  # points
_ROTATION_NOTE = f"""FastSLAM iteration k
error = estimate - truth, counter-clockwise positive (the paper's sign is the opposite); \
axis linear within ±{_LINEAR_RAD} rad"""

# Figure 6. A line joins the points of one run while they are few, else medians of groups of points.
_MAX_JOINED = 16
_BARS_APART = 0.02  # width of the bars of all aligners beside each other, as a share of the axis
_TIME_AXES = {
    "n_common": "overlapping points (true common landmarks)",
    "n_correspondences": "correspondences given to the aligner",
}

# Figure 11. Panels: title, column drawn with markers, column drawn as a thin line.
_ERRORS = (
    ("in the frame of the first robot", "landmark_rmse_m", ""),
    ("after the best rigid fit", "fitted_rmse_m", "fitted_median_m"),
)
_WIDTHS = (3, 3, 2)  # of two panels of errors and one of the share of gross landmarks
_MEDIAN: dict[str, Any] = {"linewidth": 0.6, "marker": ".", "markersize": 2.0}
_TICKS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # of each decade
_LEAST_TOP = 0.01  # of the axis of shares: a single landmark of hundreds must not fill the panel

# Figure 12
_COVERAGE_PANELS = {
    "coverage": "each map after its best rigid fit",
    "frame_coverage": "each map in its own frame",
}
_BEFORE = {FILTERED: "FastSLAM's maps, before", SMOOTHED: "smoothed maps, before"}
_DIAGONAL: dict[str, Any] = {"color": PALE_GRAY, "linewidth": 2.5, "zorder": 1}


# Figure 13. Paths of a robot: column, label and style.
_TEAM_PATHS: dict[str, tuple[str, dict[str, Any]]] = {
    "alone_path_rmse_m": ("independent robot", {"color": GRAY, "linestyle": "--", "marker": "v"}),
    "smoothed_path_rmse_m": ("smoother of its log", {"color": ORANGE, "marker": "P"}),
    "path_rmse_m": ("in the joint map", {"color": BLUE, "marker": "o"}),
}
_TEAM_EVENTS: dict[str, dict[str, Any]] = {
    "adopted": {"color": GREEN, "linewidth": 0.8},
    "dropped": {"color": VERMILLION, "linewidth": 0.8},
}
_MOST_ROBOTS = 8  # gives a figure of half a metre
_ROBOTS_A_ROW = 2


def draw_translation_error(data: ResultTables) -> Figure:
    """Draw the translation error against the iteration, a row per robot pair, log axis.

    Lines are medians; bands hold 10-90 % of the repetitions or of the runs.
    """
    figure, drawn = _draw_error_curves(data, "translation_error_m", "translation error (m)")
    axes = figure.axes[0]
    axes.set_yscale("log", nonpositive="clip")
    write_plainly(axes.yaxis)
    # The axis begins at a power of ten, whose tick has a number.
    lowest = max(drawn.min(), _FLOOR_M) / _HEADROOM
    highest = max(drawn.max(), 2 * _FLOOR_M) * _HEADROOM
    axes.set_ylim(10.0 ** math.floor(math.log10(lowest)), highest)
    return figure


def draw_rotation_error(data: ResultTables) -> Figure:
    """Draw the signed rotation error against the iteration, as `draw_translation_error` does."""
    figure, drawn = _draw_error_curves(data, "rotation_error_rad", "rotation error (rad)")
    axes = figure.axes[0]
    axes.set_yscale("symlog", linthresh=_LINEAR_RAD, linscale=1.0)
    axes.yaxis.set_major_formatter(plain_numbers())
    largest = _HEADROOM * max(np.abs(drawn).max(), _LINEAR_RAD)
    axes.set_ylim(-largest, largest)
    figure.supxlabel(_ROTATION_NOTE, fontsize=8)
    return figure


def _draw_error_curves(data: ResultTables, quantity: str, label: str) -> tuple[Figure, np.ndarray]:
    """Draw one row of panels per robot pair: as estimated, refined, and refined on smoothed maps.

    If there are many pairs, only those with the most true pairs are drawn, and a note says so.

    Args:
        data: tables of the result.
        quantity: column of the table `errors`.
        label: label of the y axis.

    Returns:
        The figure, and all finite values drawn, for the limits of the shared y axis.
    """
    if not data.pairs:
        raise NothingToDraw("no robot pair was aligned")
    if data.no_truth:
        raise NothingToDraw("no truth: errors are unknown")
    errors = data.table("errors")
    pairs = data.pairs
    if len(pairs) > _MOST_PAIRS:
        most = errors.groupby(["robot_a", "robot_b"])["n_true"].max()
        chosen = sorted(pairs, key=lambda pair: most[pair], reverse=True)[:_MOST_PAIRS]
        pairs = [pair for pair in pairs if pair in chosen]
    errors = errors[pd.MultiIndex.from_frame(errors[["robot_a", "robot_b"]]).isin(pairs)]
    bands = error_bands(errors)
    kinds = {"as estimated": (bands, quantity), "refined": (bands, f"refined_{quantity}")}
    smoothed = data.rows("smoothed_errors")
    smoothed = smoothed[pd.MultiIndex.from_frame(smoothed[["robot_a", "robot_b"]]).isin(pairs)]
    if len(smoothed):
        kinds["refined, smoothed maps"] = (error_bands(smoothed), f"refined_{quantity}")
    ends = ("_low", "", "_high")
    parts = [own[f"{column}{end}"].to_numpy() for own, column in kinds.values() for end in ends]
    drawn = np.concatenate(parts)
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):
        raise NothingToDraw("no aligner found an estimate at any iteration")
    figure = Figure(figsize=(PAGE_WIDTH_IN, len(pairs) * _PANEL_HEIGHT_IN + _EXTRA_HEIGHT_IN))
    panels = figure.subplots(len(pairs), len(kinds), sharex=True, sharey=True, squeeze=False)
    for row, pair in zip(panels, pairs, strict=True):
        for axes, (kind, (own, column)) in zip(row, kinds.items(), strict=True):
            for start, stop in scarce_spans(of_pair(errors, pair)):
                axes.axvspan(start, stop, zorder=0, **_SCARCE_STYLE)
            _draw_panel(axes, data, of_pair(own, pair), column)
            axes.set_title(f"{pair[0]} - {pair[1]}, {kind}")
        row[0].set_ylabel(label)
    left_out = len(data.pairs) > len(pairs)
    note = f"\n({len(pairs)} of {len(data.pairs)} robot pairs: those with the most true pairs)"
    figure.supxlabel(f"FastSLAM iteration k{note if left_out else ''}", fontsize=8)
    over = f"{errors['run_id'].nunique()} runs" if data.several_runs else "repetitions"
    explained = []
    if any(len(list(scarce_spans(of_pair(errors, pair)))) for pair in pairs):
        explained.append(Patch(label=f"< {ANSWERABLE_PAIRS} true pairs", **_SCARCE_STYLE))
    # Bands are visible only for aligners whose repetitions, or runs, differ.
    compared = (quantity, f"refined_{quantity}")
    wide = [bands[f"{column}_high"] > bands[f"{column}_low"] for column in compared]
    if banded := set(bands["aligner"][np.any(wide, axis=0)]):
        shown = next(name for name in data.aligners if name in banded)
        colour = data.styles[shown]["color"]
        label = f"10-90 % of {over}, as here {shown}'s"
        explained.insert(0, Patch(color=colour, label=label, **_BAND_STYLE))
    styles = {label: data.styles[name] for name, label in data.labels.items()}
    aligner_legend(figure, styles, 4, explained)
    return figure, drawn


def _draw_panel(axes: Axes, data: ResultTables, bands: pd.DataFrame, column: str) -> None:
    """Draw medians and bands of one quantity for all aligners."""
    shown = [f"{column}_low", column, f"{column}_high"]
    curves = dict(iter(bands.sort_values("iteration").groupby("aligner")))
    widths = np.linspace(_WIDEST, _NARROWEST, len(data.aligners))
    for place, name in enumerate(data.aligners):
        curve = curves.get(name, bands[:0])
        iteration = curve["iteration"].to_numpy()
        low, middle, high = curve[shown].to_numpy().T
        band = {"color": data.styles[name]["color"], "zorder": 1, "rasterized": True}
        axes.fill_between(iteration, low, high, **band, **_BAND_STYLE)
        step = max(1, len(curve) // _MARKERS_PER_LINE)
        line = data.styles[name] | {
            "label": name,
            "markevery": (place * step // len(data.aligners), step),
            "linewidth": widths[place],
            "zorder": 2 + 0.01 * place,
            "rasterized": len(curve) > _MAX_VECTOR_POINTS,
        }
        axes.plot(iteration, middle, **line)


def draw_aligner_time(data: ResultTables) -> Figure:
    """Draw the time of the aligners against the overlap and against the correspondences.

    Bars hold 10-90 % of the repeats. Several runs have too many points for bars: a band holds
    10-90 % of them.
    """
    timings = data.table("aligner_timings").dropna(subset="elapsed_s")
    if timings.empty:
        raise NothingToDraw("no aligner was timed")
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.4))
    panels = figure.subplots(1, 2, sharey=True)
    timed = dict(list(timings.groupby("aligner")))
    shown = list(filter(timed.__contains__, data.aligners))
    for axes, (column, label) in zip(panels, _TIME_AXES.items(), strict=True):
        # The bars of the aligners are set apart, since they are timed on the same maps.
        step = _BARS_APART * float(timings[column].max()) / max(len(shown), 1)
        for place, name in enumerate(shown):
            known = timed[name][timed[name][column] != UNKNOWN]
            if known.empty:
                continue
            style, several = data.styles[name], data.several_runs
            joined = len(known) if len(known) <= _MAX_JOINED and not several else TIME_GROUPS
            bands = time_bands(known, column, joined)
            spread = bands if several else known
            shift = 0.0 if several else step * (place - (len(shown) - 1) / 2)
            at = spread[column] + shift
            ends = (at, spread["elapsed_low_s"], spread["elapsed_high_s"])
            dots = {"color": style["color"], "marker": style["marker"], "linestyle": "none"}
            if several:
                axes.fill_between(*ends, color=style["color"], alpha=0.16, linewidth=0)
                dots |= {"markersize": 1.5, "alpha": 0.3}
            else:
                axes.vlines(*ends, color=style["color"], linewidth=0.5, alpha=0.5, rasterized=True)
                dots |= {"markersize": 2.5, "alpha": 0.6}
            axes.plot(known[column] + shift, known["elapsed_s"], rasterized=True, **dots)
            zorder = 4 if name == ORACLE else 3
            axes.plot(bands[column], bands["elapsed_s"], label=name, zorder=zorder, **style)
        if not axes.lines:
            axes.text(0.5, 0.5, "no truth: unknown", ha="center", transform=axes.transAxes)
        axes.set(xlabel=label, yscale="log")
        write_plainly(axes.yaxis)
    panels[0].set_ylabel("time of one alignment (s)")
    named = [(n, label) for n, label in data.labels.items() if n in timed or label != n]
    aligner_legend(figure, {label: data.styles[name] for name, label in named}, columns=5)
    return figure


def draw_fusers(data: ResultTables) -> Figure:
    """Draw the error of the fused map against the iteration, for each fuser, log axis.

    Gross landmarks are left out of RMS and median; their share has a panel of its own.
    """
    rows = data.rows("fusers")
    if not rows["fitted_rmse_m"].notna().any():
        raise NothingToDraw("no fused map whose truth is known")
    fusers = rows["fuser"].drop_duplicates().tolist()
    of_fuser = {name: rows[rows["fuser"] == name].sort_values("iteration") for name in fusers}
    styles = fuser_styles(fusers)
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.2))
    *errors, gross = figure.subplots(1, 3, sharex=True, width_ratios=_WIDTHS)
    errors[1].sharey(errors[0])
    for axes, (title, bold, thin) in zip(errors, _ERRORS, strict=True):
        for name, own in of_fuser.items():
            axes.plot(own["iteration"], own[bold], **styles[name])
            if thin:
                axes.plot(own["iteration"], own[thin], **styles[name] | _MEDIAN)
        axes.set(title=title, yscale="log")
    for name, own in of_fuser.items():
        gross.plot(own["iteration"], own["gross_share"], **styles[name])
    errors[0].set_ylabel("error of landmarks, RMS (m)")
    # Errors span less than a decade: powers of ten alone would leave the axis without numbers.
    errors[0].yaxis.set_major_locator(LogLocator(subs=_TICKS))
    errors[0].yaxis.set_major_formatter(plain_numbers())
    errors[0].yaxis.set_minor_formatter(NullFormatter())
    errors[1].tick_params(labelleft=False)
    top = max(float(rows["gross_share"].max()), _LEAST_TOP)
    gross.set(title="gross landmarks (%)", ylim=(-0.05 * top, 1.1 * top))
    gross.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:.2g}"))
    gross.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    errors[1].set_xlabel("FastSLAM iteration k")
    shown = {name: styles[name] for name in fusers}
    aligner_legend(figure, shown, 4, [Line2D([], [], color=BLACK, label="median", **_MEDIAN)])
    return figure


def draw_coverage(data: ResultTables) -> Figure:
    """Draw the coverage of the error ellipses against their probability, for each fuser.

    Of the last iteration, without gross landmarks. A map below the diagonal is overconfident.
    """
    rows = data.rows("fuser_coverage")
    if rows.empty:
        raise NothingToDraw("no fused map whose truth is known")
    fused = rows[rows["map"] == FUSED]
    fusers = fused["fuser"].drop_duplicates().tolist()
    styles = fuser_styles(fusers)
    curves = {
        label: (own, GIVEN_STYLES[kind])
        for kind, label in _BEFORE.items()
        if len(own := rows[rows["map"] == kind])
    }
    curves |= {name: (fused[fused["fuser"] == name], styles[name]) for name in fusers}
    figure = Figure(figsize=(PAGE_WIDTH_IN, 4.3))
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, (column, title) in zip(panels, _COVERAGE_PANELS.items(), strict=True):
        axes.plot([0, 1], [0, 1], **_DIAGONAL)
        for own, style in curves.values():
            axes.plot(own["nominal"], own[column], **style)
        axes.set(title=title, xlabel="probability of the ellipses (%)", aspect="equal")
        axes.set(xlim=(0, 1), ylim=(0, 1.03))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(PercentFormatter(1.0, symbol=""))
    panels[0].set_ylabel("true points inside (%)")
    consistent = Line2D([], [], label="as stated", **_DIAGONAL)
    aligner_legend(figure, {name: style for name, (_, style) in curves.items()}, 4, [consistent])
    return figure


def draw_team(data: ResultTables) -> Figure:
    """Draw the error of each robot's path against the iteration, in the joint map and alone.

    Of many robots, the first by name are drawn. Lines of adopted maps begin at the first adoption.
    """
    rows = data.rows("team_members")
    if not len(rows):
        raise NothingToDraw(NO_TEAM)
    if not rows["path_rmse_m"].notna().any():
        raise NothingToDraw("no true poses: errors are unknown")
    several = rows.groupby(["robot", "iteration"], sort=False).median(numeric_only=True)
    rows = several.reset_index()
    events = data.rows("adoptions")
    robots = sorted(rows["robot"].unique(), key=name_order)
    shown = robots[:_MOST_ROBOTS]
    n_rows = -(-len(shown) // _ROBOTS_A_ROW)
    figure = Figure(figsize=(PAGE_WIDTH_IN, n_rows * _PANEL_HEIGHT_IN + _EXTRA_HEIGHT_IN))
    panels = figure.subplots(n_rows, _ROBOTS_A_ROW, sharex=True, sharey=True, squeeze=False)
    for axes in panels.flat[len(shown) :]:
        axes.set_visible(False)
    for axes, robot in zip(panels.flat, shown, strict=False):
        own = rows[rows["robot"] == robot].sort_values("iteration")
        for column, (_, style) in _TEAM_PATHS.items():
            known = own.dropna(subset=column)
            axes.plot(known["iteration"], known[column], markevery=0.2, **style)
        of_robot = events[events["robot"] == robot]
        for kind, style in _TEAM_EVENTS.items():
            for k in of_robot.loc[of_robot["event"] == kind, "iteration"].unique():
                axes.axvline(k, zorder=0, **style)
        axes.set(title=robot, yscale="log")
        write_plainly(axes.yaxis)
    for axes in panels[:, 0]:
        axes.set_ylabel("path error, RMS (m)")
    left_out = f"\n({len(shown)} of {len(robots)} robots)" if len(robots) > len(shown) else ""
    figure.supxlabel(f"FastSLAM iteration k{left_out}", fontsize=8)
    styles = dict(_TEAM_PATHS.values())
    happened = [kind for kind in _TEAM_EVENTS if (events["event"] == kind).any()]
    lines = [Line2D([], [], label=f"map {kind}", **_TEAM_EVENTS[kind]) for kind in happened]
    aligner_legend(figure, styles, 3, lines)
    return figure
