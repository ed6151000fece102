"""Figure 7: two maps in their own frames, in space, and the correspondences between them."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from experiments.run.estimates import inlier_mask
from experiments.show.figures.result_tables import NothingToDraw, Pair, ResultTables, of_pair
from experiments.show.figures.style import BLACK, GRAY, PAGE_WIDTH_IN
from mapfusion.se2 import Float

# Strays must not shrink the picture: beyond this share on each side, widened by some of the extent.
_STRAY_SHARE, _STRAY_MARGIN = 0.005, 0.05
_GAP = 0.15  # between the two maps, as a share of the first one's width
_MIN_HEIGHT = 0.2  # of the box, as a share of its length: rooms are low; the axis is true anyway
_MAX_LINES = 80  # of each kind: more would hide the maps
# The enlarged box reaches beyond the axes' own rectangle.
_BEYOND_AXES: dict[str, Any] = {"clip_on": False, "in_layout": False}
_ZOOM = 1.3  # fills the page: the default leaves room for any view
_SHORT_AXIS_TICKS = 4
_ELEVATION_DEG, _AZIMUTH_DEG = 32.0, -72.0


def draw(data: ResultTables) -> Figure:
    """The first pair's maps side by side; right and wrong correspondences are told apart."""
    pair = _pair_to_show(data)
    position_a, position_b = (_clipped(data.landmarks_of(robot)[0]) for robot in pair)
    shift = np.array([np.nanmax(position_a[:, 0]) - np.nanmin(position_b[:, 0]), 0.0, 0.0])
    shift[0] += _GAP * np.ptp(position_a[np.isfinite(position_a[:, 0]), 0])
    ends = {pair[0]: position_a, pair[1]: position_b + shift}
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.9))
    axes: Axes3D = figure.add_subplot(projection="3d")
    for (robot, points), marker in zip(ends.items(), "*^", strict=True):
        look = {"marker": marker, "markersize": 2.0, "markeredgewidth": 0.2, "linestyle": "none"}
        look |= {"color": data.colours[robot], "label": f"{robot}: {len(points)} landmarks"}
        axes.plot(*points.T, rasterized=True, **look, **_BEYOND_AXES)
    _add_correspondences(axes, data, pair, *ends.values())
    _set_space(axes, np.concatenate(list(ends.values())))
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    figure.legend(
        loc="outside upper center",
        ncols=2,
        title=f"each map in its own frame; {pair[1]}'s is drawn {shift[0]:.1f} m along x",
        title_fontsize=7.5,
    )
    return figure


def _pair_to_show(data: ResultTables) -> Pair:
    for pair in data.pairs:
        if len(data.last_correspondences(pair)):
            return pair
    raise NothingToDraw("no correspondences between any two of the last maps")


def _clipped(position_m: Float) -> Float:
    """Positions with strays as NaN, so that row numbers stay."""
    low, high = np.quantile(position_m, [_STRAY_SHARE, 1 - _STRAY_SHARE], axis=0)
    margin = _STRAY_MARGIN * (high - low)
    inside = np.all((position_m >= low - margin) & (position_m <= high + margin), axis=1)
    return np.where(inside[:, None], position_m, np.nan)


def judge_correspondences(data: ResultTables, pair: Pair) -> tuple[np.ndarray, tuple[str, str]]:
    """Which of the last correspondences are right (N,), and what the two kinds are called.

    By the truth where it is known, else by the refined inliers of the first aligner that has any.
    """
    n_offered, last = len(data.last_correspondences(pair)), data.last_iteration(pair)
    if data.start_pose(pair[0]) is not None:
        judged = of_pair(data.table("true_pairs"), pair).set_index("iteration")["true_pair"]
        names = ("true correspondences", "false correspondences")
        return inlier_mask(judged[last], n_offered), names
    estimates = of_pair(data.table("estimates"), pair)
    found = estimates[(estimates["iteration"] == last) & estimates["accepted"]]
    for name in data.aligners:
        inliers = found[found["aligner"] == name]["refined_inliers"]
        if len(inliers):
            names = (f"{name}'s refined inliers", "other correspondences")
            return inlier_mask(inliers.iloc[0], n_offered), names
    return np.zeros(n_offered, dtype=bool), ("inliers", "correspondences")


def _add_correspondences(
    axes: Axes3D, data: ResultTables, pair: Pair, position_a: Float, position_b: Float
) -> None:
    rows = data.last_correspondences(pair)
    right, names = judge_correspondences(data, pair)
    ends = np.stack([position_a[rows["index_a"]], position_b[rows["index_b"]]], axis=1)
    drawable = np.isfinite(ends).all(axis=(1, 2))
    for chosen, name, style in (
        (~right, names[1], {"colors": GRAY, "linewidths": 0.3, "linestyles": (0, (4, 2))}),
        (right, names[0], {"colors": BLACK, "linewidths": 0.6, "alpha": 0.7}),
    ):
        if not chosen.any():
            continue
        candidates = np.flatnonzero(chosen & drawable)
        n_drawn = min(len(candidates), _MAX_LINES)
        drawn = candidates[np.linspace(0, len(candidates) - 1, n_drawn).astype(int)]
        some = f", {n_drawn} drawn" if n_drawn < chosen.sum() else ""
        style |= {"label": f"{name}: {chosen.sum()}{some}", "rasterized": True}
        lines = Line3DCollection(list(ends[drawn]), **style, **_BEYOND_AXES)
        axes.add_collection3d(lines, autolim=False)


def _set_space(axes: Axes3D, points: Float) -> None:
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    bottom, top = min(0.0, low[2]), max(high[2], low[2] + 0.1)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(bottom, top))
    length, width = (high - low)[:2]
    box = (length, width, max(top - bottom, _MIN_HEIGHT * max(length, width)))
    axes.set_box_aspect(box, zoom=_ZOOM)  # pyright: ignore[reportArgumentType]  # takes floats
    for axis in (axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(_SHORT_AXIS_TICKS))
    axes.view_init(elev=_ELEVATION_DEG, azim=_AZIMUTH_DEG)
