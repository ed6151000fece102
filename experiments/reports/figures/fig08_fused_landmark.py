"""Figure 8: one landmark as two robots know it, and as the merge fuses it."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from experiments.reports.figures import floor_plan as plan
from experiments.reports.figures.result_tables import FusedPairs, NothingToDraw, ResultTables

READS = ("fused", "fused_motions", "landmarks", "robots")
_MAX_ELONGATION = 3.0  # beyond, an ellipse is a needle in print
_MIN_SEPARATION = 0.25  # of the parents, in semi-major axes: nearer, their labels collide
_MARGIN = 1.15


def draw(data: ResultTables) -> Figure:
    """The fused landmark whose three ellipses are the easiest to tell apart."""
    pairs = data.fused_pairs()
    chosen = choose_landmark(pairs)
    if chosen is None:
        raise NothingToDraw("no fused landmark has a regular covariance")
    position, covariance = pairs.position_m[:, chosen], pairs.covariance_m2[:, chosen]
    figure = Figure(figsize=(4.6, 4.4))
    axes = figure.subplots()
    parts = data.parents_and_fused(pairs.robots)
    for k, (name, marker, colour) in enumerate(parts):
        here, dashes = slice(k, k + 1), ("--", "-.", "-")[k]
        look: dict[str, Any] = {"edgecolors": colour, "linestyles": dashes}
        plan.add_ellipses(axes, position[here], covariance[here], **look)
        whose = "fused" if k == 2 else f"{name}'s"
        look = {"marker": marker, "markersize": 6, "linestyle": dashes}
        axes.plot(*position[k, :2], color=colour, label=f"{whose} landmark $L_{'ijF'[k]}$", **look)
    own = pairs.own_covariance_m2[:, chosen]
    thin = {"edgecolors": [colour for *_, colour in parts[:2]], "linewidths": 0.6}
    plan.add_ellipses(axes, position[:2], own, **thin)
    axes.plot(*position[:2, :2].T, color="gray", linewidth=0.6, linestyle=":", zorder=1)
    _name_points(axes, position)
    centre = position[2, :2]
    reach = (np.abs(position[:, :2] - centre).max(axis=1) + plan.semi_axes(covariance)[0]).max()
    plan.set_square(axes, centre, _MARGIN * reach)
    plan.label_plan(axes, data.fused_frame)
    note = "thin: the maps' own covariances, before drift is added"
    if (n_more := pairs.n_parents[chosen] - 2) > 0:
        note += f"; {n_more} more robot{'s' if n_more > 1 else ''} knew it"
    axes.set_title(f"{plan.LEVEL_TEXT} ellipses, to scale\n({note})")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def choose_landmark(pairs: FusedPairs) -> int | None:
    """The fused landmark easiest to read: of two parents, round enough, apart but overlapping.

    Among those the one whose parents' ellipses cross the most, which is where fusing gains the
    most over the better parent. When none is that clear, the best of all regular ones.
    """
    axes = [plan.semi_axes(covariance)[:2] for covariance in pairs.covariance_m2]
    major, minor = np.stack(axes, axis=1)
    regular = np.all(minor > 0, axis=0)
    if not regular.any():
        return None
    separation = np.linalg.norm(pairs.position_m[0, :, :2] - pairs.position_m[1, :, :2], axis=1)
    reach = major[:2].max(axis=0)
    round_enough = np.all(major <= _MAX_ELONGATION * minor, axis=0)
    apart = (separation >= _MIN_SEPARATION * reach) & (separation <= reach)
    area = major * minor
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.where(regular, area[:2].min(axis=0) / area[2], -np.inf)
    legible = (regular & round_enough & apart, regular & apart, regular)
    for parents in (pairs.n_parents == 2, pairs.n_parents > 2):
        for candidates in legible:
            if (candidates & parents).any():
                return int(np.argmax(np.where(candidates & parents, gain, -np.inf)))
    return None


def _name_points(axes: Axes, position_m: np.ndarray) -> None:
    """Names beside the points, the parents' on the far side of each other."""
    along = position_m[1, :2] - position_m[0, :2]
    length = float(np.linalg.norm(along))
    along = along / length if length > 0 else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]])
    look = {"ha": "center", "va": "center", "fontsize": 10, "zorder": 5}
    look |= {"path_effects": [withStroke(linewidth=2.5, foreground="white")]}
    for name, (x, y, _), side in zip("ijF", position_m, (-along, along, across), strict=True):
        offset = {"xytext": tuple(14 * side), "textcoords": "offset points"}
        axes.annotate(f"$L_{name}$", xy=(x, y), **offset, **look)
