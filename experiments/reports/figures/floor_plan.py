"""Floor plans: equal scales, walls, and a view without outliers."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.figures.style import BLACK, PAGE_WIDTH_IN, WALL_GRAY
from mapfusion.geometry.numerics import Float
from mapfusion.plotting import largest_magnification

_WIDEST_SHARE = 1 / 10  # of the map's extent, for the widest particle set drawn
_OUTLIER_SHARE = 0.005  # on each side: a distant outlier must not shrink the map
_SURROUNDINGS = 1.0  # walls are shown up to this distance, as a multiple of the map's extent
_MARGIN, _MIN_MARGIN_M = 0.05, 0.3  # of the view's extent
_LABELS_WIDTH_IN, _LABELS_HEIGHT_IN = 0.55, 0.65  # labels and titles of each panel
_LEGEND_ROW_IN, _LEGEND_FRAME_IN, _TITLE_LINE_IN = 0.16, 0.2, 0.15


def start_plan(axes: Axes, data: ResultTables, robot: str) -> list[Float]:
    """Label a plan in a robot's map frame, draw the faces of the walls and return their lines."""
    label_plan(axes, robot)
    walls = data.walls_in_frame_of(robot)
    for wall in walls:
        axes.plot(*wall.T, color=WALL_GRAY, linewidth=0.7, zorder=0.8)
    return walls


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
