"""Figure 9: corresponding landmarks of two aligned maps, and the landmarks fused from them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial import KDTree

from experiments.show.figures import floor_plan as plan
from experiments.show.figures.result_tables import FusedPairs, ResultTables
from experiments.show.figures.style import BLACK, GRAY, PAGE_WIDTH_IN
from mapfusion.se2 import Float

_ZOOM_SIDE = 6.0  # in semi-major axes of the parents' ellipses (median)
_ZOOM_LANDMARKS = 5  # what a panel of that size shows without clutter
_INNER_SHARE = 0.35  # of the side: nearer the rim, ellipses are cut off


def draw(data: ResultTables) -> Figure:
    """All corresponding landmarks in one frame, with ellipses, and a small part enlarged."""
    pairs = data.fused_pairs()
    fused = pairs.position_m[2]
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    overview, zoom = figure.subplots(1, 2)
    for axes, scale in ((overview, 0.3), (zoom, 1.0)):
        plan.start_plan(axes, data, data.robots[0])
        _draw_landmarks(axes, data, pairs, scale)
    plan.set_view(overview, fused)
    side = _ZOOM_SIDE * float(np.median(plan.semi_axes(np.concatenate(pairs.covariance_m2[:2]))[0]))
    x, y = zoom_corner(fused, side)
    zoom.set(xlim=(x, x + side), ylim=(y, y + side), aspect="equal")
    dashed = {"fill": False, "edgecolor": BLACK, "linestyle": "--", "zorder": 6}
    overview.add_patch(Rectangle((x, y), side, side, **dashed))
    overview.set_title(f"{len(fused)} landmarks in both maps, aligned")
    zoom.set_title("zoom of the dashed rectangle")
    handles, _ = zoom.get_legend_handles_labels()
    legend = {"title": f"{plan.LEVEL_TEXT} ellipses, to scale", "title_fontsize": 7.5}
    plan.finish_plans(figure, [overview, zoom], handles, len(handles), **legend)
    return figure


def _draw_landmarks(axes: Axes, data: ResultTables, pairs: FusedPairs, scale: float) -> None:
    parents = list(np.stack(list(pairs.position_m[:2, :, :2]), axis=1))
    style = {"colors": GRAY, "linewidths": 0.6, "rasterized": True}
    axes.add_collection(LineCollection(parents, label="correspondences", **style), autolim=False)
    for k, (name, marker, colour) in enumerate(data.parents_and_fused(pairs.robots)):
        look = {"marker": marker, "markersize": 6 * scale, "markeredgewidth": 0.8 * scale}
        look |= {"markerfacecolor": "none", "color": colour, "zorder": 3 + 0.1 * k}
        label = name if k == 2 else f"map of {name}"
        plan.add_points(axes, pairs.position_m[k], label=label, **look)
        look = {"edgecolors": colour, "linewidths": (1.4 if k == 2 else 0.8) * scale}
        look |= {"rasterized": True, "zorder": 2 + 0.1 * k}
        plan.add_ellipses(axes, pairs.position_m[k], pairs.covariance_m2[k], **look)


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
