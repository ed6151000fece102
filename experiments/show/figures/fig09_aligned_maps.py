"""Figure 9: corresponding landmarks of two aligned maps, and the landmarks fused from them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial import KDTree

from experiments.show.figures.ellipses import LEVEL_TEXT, add_ellipses, semi_axes
from experiments.show.figures.floor_plan import add_points, finish_plans, set_view, start_plan
from experiments.show.figures.fused_pairs import MARKERS, FusedPairs, fused_pairs
from experiments.show.figures.result_tables import ResultTables
from experiments.show.figures.style import BLACK, GRAY, PAGE_WIDTH_IN
from mapfusion.se2 import Float

_ZOOM_SIDE = 6.0  # in semi-major axes of the parents' ellipses (median)
_ZOOM_LANDMARKS = 5  # what a panel of that size shows without clutter
_INNER_SHARE = 0.35  # of the side: nearer the rim, ellipses are cut off


def draw(data: ResultTables) -> Figure:
    """All corresponding landmarks in one frame, with ellipses, and a small part enlarged."""
    pairs = fused_pairs(data)
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    overview, zoom = figure.subplots(1, 2)
    for axes, scale in ((overview, 0.3), (zoom, 1.0)):
        start_plan(axes, data, data.robots[0])
        _draw_landmarks(axes, data, pairs, scale)
    set_view(overview, pairs.position_m[2])
    _set_zoom(overview, zoom, pairs)
    overview.set_title(f"{len(pairs.position_m[2])} landmarks in both maps, aligned")
    zoom.set_title("zoom of the dashed rectangle")
    handles, _ = zoom.get_legend_handles_labels()
    title = f"{LEVEL_TEXT} ellipses, to scale"
    finish_plans(figure, [overview, zoom], handles, len(handles), title=title, title_fontsize=7.5)
    return figure


def _set_zoom(overview: Axes, zoom: Axes, pairs: FusedPairs) -> None:
    major, _, _ = semi_axes(pairs.covariance_m2[:2].reshape(-1, 3, 3)[:, :2, :2])
    side = _ZOOM_SIDE * float(np.median(major))
    x, y = zoom_corner(pairs.position_m[2], side)
    zoom.set(xlim=(x, x + side), ylim=(y, y + side), aspect="equal")
    dashed = {"fill": False, "edgecolor": BLACK, "linestyle": "--", "zorder": 6}
    overview.add_patch(Rectangle((x, y), side, side, **dashed))


def _draw_landmarks(axes: Axes, data: ResultTables, pairs: FusedPairs, scale: float) -> None:
    colours = pairs.colours(data)
    names = [*(f"map of {robot}" for robot in pairs.robots), "fused"]
    parents = list(np.stack(list(pairs.position_m[:2, :, :2]), axis=1))
    style = {"colors": GRAY, "linewidths": 0.6, "rasterized": True}
    axes.add_collection(LineCollection(parents, label="correspondences", **style), autolim=False)
    for k, colour in enumerate(colours):
        look = {"marker": MARKERS[k], "markersize": 6 * scale, "markeredgewidth": 0.8 * scale}
        look |= {"markerfacecolor": "none", "color": colour, "zorder": 3 + 0.1 * k}
        add_points(axes, pairs.position_m[k], label=names[k], **look)
        look = {"edgecolors": colour, "linewidths": (1.4 if k == 2 else 0.8) * scale}
        look |= {"rasterized": True, "zorder": 2 + 0.1 * k}
        add_ellipses(axes, pairs.position_m[k], pairs.covariance_m2[k], **look)


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
