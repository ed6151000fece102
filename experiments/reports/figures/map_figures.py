"""Figures of maps: two local maps (2), correspondences (7), fused landmarks (8 to 10)."""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
import scipy
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform

from experiments.evaluation.loop_closures import WINDOW_FRAMES, loop_closures
from experiments.pipeline.stages.align import unpacked
from experiments.reports.figures import style as plan
from experiments.reports.figures.result_tables import (
    FusedPairs,
    NothingToDraw,
    Pair,
    ResultTables,
    of_pair,
)
from experiments.reports.figures.style import BLACK, GRAY, PAGE_WIDTH_IN
from mapfusion.files import POSITION_FIELDS
from mapfusion.geometry.numerics import Float
from mapfusion.plotting import (
    ELLIPSE_BOUND,
    FUSED_COLOUR,
    LEVEL_TEXT,
    PURPLE,
    add_ellipses,
    ellipse_handle,
    semi_axes,
)

# Figure 7. Outliers must not shrink the picture: landmarks beyond this quantile on each side,
# widened by a share of the extent, are left out.
_OUTLIER_SHARE, _OUTLIER_MARGIN = 0.005, 0.05
_GAP = 0.15  # between the two maps, as a share of the width of the first map
_MIN_HEIGHT = 0.2  # of the box, as a share of its length: rooms are low; the axis labels stay true
_MAX_LINES, _LEAST_LINES = 30, 8  # of both kinds together, and of the rarer kind
_PADDING_IN = 0.08  # around the box with its labels
_FITTING_STEPS = 4  # labels do not scale with the box, so its size is found by iteration
# Drawn as pixels; the enlarged box reaches beyond the rectangle of the axes.
_IN_SPACE: dict[str, Any] = {"rasterized": True, "clip_on": False, "in_layout": False}

# Figure 8
_MAX_ELONGATION = 3.0  # the axes of a longer ellipse cannot be told apart from a line in print
_MIN_SEPARATION = 0.25  # of the parents, in semi-major axes: labels of closer parents collide
_MARGIN = 1.15

# Figure 9
_ZOOM_LANDMARKS = 5  # legible number for the size of the panel
_ZOOM_MARGIN = 1.1  # of the side
_LEAST_DISTANCE_M = 1e-6  # of two landmarks, for a division
_MAX_CANDIDATES = 500  # squares to choose from; each is compared with all landmarks

# Figure 10
_ROBOT_MARKERS = ("*", "^", "v", "x", "d")


def draw_two_maps(data: ResultTables) -> Figure:
    """Draw landmarks with ellipses, both paths and the particles of two unaligned maps.

    If one robot has closed a loop while another has not, the maps are those of this time.
    """
    robots, k, about = choose_two_maps(data)
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    figure.set_label(about)
    panels = figure.subplots(1, len(robots), squeeze=False)[0]
    clouds = data.table("clouds")
    stored = clouds.loc[clouds["iteration"] <= k, "iteration"].max()
    now = clouds[clouds["iteration"] == stored]
    particles: dict[str, Float] = {
        robot: now.loc[now["robot"] == robot, ["x_m", "y_m"]].to_numpy() for robot in robots
    }
    maps = {robot: data.plan_at(robot, k) for robot in robots}
    extent_m = min(float(np.ptp(maps[robot][0], axis=0).max()) for robot in robots)
    widest_m = max(
        (float(np.ptp(p, axis=0).max()) for p in particles.values() if len(p)), default=0
    )
    magnification = plan.magnification(extent_m, widest_m)
    for axes, robot in zip(panels, robots, strict=True):
        position, covariance = maps[robot]
        path, colour, own = data.path_of(robot)[: k + 1], data.colours[robot], particles[robot]
        walls = data.walls_in_frame_of(robot)
        plan.start_plan(axes, robot, walls)
        points = {"marker": ".", "markersize": 1.5, "color": colour, "zorder": 2}
        plan.add_points(axes, position, label="landmarks", **points)
        ellipses = {"edgecolors": colour, "linewidths": 0.4, "alpha": 0.6, "zorder": 2}
        add_ellipses(axes, position, covariance, rasterized=True, **ellipses)
        axes.plot(*path.T, color=GRAY, label="path of the best particle", zorder=3)
        smoothed, _ = data.smoothed_path_of(robot)
        if len(smoothed):
            line = {"color": BLACK, "linewidth": 0.5, "zorder": 4}
            axes.plot(*smoothed[: k + 1, :2].T, label="path of the smoother", **line)
        start = {"linestyle": "none", "marker": "o", "color": BLACK}
        axes.plot(0, 0, label="start pose, the map's frame", **start)
        mean = own.mean(axis=0) if len(own) else 0.0
        points = {"marker": ".", "markersize": 2.5, "markeredgewidth": 0, "color": BLACK}
        label = f"particles at k = {stored}"
        label += f", spread x{magnification}" if magnification > 1 else ""
        plan.add_points(axes, mean + magnification * (own - mean), label=label, zorder=5, **points)
        plan.add_frame(axes)
        n_landmarks = plan.set_view(axes, position, path, walls)
        axes.set_title(f"{robot}, k = {k}: {n_landmarks}\n({data.sightings})")
    plan.set_one_scale(panels)
    handles, _ = panels[0].get_legend_handles_labels()
    handles.insert(1, ellipse_handle(data.colours[robots[0]]))
    plan.finish_plans(figure, panels, handles, 3)
    return figure


