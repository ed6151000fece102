"""Common style of all figures, and floor plans.

Figures are legible in print, colour-blind safe and reproducible. Plans have equal scales, walls and
a view without outliers.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import cycle
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogFormatter

from experiments.evaluation.alignment_criteria import ORACLE
from experiments.evaluation.map_errors import FILTERED, SMOOTHED
from mapfusion.fusion.fusers import REFERENCE
from mapfusion.geometry.numerics import Float
from mapfusion.plotting import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    largest_magnification,
)

PAGE_WIDTH_IN = 7.2  # two columns of a journal page
# Four colours of Tol's (2021) muted scheme, for comparisons of many methods.
INDIGO, WINE, OLIVE, TEAL = "#332288", "#882255", "#999933", "#44AA99"
BLACK, GRAY, WALL_GRAY, PALE_GRAY = "#000000", "#7F7F7F", "#A8A8A8", "#C8C8C8"

_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # part of Matplotlib: the same on every machine
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.0,
    "legend.fontsize": 7.5,
    "legend.framealpha": 0.9,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titley": 1.0,  # skips Matplotlib's search for a free position
    "grid.alpha": 0.35,
    "grid.linewidth": 0.4,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "mapfusion",  # constant element ids in SVG files
}
# Colour, dashes and marker: lines also differ in gray print. A known method has a fixed style.
_KNOWN_ALIGNERS: dict[str, tuple[Any, ...]] = {
    "ransac": (BLUE, "-", "o"),
    "svd": (VERMILLION, (0, (6, 1, 1, 1)), "s"),
    "svd-solved": (ORANGE, (0, (1, 1)), "D"),
    "icp": (GREEN, (0, (5, 1)), "^"),
    "impicp": (PURPLE, (0, (3, 1, 1, 1, 1, 1)), "v"),
    "gnc": (SKY, (0, (8, 2)), "P"),
    "clique": (INDIGO, "-", "*"),
    "ransac_mahalanobis": (WINE, (0, (6, 1, 1, 1)), "X"),
    "opencv": (OLIVE, (0, (3, 1)), "<"),
    "kiss_matcher": (TEAL, (0, (3, 1, 1, 1, 1, 1)), ">"),
    ORACLE: (BLACK, (0, (4, 2)), "x"),
}
# Fusers, the most important ones with solid dark lines; below, the maps given to the fusers.
_KNOWN_FUSERS: dict[str, tuple[Any, ...]] = {
    "kalman": (ORANGE, (0, (1, 1)), "D"),
    "kalman-drift": (VERMILLION, (0, (6, 1, 1, 1)), "s"),
    "kalman_as_printed": (WINE, (0, (3, 1, 1, 1, 1, 1)), "X"),
    "covariance_intersection": (GREEN, (0, (5, 1)), "^"),
    "joint": (BLUE, "-", "o"),
    REFERENCE: (BLACK, (0, (4, 2)), "x"),
}
GIVEN_STYLES: dict[str, dict[str, Any]] = {
    FILTERED: {"color": GRAY, "linestyle": (0, (3, 1, 1, 1)), "marker": "v"},
    SMOOTHED: {"color": GRAY, "linestyle": "-", "marker": "P"},
}
# All others (plug-ins, names defined in a scenario) by their position. The lengths of the tuples
# have no common factor, so 99 styles come before one repeats.
_OTHER_COLOURS = (INDIGO, OLIVE, BLUE, WINE, TEAL, VERMILLION, SKY, ORANGE, PURPLE, GREEN, GRAY)
_DASHES_AND_GAPS = [(2, 2), (9, 1, 2, 1), (), (4, 1, 1, 1), (1, 2), (7, 3)]
_DASHES_AND_GAPS += [(5, 1, 1, 1, 1, 1, 1, 1), (3, 3), (10, 2, 4, 2)]
_OTHER_DASHES = [(0, lengths) if lengths else "-" for lengths in _DASHES_AND_GAPS]
_OTHER_MARKERS = ("p", "h", "d", "8", "H", "1", "2", "3", "4")
# Floor plans
_WIDEST_SHARE = 1 / 10  # of the map's extent, for the widest particle set drawn
_OUTLIER_SHARE = 0.005  # on each side: a distant outlier must not shrink the map
_SURROUNDINGS = 1.0  # walls are shown up to this distance, as a multiple of the map's extent
_MARGIN, _MIN_MARGIN_M = 0.05, 0.3  # of the view's extent
_LABELS_WIDTH_IN, _LABELS_HEIGHT_IN = 0.55, 0.65  # labels and titles of each panel
_LEGEND_ROW_IN, _LEGEND_FRAME_IN, _TITLE_LINE_IN = 0.16, 0.2, 0.15


class _Between(LogFormatter):
    """Formatter of minor ticks: plain numbers on axes with few powers of ten, else none."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return _plain(x) if super().__call__(x, pos) else ""


