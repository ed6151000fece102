"""Figure 7: two maps in their own frames, in space, and the correspondences between them."""

from itertools import product
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform

from experiments.pipeline.tables import unpacked
from experiments.reports.figures.result_tables import NothingToDraw, Pair, ResultTables, of_pair
from experiments.reports.figures.style import BLACK, GRAY, PAGE_WIDTH_IN
from mapfusion.geometry.numerics import Float

READS = ("correspondences", "errors", "estimates", "landmarks", "robots", "true_pairs")

# Strays must not shrink the picture: beyond this share on each side, widened by some of the extent.
_STRAY_SHARE, _STRAY_MARGIN = 0.005, 0.05
_GAP = 0.15  # between the two maps, as a share of the first one's width
_MIN_HEIGHT = 0.2  # of the box, as a share of its length: rooms are low; the axis is true anyway
_MAX_LINES = 80  # of each kind: more would hide the maps
_PADDING_IN = 0.08  # around the box with its labels
_FITTING_STEPS = 4  # labels do not grow with the box: its size on the page is found step by step
# All that is drawn as pixels, and the enlarged box reaches beyond the axes' own rectangle.
_IN_SPACE: dict[str, Any] = {"rasterized": True, "clip_on": False, "in_layout": False}


def draw(data: ResultTables) -> Figure:
    """The first pair's maps side by side; right and wrong correspondences are told apart."""
    pair = next((pair for pair in data.pairs if len(data.last_correspondences(pair))), None)
    if pair is None:
        raise NothingToDraw("no correspondences between any two of the last maps")
    position_a, position_b = (_clipped(data.landmarks_of(robot)[0]) for robot in pair)
    left, right = np.nanmin(position_a[:, 0]), np.nanmax(position_a[:, 0])
    shift_m = right - np.nanmin(position_b[:, 0]) + _GAP * (right - left)
    position_b += [shift_m, 0.0, 0.0]
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    figure.set_layout_engine("none")
    axes: Axes3D = figure.add_subplot(projection="3d")
    for robot, points, marker in zip(pair, (position_a, position_b), "*^", strict=True):
        look = {"marker": marker, "markersize": 2.0, "markeredgewidth": 0.2, "linestyle": "none"}
        look |= {"color": data.colours[robot], "label": f"{robot}: {len(points)} landmarks"}
        axes.plot(*points.T, **look, **_IN_SPACE)
    _add_correspondences(axes, data, pair, position_a, position_b)
    _set_space(axes, np.concatenate([position_a, position_b]))
    title = f"each map in its own frame; {pair[1]}'s is drawn {shift_m:.1f} m along x"
    legend = figure.legend(loc="upper center", ncols=2, title=title, title_fontsize=7.5)
    _fill_page(figure, axes, legend)
    return figure


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
    if not data.no_truth and data.start_pose(pair[0]) is not None:
        judged = of_pair(data.table("true_pairs"), pair).set_index("iteration")["true_pair"]
        names = ("true correspondences", "false correspondences")
        return unpacked(judged[last], n_offered), names
    estimates = of_pair(data.table("estimates"), pair)
    found = estimates[(estimates["iteration"] == last) & estimates["accepted"]]
    for name in data.aligners:
        inliers = found[found["aligner"] == name]["refined_inliers"]
        if len(inliers):
            names = (f"{name}'s refined inliers", "other correspondences")
            return unpacked(inliers.iloc[0], n_offered), names
    return np.zeros(n_offered, dtype=bool), ("inliers", "correspondences")


def _add_correspondences(
    axes: Axes3D, data: ResultTables, pair: Pair, position_a: Float, position_b: Float
) -> None:
    rows = data.last_correspondences(pair)
    right, names = judge_correspondences(data, pair)
    ends = np.stack([position_a[rows["index_a"]], position_b[rows["index_b"]]], axis=1)
    drawable = np.isfinite(ends).all(axis=(1, 2))
    styles: tuple[dict[str, Any], ...] = (
        {"colors": GRAY, "linewidths": 0.3, "linestyles": (0, (4, 2))},
        {"colors": BLACK, "linewidths": 0.6, "alpha": 0.7},
    )
    for chosen, name, style in zip((~right, right), names[::-1], styles, strict=True):
        if not chosen.any():
            continue
        candidates = np.flatnonzero(chosen & drawable)
        n_drawn = min(len(candidates), _MAX_LINES)
        drawn = candidates[np.linspace(0, len(candidates) - 1, n_drawn).astype(int)]
        some = f", {n_drawn} drawn" if n_drawn < chosen.sum() else ""
        label = f"{name}: {chosen.sum()}{some}"
        lines = Line3DCollection(list(ends[drawn]), label=label, **style, **_IN_SPACE)
        axes.add_collection3d(lines, autolim=False)


def _set_space(axes: Axes3D, points: Float) -> None:
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    low[2], high[2] = min(0.0, low[2]), max(high[2], low[2] + 0.1)
    limits = dict(zip(("xlim", "ylim", "zlim"), zip(low, high, strict=True), strict=True))
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", **limits)
    box = high - low
    box[2] = max(box[2], _MIN_HEIGHT * max(box[:2]))
    axes.set_box_aspect(tuple(box))  # pyright: ignore[reportArgumentType]  # takes floats
    for axis in (axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    axes.view_init(elev=32.0, azim=-72.0)


def _fill_page(figure: Figure, axes: Axes3D, legend: Legend) -> None:
    """Make the box as wide as the page, and the page as high as box and legend.

    Axes in space leave room for any view: of a low box seen from aside, half of it stays empty.
    """
    canvas, dpi, width_in = FigureCanvasAgg(figure), figure.dpi, PAGE_WIDTH_IN
    left_in = bottom_in = 0.0
    legend_in = legend.get_window_extent().height / dpi
    for _ in range(_FITTING_STEPS):
        page_in = np.array([PAGE_WIDTH_IN, figure.get_figheight()])
        axes.set_position((*([left_in, bottom_in] / page_in), *(width_in / page_in)))
        drawn = _extent_px(axes, canvas)
        left_in += _PADDING_IN - drawn.x0 / dpi
        bottom_in += _PADDING_IN - drawn.y0 / dpi
        width_in *= (PAGE_WIDTH_IN - 2 * _PADDING_IN) / (drawn.width / dpi)
        figure.set_figheight(drawn.height / dpi + legend_in + 4 * _PADDING_IN)


def _extent_px(axes: Axes3D, canvas: FigureCanvasAgg) -> Bbox:
    """Where the box and its labels are drawn."""
    axes.apply_aspect()
    axes.M = axes.get_proj()  # by which labels are placed: else only drawing tells it
    corners = np.array(list(product(axes.get_xlim(), axes.get_ylim(), axes.get_zlim())))
    x, y, _ = proj_transform(corners[:, 0], corners[:, 1], corners[:, 2], axes.get_proj())
    box = Bbox.null()
    box.update_from_data_xy(axes.transData.transform(np.stack([x, y], -1)))
    labels = [
        axis.get_tightbbox(canvas.get_renderer()) for axis in (axes.xaxis, axes.yaxis, axes.zaxis)
    ]
    return Bbox.union([box, *filter(None, labels)])