def choose_two_maps(data: ResultTables) -> tuple[list[str], int, str]:
    """Return two robots, an evaluated iteration, and what the caption says about their loops.

    The first robot has closed a loop and the second has not, at the first evaluated iteration for
    which this holds, a window after the closure. Else the first two robots at the end are chosen.

    Raises:
        NothingToDraw: no robot has a landmark, or the result has no history of maps.
    """
    if not data.has("map_history"):
        raise NothingToDraw("made before the maps of all iterations were stored: run it again")
    history = data.table("map_history")
    robots = [robot for robot in data.robots if (history["robot"] == robot).any()]
    if not robots:
        raise NothingToDraw("no robot has a landmark in its map")
    last = int(history["iteration"].max())
    if not data.has("sightings"):
        return robots[:2], last, "The result was made before loop closures were stored."
    closed_at: dict[str, int] = {}
    for closure in loop_closures(data.rows("sightings"), data.table("robots")):
        closed_at.setdefault(closure.robot, closure.iteration)
    evaluated = np.sort(history["iteration"].unique())
    for robot, closed in sorted(closed_at.items(), key=lambda each: each[1]):
        later = evaluated[evaluated >= closed + WINDOW_FRAMES]
        open_robots = [
            name
            for name in robots
            if len(later) and name != robot and closed_at.get(name, last + 1) > later[0]
        ]
        if open_robots:
            other = open_robots[0]
            at = data.table("robots").set_index(["iteration", "robot"])["spread_m"]
            k, spreads = int(later[0]), [1e3 * at[int(later[0]), name] for name in (robot, other)]
            about = (
                f"{robot} has closed a loop at k = {closed}, {other} has not closed one yet; their "
                f"particles spread by {spreads[0]:.2g} and {spreads[1]:.2g} mm (RMS)."
            )
            return [robot, other], k, about
    named = [f"{name} at k = {k}" for name, k in closed_at.items()]
    told = f"First loop closures: {', '.join(named)}." if named else "No robot closes a loop."
    return robots[:2], last, told


def draw_correspondences(data: ResultTables) -> Figure:
    """Draw the maps of the first pair side by side, with right and wrong correspondences."""
    pair = next((pair for pair in data.pairs if len(data.last_correspondences(pair))), None)
    if pair is None:
        raise NothingToDraw("no correspondences between any two of the last maps")
    positions = []  # outliers are NaN, so that row numbers are kept
    for robot in pair:
        position_m = data.landmarks_of(robot)[0]
        low, high = np.quantile(position_m, [_OUTLIER_SHARE, 1 - _OUTLIER_SHARE], axis=0)
        margin = _OUTLIER_MARGIN * (high - low)
        inside = np.all((position_m >= low - margin) & (position_m <= high + margin), axis=1)
        positions.append(np.where(inside[:, None], position_m, np.nan))
    position_a, position_b = positions
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
    # Limits and proportions of the box, and the view
    points = np.concatenate([position_a, position_b])
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
    title = f"each map in its own frame; {pair[1]}'s is drawn {shift_m:.1f} m along x"
    legend = figure.legend(loc="upper center", ncols=2, title=title, title_fontsize=7.5)
    _fill_page(figure, axes, legend)
    return figure


