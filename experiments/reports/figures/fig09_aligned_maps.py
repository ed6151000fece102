"""Figure 9: corresponding landmarks of two aligned maps, and the landmarks fused from them."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial import KDTree

from experiments.reports.figures import floor_plan as plan
from experiments.reports.figures.result_tables import FusedPairs, ResultTables
from experiments.reports.figures.style import BLACK, GRAY, PAGE_WIDTH_IN
from mapfusion.geometry.numerics import Float

READS = ("fused", "fused_motions", "landmarks", "robots")
_ZOOM_LANDMARKS = 5  # what a panel of that size shows without clutter
_ZOOM_MARGIN = 1.1  # of the side
_MAX_CANDIDATES = 500  # squares to choose from; each is held against all landmarks


def draw(data: ResultTables) -> Figure:
    """All corresponding landmarks in one frame, with ellipses, and a small part enlarged."""
    pairs = data.fused_pairs()
    fused = pairs.position_m[2]
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    overview, zoom = figure.subplots(1, 2)
    part = choose_zoom(pairs.position_m, pairs.covariance_m2)
    (x, y), side = part.corner_m, part.side_m
    for axes, rows, scale in ((overview, slice(None), 0.3), (zoom, part.whole, 1.0)):
        plan.start_plan(axes, data, data.fused_frame)
        _draw_landmarks(axes, data, pairs, rows, scale)
    plan.set_view(overview, fused, fused[:0])
    zoom.set(xlim=(x, x + side), ylim=(y, y + side), aspect="equal")
    dashed = {"fill": False, "edgecolor": BLACK, "linestyle": "--", "zorder": 6}
    overview.add_patch(Rectangle((x, y), side, side, **dashed))
    overview.set_title(f"{len(fused)} landmarks in both maps, aligned")
    cut = f", without {part.n_cut} on its rim" if part.n_cut else ""
    zoom.set_title(f"{part.whole.sum()} of them in the dashed square{cut}")
    handles, _ = zoom.get_legend_handles_labels()
    legend = {"title": f"{plan.LEVEL_TEXT} ellipses, to scale", "title_fontsize": 7.5}
    plan.finish_plans(figure, [overview, zoom], handles, len(handles), **legend)
    return figure


def _draw_landmarks(
    axes: Axes, data: ResultTables, pairs: FusedPairs, rows: slice | np.ndarray, scale: float
) -> None:
    position, covariance = pairs.position_m[:, rows], pairs.covariance_m2[:, rows]
    parents = list(np.stack(list(position[:2, :, :2]), axis=1))
    style = {"colors": GRAY, "linewidths": 0.6, "rasterized": True}
    axes.add_collection(LineCollection(parents, label="correspondences", **style), autolim=False)
    for k, (name, marker, colour) in enumerate(data.parents_and_fused(pairs.robots)):
        look = {"marker": marker, "markersize": 6 * scale, "markeredgewidth": 0.8 * scale}
        look |= {"markerfacecolor": "none", "color": colour, "zorder": 3 + 0.1 * k}
        label = name if k == 2 else f"map of {name}"
        plan.add_points(axes, position[k], label=label, **look)
        look = {"edgecolors": colour, "linewidths": (1.4 if k == 2 else 0.8) * scale}
        look |= {"rasterized": True, "zorder": 2 + 0.1 * k}
        plan.add_ellipses(axes, position[k], covariance[k], **look)


class Zoom(NamedTuple):
    """A square part of a plan, and which landmarks lie in it with all of their ellipses."""

    corner_m: Float  # (2,) the lower left one
    side_m: float
    whole: np.ndarray  # (N,) bool
    n_cut: int  # landmarks on its rim


def choose_zoom(position_m: Float, covariance_m2: Float) -> Zoom:
    """The square around a few neighbours whose rim cuts the fewest others, small where it can be.

    Positions (3, N, 3) and covariances (3, N, 3, 3) as in `FusedPairs`.
    """
    variance = np.diagonal(covariance_m2[..., :2, :2], axis1=2, axis2=3)
    reach = np.sqrt(variance * plan.ELLIPSE_BOUND)
    low = (position_m[..., :2] - reach).min(axis=0)
    high = (position_m[..., :2] + reach).max(axis=0)
    middle = (low + high) / 2
    some = np.unique(np.linspace(0, len(middle) - 1, _MAX_CANDIDATES).round().astype(int))
    count = min(_ZOOM_LANDMARKS, len(middle))
    near = np.reshape(KDTree(middle).query(middle[some], k=count)[1], (len(some), count))
    ends = low[near].min(axis=1), high[near].max(axis=1)
    side = _ZOOM_MARGIN * (ends[1] - ends[0]).max(axis=1)
    corner = (ends[0] + ends[1] - side[:, None]) / 2
    first, last = corner[:, None], (corner + side[:, None])[:, None]
    whole = np.all((low >= first) & (high <= last), axis=2)
    touched = np.all((high > first) & (low < last), axis=2)
    n_cut = np.count_nonzero(touched & ~whole, axis=1)
    best = int(np.argmin(n_cut + side / np.median(side)))
    return Zoom(corner[best], float(side[best]), whole[best], int(n_cut[best]))