def plain_numbers() -> FuncFormatter:
    """Return a formatter that writes plain numbers on logarithmic axes: 0.01, 0.1, 1, 10."""
    return FuncFormatter(lambda value, _: _plain(value))


def write_plainly(axis: Axis) -> None:
    """Write plain numbers on a logarithmic axis, also between the powers of ten."""
    axis.set_major_formatter(plain_numbers())
    axis.set_minor_formatter(_Between())


def _plain(value: float) -> str:
    return f"{value:g}".replace("-", "−")


def house_style() -> AbstractContextManager[None]:
    """Return a context with the common style; the user's own settings are restored afterwards."""
    return matplotlib.style.context(["default", _RC])


def aligner_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return line styles by aligner: fixed for known aligners, else by position in `names`."""
    return _styles(_KNOWN_ALIGNERS, names)


def fuser_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return line styles by fuser, as `aligner_styles` does."""
    return _styles(_KNOWN_FUSERS, names)


def _styles(
    known: Mapping[str, tuple[Any, ...]], names: Sequence[str]
) -> dict[str, dict[str, Any]]:
    others = [name for name in names if name not in known]
    looks = zip(cycle(_OTHER_COLOURS), cycle(_OTHER_DASHES), cycle(_OTHER_MARKERS), strict=False)
    chosen = {**known} | dict(zip(others, looks, strict=False))
    parts = ("color", "linestyle", "marker")
    return {name: dict(zip(parts, look, strict=True)) for name, look in chosen.items()}


def aligner_legend(
    figure: Figure,
    styles: Mapping[str, dict[str, Any]],
    columns: int,
    others: Sequence[Artist] = (),
) -> None:
    """Put a legend above a figure: line styles by label, then other entries."""
    lines = [Line2D([], [], label=label, **style) for label, style in styles.items()]
    handles = [*lines, *others]
    place = {"loc": "outside upper center", "ncols": min(len(handles), columns)}
    figure.legend(handles=handles, handlelength=3.2, **place)


def start_plan(axes: Axes, robot: str, walls_m: Sequence[Float]) -> None:
    """Label a plan in a robot's map frame and draw the faces of the walls, lines (n, 2)."""
    label_plan(axes, robot)
    for wall in walls_m:
        axes.plot(*wall.T, color=WALL_GRAY, linewidth=0.7, zorder=0.8)


def label_plan(axes: Axes, frame: str) -> None:
    """Label both axes with unit and frame."""
    axes.set(xlabel=f"x in {frame}'s frame (m)", ylabel=f"y in {frame}'s frame (m)")


def add_points(axes: Axes, points: Float, **style: Any) -> None:
    """Draw points, shape (N, 2 or more), as pixels; outlines would make an SVG of megabytes."""
    axes.plot(*points[:, :2].T, linestyle="none", rasterized=True, **style)