def classify_correspondences(data: ResultTables, pair: Pair) -> tuple[np.ndarray, tuple[str, str]]:
    """Classify the last correspondences as right or wrong.

    The truth decides where it is known, else the refined inliers of the first aligner that has any.

    Returns:
        True for each right correspondence, shape (N,); the labels of both classes.
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
    """Draw a sample of the right and of the wrong correspondences as lines."""
    rows = data.last_correspondences(pair)
    right, names = classify_correspondences(data, pair)
    ends = np.stack([position_a[rows["index_a"]], position_b[rows["index_b"]]], axis=1)
    drawable = np.isfinite(ends).all(axis=(1, 2))
    styles: tuple[dict[str, Any], ...] = (
        {"colors": PURPLE, "linewidths": 1.0, "linestyles": (0, (4, 2))},
        {"colors": BLACK, "linewidths": 0.7},
    )
    n_right, n_all = np.count_nonzero(right & drawable), max(np.count_nonzero(drawable), 1)
    share = round(_MAX_LINES * n_right / n_all)
    n_lines = int(np.clip(share, _LEAST_LINES, _MAX_LINES - _LEAST_LINES))
    counts = (_MAX_LINES - n_lines, n_lines)
    for chosen, name, style, most in zip((~right, right), names[::-1], styles, counts, strict=True):
        if not chosen.any():
            continue
        candidates = np.flatnonzero(chosen & drawable)
        n_drawn = min(len(candidates), most)
        drawn = candidates[np.linspace(0, len(candidates) - 1, n_drawn).astype(int)]
        sample = f", {n_drawn} drawn" if n_drawn < chosen.sum() else ""
        label = f"{name}: {chosen.sum()}{sample}"
        lines = Line3DCollection(list(ends[drawn]), label=label, **style, **_IN_SPACE)
        axes.add_collection3d(lines, autolim=False)


def _fill_page(figure: Figure, axes: Axes3D, legend: Legend) -> None:
    """Make the box as wide as the page, and the page as high as box and legend.

    Matplotlib reserves room for every view direction; half of it stays empty for a low box.
    """
    canvas, dpi, width_in = FigureCanvasAgg(figure), figure.dpi, PAGE_WIDTH_IN
    left_in = bottom_in = 0.0
    legend_in = legend.get_window_extent().height / dpi
    for _ in range(_FITTING_STEPS):
        page_in = np.array([PAGE_WIDTH_IN, figure.get_figheight()])
        axes.set_position((*([left_in, bottom_in] / page_in), *(width_in / page_in)))
        # Bounds of the box and of its labels on the page
        axes.apply_aspect()
        axes.M = axes.get_proj()  # places the labels; otherwise only set while drawing
        corners = np.array(list(product(axes.get_xlim(), axes.get_ylim(), axes.get_zlim())))
        x, y, _ = proj_transform(corners[:, 0], corners[:, 1], corners[:, 2], axes.get_proj())
        box = Bbox.null()
        box.update_from_data_xy(axes.transData.transform(np.stack([x, y], -1)))
        renderer = canvas.get_renderer()
        labels = [axis.get_tightbbox(renderer) for axis in (axes.xaxis, axes.yaxis, axes.zaxis)]
        drawn = Bbox.union([box, *filter(None, labels)])
        left_in += _PADDING_IN - drawn.x0 / dpi
        bottom_in += _PADDING_IN - drawn.y0 / dpi
        width_in *= (PAGE_WIDTH_IN - 2 * _PADDING_IN) / (drawn.width / dpi)
        figure.set_figheight(drawn.height / dpi + legend_in + 4 * _PADDING_IN)


def draw_fused_landmark(data: ResultTables) -> Figure:
    """Draw the fused landmark whose three ellipses are the easiest to tell apart."""
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
        add_ellipses(axes, position[here], covariance[here], **look)
        whose = "fused" if k == 2 else f"{name}'s"
        look = {"marker": marker, "markersize": 6, "linestyle": dashes}
        axes.plot(*position[k, :2], color=colour, label=f"{whose} landmark $L_{'ijF'[k]}$", **look)
    own = pairs.own_covariance_m2[:, chosen]
    thin = {"edgecolors": [colour for *_, colour in parts[:2]], "linewidths": 0.6}
    add_ellipses(axes, position[:2], own, **thin)
    axes.plot(*position[:2, :2].T, color="gray", linewidth=0.6, linestyle=":", zorder=1)
    # Label the points; the labels of the parents point away from each other.
    along = position[1, :2] - position[0, :2]
    length = float(np.linalg.norm(along))
    along = along / length if length > 0 else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]])
    text = {"ha": "center", "va": "center", "fontsize": 10, "zorder": 5}
    text |= {"path_effects": [withStroke(linewidth=2.5, foreground="white")]}
    for name, (x, y, _), side in zip("ijF", position, (-along, along, across), strict=True):
        offset = {"xytext": tuple(14 * side), "textcoords": "offset points"}
        axes.annotate(f"$L_{name}$", xy=(x, y), **offset, **text)
    centre = position[2, :2]
    reach = (np.abs(position[:, :2] - centre).max(axis=1) + semi_axes(covariance)[0]).max()
    plan.set_square(axes, centre, _MARGIN * reach)
    plan.label_plan(axes, data.fused_frame)
    note = "thin: the maps' own covariances, before drift is added"
    if (n_more := pairs.n_parents[chosen] - 2) > 0:
        note += f"; {n_more} more robot{'s' if n_more > 1 else ''} knew it"
    axes.set_title(f"{LEVEL_TEXT} ellipses, to scale\n({note})")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def choose_landmark(pairs: FusedPairs) -> int | None:
    """Return the index of the fused landmark that is the easiest to read.

    Candidates have two parents, whose ellipses are round, separate and overlapping. Of these the
    one with the largest gain of the fusion over the better parent is chosen: there the ellipses
    cross. Weaker conditions apply if there is no candidate. None if no covariance is regular.
    """
    axes = [semi_axes(covariance)[:2] for covariance in pairs.covariance_m2]
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


def draw_aligned_maps(data: ResultTables) -> Figure:
    """Draw all corresponding landmarks in one frame, with ellipses, and a part enlarged."""
    pairs = data.fused_pairs()
    fused = pairs.position_m[2]
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    overview, zoom = figure.subplots(1, 2)
    part = choose_zoom(pairs.position_m, pairs.covariance_m2)
    (x, y), side = part.corner_m, part.side_m
    for axes, rows, scale in ((overview, slice(None), 0.3), (zoom, part.whole, 1.0)):
        plan.start_plan(axes, data.fused_frame, data.walls_in_frame_of(data.fused_frame))
        position, covariance = pairs.position_m[:, rows], pairs.covariance_m2[:, rows]
        parents = list(np.stack(list(position[:2, :, :2]), axis=1))
        lines = {"colors": GRAY, "linewidths": 0.6, "rasterized": True}
        both = LineCollection(parents, label="correspondences", **lines)
        axes.add_collection(both, autolim=False)
        for k, (name, marker, colour) in enumerate(data.parents_and_fused(pairs.robots)):
            style = {"marker": marker, "markersize": 6 * scale, "markeredgewidth": 0.8 * scale}
            style |= {"markerfacecolor": "none", "color": colour, "zorder": 3 + 0.1 * k}
            label = name if k == 2 else f"map of {name}"
            plan.add_points(axes, position[k], label=label, **style)
            style = {"edgecolors": colour, "linewidths": (1.4 if k == 2 else 0.8) * scale}
            style |= {"rasterized": True, "zorder": 2 + 0.1 * k}
            add_ellipses(axes, position[k], covariance[k], **style)
    plan.set_view(overview, fused, fused[:0])
    zoom.set(xlim=(x, x + side), ylim=(y, y + side), aspect="equal")
    # The square is much smaller than the map: a label with a line points to it, and a circle shows
    # where it is.
    dashed = {"fill": False, "edgecolor": BLACK, "linestyle": "--", "zorder": 6}
    overview.add_patch(Rectangle((x, y), side, side, **dashed))
    middle = np.array([x, y]) + side / 2
    (low_x, high_x), (low_y, high_y) = overview.get_xlim(), overview.get_ylim()
    ring = {"markerfacecolor": "none", "color": BLACK, "markersize": 11, "zorder": 6}
    overview.plot(*middle, "o", markeredgewidth=1.2, **ring)
    inward = np.sign([(low_x + high_x) / 2, (low_y + high_y) / 2] - middle)
    box = {"boxstyle": "round,pad=0.2", "facecolor": "white", "linewidth": 0.6}
    beside: dict[str, Any] = {"xytext": tuple(28 * inward), "textcoords": "offset points"}
    beside |= {"ha": "center", "va": "center", "bbox": box, "zorder": 7}
    line = {"arrowstyle": "-", "linewidth": 0.8, "shrinkB": 6}
    overview.annotate("enlarged", xy=(middle[0], middle[1]), arrowprops=line, **beside)
    overview.set_title(f"{len(fused)} landmarks in both maps, aligned")
    cut = f", without {part.n_cut} on its rim" if part.n_cut else ""
    zoom.set_title(f"{part.whole.sum()} of them, enlarged: a square of {100 * side:.2g} cm{cut}")
    handles, _ = zoom.get_legend_handles_labels()
    legend = {"title": f"{LEVEL_TEXT} ellipses, to scale", "title_fontsize": 7.5}
    plan.finish_plans(figure, [overview, zoom], handles, len(handles), **legend)
    return figure


class Zoom(NamedTuple):
    """Square part of a plan, and the landmarks inside.

    Attributes:
        corner_m: lower left corner, shape (2,).
        side_m: length of a side.
        whole: True for landmarks inside with all of their ellipses, shape (N,).
        n_cut: number of landmarks whose ellipses the rim cuts.
    """

    corner_m: Float
    side_m: float
    whole: np.ndarray
    n_cut: int


def choose_zoom(position_m: Float, covariance_m2: Float) -> Zoom:
    """Choose a small square around a few neighbours whose rim cuts few other landmarks.

    Args:
        position_m: positions as in `FusedPairs`, shape (3, N, 3).
        covariance_m2: their covariances, shape (3, N, 3, 3).
    """
    variance = np.diagonal(covariance_m2[..., :2, :2], axis1=2, axis2=3)
    reach = np.sqrt(variance * ELLIPSE_BOUND)
    low = (position_m[..., :2] - reach).min(axis=0)
    high = (position_m[..., :2] + reach).max(axis=0)
    middle = (low + high) / 2
    some = np.unique(np.linspace(0, len(middle) - 1, _MAX_CANDIDATES).round().astype(int))
    count = min(_ZOOM_LANDMARKS, len(middle))
    tree = scipy.spatial.KDTree(middle)
    near = np.reshape(tree.query(middle[some], k=count)[1], (len(some), count))
    ends = low[near].min(axis=1), high[near].max(axis=1)
    side = _ZOOM_MARGIN * (ends[1] - ends[0]).max(axis=1)
    corner = (ends[0] + ends[1] - side[:, None]) / 2
    first, last = corner[:, None], (corner + side[:, None])[:, None]
    whole = np.all((low >= first) & (high <= last), axis=2)
    touched = np.all((high > first) & (low < last), axis=2)
    n_cut = np.count_nonzero(touched & ~whole, axis=1)
    # Ellipses that overlap are hard to tell apart: the size of an ellipse over the distance to the
    # nearest neighbour, median over the neighbours.
    extent = (high - low).max(axis=1)
    apart = tree.query(middle[near], k=min(2, len(middle)))[0].reshape(*near.shape, -1)
    overlap = np.median(extent[near] / np.maximum(apart[..., -1], _LEAST_DISTANCE_M), axis=1)
    best = int(np.argmin(n_cut + side / np.median(side) + overlap))
    return Zoom(corner[best], float(side[best]), whole[best], int(n_cut[best]))


def draw_fused_map(data: ResultTables) -> Figure:
    """Draw the fused map in plan; colours show the robots that each landmark comes from."""
    fused = data.fused_map()
    if fused.empty:
        raise NothingToDraw("the fused map is empty")
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    axes = figure.subplots()
    walls = data.walls_in_frame_of(data.fused_frame)
    plan.start_plan(axes, data.fused_frame, walls)
    kinds = []
    for place, (robot, colour) in enumerate(data.colours.items()):
        own = (fused["n_parents"] == 1) & (fused["robot_a"] == robot)
        marker = _ROBOT_MARKERS[place % len(_ROBOT_MARKERS)]
        style = {"marker": marker, "markersize": 3, "markeredgewidth": 0.3, "color": colour}
        kinds.append((own, f"from {robot} alone", style))
    style = {"marker": "s", "markersize": 2.8, "markerfacecolor": "none", "markeredgewidth": 0.6}
    several = (fused["n_parents"] > 1, "fused from two or more", style | {"color": FUSED_COLOUR})
    position = fused[POSITION_FIELDS].to_numpy()
    for chosen, name, style in [*kinds, several]:
        if chosen.any():
            plan.add_points(axes, position[chosen], label=f"{name} ({chosen.sum()})", **style)
    plan.add_frame(axes)
    axes.set_title(f"fused map: {plan.set_view(axes, position, position[:0], walls)}")
    plan.finish_plans(figure, [axes], axes.get_legend_handles_labels()[0], 4, markerscale=1.6)
    return figure
