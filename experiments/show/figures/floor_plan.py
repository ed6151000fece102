"""What all maps seen from above share: equal scales, walls, frames, and a view without strays."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from experiments.show.figures.style import BLACK, PALE_GRAY
from mapfusion.se2 import Float

_STRAY_SHARE = 0.005  # a stray landmark tens of metres off, on each side, must not shrink the map
_MARGIN, _MIN_MARGIN_M = 0.05, 0.3  # of the view's extent
_AXIS_LENGTH_M = 1.0
_LABELS_WIDTH_IN, _LABELS_HEIGHT_IN = 0.55, 0.65  # what labels and titles take beside each panel
_LEGEND_ROW_IN, _LEGEND_FRAME_IN = 0.16, 0.2


def add_walls(axes: Axes, walls: Sequence[Float]) -> None:
    """Draw the true walls faintly, as context."""
    for wall in walls:
        axes.plot(wall[:, 0], wall[:, 1], color=PALE_GRAY, linewidth=2.0, zorder=0.8)


def add_frame(axes: Axes, length_m: float = _AXIS_LENGTH_M) -> None:
    """Draw the frame's x and y axis at its origin, the robot's start pose."""
    for tip, name in (((length_m, 0.0), "x"), ((0.0, length_m), "y")):
        axes.annotate(
            "",
            xy=tip,
            xytext=(0.0, 0.0),
            arrowprops={"arrowstyle": "-|>", "color": BLACK, "linewidth": 1.2, "shrinkA": 0},
            zorder=6,
        )
        axes.annotate(name, xy=tip, xytext=(3, -4), textcoords="offset points", zorder=6)


def set_view(axes: Axes, landmarks_m: Float, *others_m: Float) -> int:
    """Show all of `others_m` and the landmarks but for strays, at equal scales.

    Returns:
        How many landmarks lie outside the view.
    """
    core = [points[:, :2] for points in others_m if len(points)]
    if len(landmarks_m):
        core.append(np.quantile(landmarks_m[:, :2], [_STRAY_SHARE, 1 - _STRAY_SHARE], axis=0))
    points = np.concatenate(core) if core else np.zeros((1, 2))
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    margin = max(_MARGIN * float((high - low).max()), _MIN_MARGIN_M)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal", adjustable="box")
    inside = np.all((landmarks_m[:, :2] >= low - margin) & (landmarks_m[:, :2] <= high + margin), 1)
    return int(len(landmarks_m) - inside.sum())


def height_of_row(panels: Sequence[Axes], width_in: float) -> float:
    """Inches that a row of plans needs, their views set, when each is given so much width."""
    ratio = max(np.ptp(axes.get_ylim()) / np.ptp(axes.get_xlim()) for axes in panels)
    return (width_in - _LABELS_WIDTH_IN) * float(ratio) + _LABELS_HEIGHT_IN


def legend_height(n_entries: int, n_columns: int, title: bool = False) -> float:
    """Inches that a legend below or above a figure takes."""
    rows = -(-n_entries // n_columns) + title
    return _LEGEND_ROW_IN * rows + _LEGEND_FRAME_IN


def label_plan(axes: Axes, frame: str) -> None:
    """Label both axes with their unit and the frame they belong to."""
    axes.set_xlabel(f"x in {frame}'s frame (m)")
    axes.set_ylabel(f"y in {frame}'s frame (m)")
