"""Figure 8: one landmark as two robots know it, and as the merge fuses it."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from experiments.show.figures.ellipses import LEVEL_TEXT, add_ellipses, semi_axes
from experiments.show.figures.floor_plan import label_plan, set_square
from experiments.show.figures.fused_pairs import MARKERS, FusedPairs, fused_pairs
from experiments.show.figures.result_tables import NothingToDraw, ResultTables

_MAX_ELONGATION = 3.0  # beyond, an ellipse is a needle in print
_MIN_SEPARATION = 0.25  # of the parents, in semi-major axes: nearer, their labels collide
_MARGIN = 1.15


def draw(data: ResultTables) -> Figure:
    """The fused landmark whose three ellipses are the easiest to tell apart."""
    pairs = fused_pairs(data)
    chosen = choose_landmark(pairs)
    if chosen is None:
        raise NothingToDraw("no fused landmark has a regular covariance")
    position, covariance = pairs.position_m[:, chosen], pairs.covariance_m2[:, chosen]
    figure = Figure(figsize=(4.6, 4.4))
    axes = figure.subplots()
    colours = pairs.colours(data)
    labels = [f"{robot}'s landmark $L_{i}$" for robot, i in zip(pairs.robots, "ij", strict=True)]
    labels.append("fused landmark $L_F$")
    for k, dashes in enumerate(("--", "-.", "-")):
        here, colour = slice(k, k + 1), colours[k]
        add_ellipses(axes, position[here], covariance[here], edgecolors=colour, linestyles=dashes)
        look: dict[str, Any] = {"marker": MARKERS[k], "markersize": 6, "label": labels[k]}
        axes.plot(*position[k, :2], color=colour, linestyle=dashes, **look)
    own = pairs.own_covariance_m2[:, chosen]
    add_ellipses(axes, position[:2], own, edgecolors=colours[:2], linewidths=0.6)
    axes.plot(*position[:2, :2].T, color="gray", linewidth=0.6, linestyle=":", zorder=1)
    _name_points(axes, position)
    _set_view(axes, position, covariance)
    label_plan(axes, data.robots[0])
    axes.set_title(
        f"{LEVEL_TEXT} ellipses, to scale\n(thin: the maps' own covariances, before drift is added)"
    )
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def choose_landmark(pairs: FusedPairs) -> int | None:
    """The fused landmark easiest to read: round enough, parents apart but overlapping.

    Among those the one whose parents' ellipses cross the most, which is where fusing gains the
    most over the better parent. When none is that clear, the best of all regular ones.
    """
    semi = [semi_axes(covariance[:, :2, :2]) for covariance in pairs.covariance_m2]
    major, minor = np.stack([s[0] for s in semi]), np.stack([s[1] for s in semi])
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
    for candidates in (regular & round_enough & apart, regular & apart, regular):
        if candidates.any():
            return int(np.argmax(np.where(candidates, gain, -np.inf)))
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


def _set_view(axes: Axes, position_m: np.ndarray, covariance_m2: np.ndarray) -> None:
    major, _, _ = semi_axes(covariance_m2[:, :2, :2])
    centre = position_m[2, :2]
    reach = float((np.abs(position_m[:, :2] - centre).max(axis=1) + major).max())
    set_square(axes, centre, _MARGIN * reach)
