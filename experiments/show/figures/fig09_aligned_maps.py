"""Figure 9: corresponding landmarks of two aligned maps, and the landmarks fused from them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial import KDTree

from experiments.show.figures.ellipses import LEVEL_TEXT, add_ellipses, semi_axes
from experiments.show.figures.floor_plan import (
    add_walls,
    height_of_row,
    label_plan,
    legend_height,
    set_view,
)
from experiments.show.figures.fused_frame import FusedPairs, fused_pairs
from experiments.show.figures.result_tables import ResultTables
from experiments.show.figures.style import BLACK, FUSED_COLOUR, GRAY, PAGE_WIDTH_IN, robot_colours
from mapfusion.se2 import Float

_ZOOM_SIDE = 6.0  # in semi-major axes of the parents' ellipses (median)
_ZOOM_LANDMARKS = 5  # what a panel of that size shows without clutter
_INNER_SHARE = 0.35  # of the side: nearer the rim, ellipses are cut off


def draw(data: ResultTables) -> Figure:
    """All corresponding landmarks in one frame, with ellipses, and a small part enlarged."""
    pairs = fused_pairs(data)
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    overview, zoom = figure.subplots(1, 2)
    walls = data.walls_in_frame_of(data.robots[0])
    for axes, scale in ((overview, 0.3), (zoom, 1.0)):
        add_walls(axes, walls)
        _draw_landmarks(axes, data, pairs, scale)
        label_plan(axes, data.robots[0])
    fused = pairs.position_m[2]
    set_view(overview, fused)
    _set_zoom(overview, zoom, pairs)
    overview.set_title(f"{len(fused)} landmarks in both maps, aligned")
    zoom.set_title("zoom of the dashed rectangle")
    handles, labels = zoom.get_legend_handles_labels()
    legend_in = legend_height(len(handles), len(handles), title=True)
    figure.set_figheight(height_of_row([overview, zoom], PAGE_WIDTH_IN / 2) + legend_in)
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=len(handles),
        title=f"{LEVEL_TEXT} ellipses, to scale",
        title_fontsize=7.5,
    )
    return figure


def _set_zoom(overview: Axes, zoom: Axes, pairs: FusedPairs) -> None:
    major, _, _ = semi_axes(pairs.covariance_m2[:2].reshape(-1, 3, 3)[:, :2, :2])
    side = _ZOOM_SIDE * float(np.median(major))
    x, y = zoom_corner(pairs.position_m[2], side)
    zoom.set_xlim(x, x + side)
    zoom.set_ylim(y, y + side)
    zoom.set_aspect("equal")
    overview.add_patch(
        Rectangle((x, y), side, side, fill=False, edgecolor=BLACK, linestyle="--", zorder=6)
    )


def _draw_landmarks(axes: Axes, data: ResultTables, pairs: FusedPairs, scale: float) -> None:
    colours = [robot_colours(data.robots)[robot] for robot in pairs.robots] + [FUSED_COLOUR]
    names = [f"map of {robot}" for robot in pairs.robots] + ["fused"]
    parents = np.stack(list(pairs.position_m[:2, :, :2]), axis=1)
    axes.add_collection(
        LineCollection(
            list(parents), colors=GRAY, linewidths=0.6, label="correspondences", rasterized=True
        ),
        autolim=False,
    )
    for k, marker in enumerate("*^s"):
        style = {"color": colours[k], "rasterized": True, "zorder": 3 + 0.1 * k}
        axes.plot(
            *pairs.position_m[k, :, :2].T,
            linestyle="none",
            marker=marker,
            markersize=6 * scale,
            markerfacecolor="none",
            markeredgewidth=0.8 * scale,
            label=names[k],
            **style,
        )
        add_ellipses(
            axes,
            pairs.position_m[k],
            pairs.covariance_m2[k],
            edgecolors=colours[k],
            linewidths=(1.4 if k == 2 else 0.8) * scale,
            rasterized=True,
            zorder=2 + 0.1 * k,
        )


def zoom_corner(position_m: Float, side_m: float) -> Float:
    """Lower left corner of a square that shows a few landmarks whole.

    Around the landmark with about the wished number near it and the fewest at the rim.
    """
    tree = KDTree(position_m[:, :2])
    near, visible = (
        tree.query_ball_point(position_m[:, :2], share * side_m, p=np.inf, return_length=True)
        for share in (_INNER_SHARE, 0.5)
    )
    cost = np.abs(np.asarray(near) - _ZOOM_LANDMARKS) + (np.asarray(visible) - near)
    centre = position_m[int(np.argmin(cost)), :2]
    shown = tree.query_ball_point(centre, _INNER_SHARE * side_m, p=np.inf)
    return position_m[shown, :2].mean(axis=0) - side_m / 2