def add_frame(axes: Axes, length_m: float = 1.0) -> None:
    """Draw the x and y axis of the frame at its origin, the robot's start pose."""
    arrow = {"arrowstyle": "-|>", "color": BLACK, "linewidth": 1.2, "shrinkA": 0}
    for tip, name in (((length_m, 0.0), "x"), ((0.0, length_m), "y")):
        axes.annotate("", xy=tip, xytext=(0.0, 0.0), arrowprops=arrow, zorder=6)
        axes.annotate(name, xy=tip, xytext=(3, -4), textcoords="offset points", zorder=6)


def magnification(extent_m: float, widest_m: float) -> int:
    """Return the largest round factor at which particle sets stay small in a map."""
    return largest_magnification(widest_m, _WIDEST_SHARE * extent_m)


def set_view(axes: Axes, landmarks_m: Float, path_m: Float, walls_m: Sequence[Float] = ()) -> str:
    """Show a path, the landmarks without outliers, and the walls around both, at equal scales.

    All walls are shown unless the building is much larger than the map. Return a text with the
    number of landmarks, and of those that are out of view.
    """
    plan = landmarks_m[:, :2]
    core = [path_m[:, :2]] if len(path_m) else []
    if len(plan):
        core.append(np.quantile(plan, [_OUTLIER_SHARE, 1 - _OUTLIER_SHARE], axis=0))
    low, high = _bounds(core or walls_m)
    if core and len(walls_m):
        reach = _SURROUNDINGS * float((high - low).max())
        walls_low, walls_high = _bounds(walls_m)
        low = np.minimum(low, np.maximum(walls_low, low - reach))
        high = np.maximum(high, np.minimum(walls_high, high + reach))
    margin = max(_MARGIN * float((high - low).max()), _MIN_MARGIN_M)
    low, high = low - margin, high + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    outside = np.any((plan < low) | (plan > high), axis=1).sum()
    return f"{len(plan)} landmarks" + (f", {outside} out of view" if outside else "")


def _bounds(lines: Sequence[Float]) -> tuple[Float, Float]:
    """Return lowest and highest coordinates (2,) of lines (n, 2); the origin without lines."""
    points = np.concatenate(lines) if len(lines) else np.zeros((1, 2))
    return np.nanmin(points, axis=0), np.nanmax(points, axis=0)


def set_one_scale(panels: Sequence[Axes]) -> None:
    """Give panels of one size the same scale: that of the largest view."""
    views = np.array([[axes.get_xlim(), axes.get_ylim()] for axes in panels])
    half = np.ptp(views, axis=2).max(axis=0) / 2
    for axes, middle in zip(panels, views.mean(axis=2), strict=True):
        (x0, y0), (x1, y1) = middle - half, middle + half
        axes.set(xlim=(x0, x1), ylim=(y0, y1))


def set_square(axes: Axes, centre: Float, reach_m: float) -> None:
    """Show a square around a point, at equal scales; `reach_m` is half a side."""
    (x0, y0), (x1, y1) = centre - reach_m, centre + reach_m
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")


def height_of_row(panels: Sequence[Axes], width_in: float) -> float:
    """Return the height of a row of plans in inches, for the width of each; views must be set."""
    ratio = max(np.ptp(axes.get_ylim()) / np.ptp(axes.get_xlim()) for axes in panels)
    return (width_in - _LABELS_WIDTH_IN) * float(ratio) + _LABELS_HEIGHT_IN


def finish_plans(
    figure: Figure, panels: Sequence[Axes], handles: Sequence[Artist], columns: int, **legend: Any
) -> None:
    """Put a legend below one row of plans and set the height of the figure."""
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, **legend)
    rows = -(-len(handles) // columns) + ("title" in legend)
    plans_in = height_of_row(panels, PAGE_WIDTH_IN / len(panels))
    # a title of several lines needs more than the labels' height
    plans_in += _TITLE_LINE_IN * max(axes.get_title().count("\n") for axes in panels)
    figure.set_figheight(plans_in + (_LEGEND_ROW_IN * rows + _LEGEND_FRAME_IN))
