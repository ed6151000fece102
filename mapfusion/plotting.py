"""Plans of aligned and of fused maps: what they show, and their drawing with Matplotlib.

A `Plan` holds what is drawn, so that other drawing packages show the same. Matplotlib is imported
only to draw.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import transform_covariances, transform_points
from mapfusion.landmark_map import LandmarkMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Okabe and Ito (2008): distinct for readers with any common colour blindness. Their yellow is left
# out: it is too pale for lines on white.
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
PURPLE, ORANGE, SKY = "#CC79A7", "#E69F00", "#56B4E9"
ROBOT_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
FUSED_COLOUR = "#000000"
ACCEPTED_COLOUR, REJECTED_COLOUR = GREEN, "#7F7F7F"

LEVEL_TEXT = "95 %"
_LEVEL, _PLANE_DIMENSIONS = 0.95, 2
ELLIPSE_BOUND = chi_square_bound(_LEVEL, _PLANE_DIMENSIONS)  # squared Mahalanobis distance
_OUTLIER_SHARE = 0.005  # on each side: a distant outlier must not shrink the map
_MARGIN, _MIN_MARGIN_M = 0.05, 0.3  # of the view's extent
_ELLIPSE_SHARE = 1 / 60  # of the view, for the semi-axis of the typical ellipse of a part
_LARGEST_ELLIPSE = 2.0  # times this share, for the part with the largest ellipses
_GAP = 0.15  # between maps that are not aligned, as a share of the width of the first
_MARKERS = ("o", "^", "v", "x", "d", "*")
_PAGE_WIDTH_IN, _EDGE_IN = 8.0, 0.1
_LEFT_IN, _BELOW_IN = 0.7, 0.5  # of an axes: its ticks and labels
_TITLE_LINE_IN, _HEADING_LINE_IN, _LEGEND_ROW_IN = (
    0.15,
    0.155,
    0.19,
)  # of type of at most 8.5 points
_LARGEST_RATIO, _LEAST_RATIO = 1.3, 0.35  # of height to width of the large plan
_MOST_PER_ROW = 3  # small plans
_LARGEST_SINGLE_RATIO = 0.6  # of height to width of a small plan that is alone in its row
# Characters a line, of which the widest usual text fits the page: the heading, the titles of the
# large plan and of one, two and three small plans in a row, the legend in one to three columns.
_WRAP, _TITLE_WRAP, _SMALL_TITLE_WRAPS = 118, 105, (105, 52, 34)
_LEGEND_WRAPS = (100, 50, 34)
# Field of a plan, colour, width and style of its lines; those drawn last lie above the others.
_LINKS = (("rejected", REJECTED_COLOUR, 0.5, "dotted"), ("accepted", ACCEPTED_COLOUR, 1.2, "solid"))
_LINK_NAMES = {"rejected": "rejected", "accepted": "supporting"}
_SMALL_SCALES = (0.9, 0.8, 0.6)  # of markers and lines of one, two and three small plans in a row
_TITLE_POINTS, _SMALL_TITLE_POINTS = 8.5, 7.5
_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # part of Matplotlib: the same on every machine
    "font.size": 8.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.35,
    "grid.linewidth": 0.4,
}


class Part(NamedTuple):
    """Landmarks that are drawn alike.

    Attributes:
        name: text of the legend.
        colour: colour of points and ellipses.
        marker: Matplotlib's marker.
        position_m: positions (N, 2) in the frame of the plan.
        covariance_m2: covariances (N, 2, 2) in this frame.
    """

    name: str
    colour: str
    marker: str
    position_m: Float
    covariance_m2: Float


class Plan(NamedTuple):
    """Plan of maps in one frame, with the correspondences between them.

    Attributes:
        title: title of the plan.
        parts: landmarks.
        accepted: ends (n, 2, 2) of the correspondences that support the motion.
        rejected: ends (n, 2, 2) of the other ones.
    """

    title: str
    parts: tuple[Part, ...]
    accepted: Float
    rejected: Float


def part_of(
    landmarks: LandmarkMap, T: Float, place: int, name: str, rows: np.ndarray | slice = slice(None)
) -> Part:
    """Return landmarks of a map, moved by T (3,), in the style of the map with this number."""
    moved = transform_points(T, landmarks.position_m[rows, :2])
    covariance = transform_covariances(T, landmarks.covariance_m2[rows])[:, :2, :2]
    k = place % len(ROBOT_COLOURS)
    return Part(name, ROBOT_COLOURS[k], _MARKERS[k], moved, covariance)


def pair_plan(
    title: str,
    maps: tuple[LandmarkMap, LandmarkMap],
    motions: tuple[Float, Float],
    index: tuple[np.ndarray, np.ndarray],
    inlier: np.ndarray,
    places: tuple[int, int] = (0, 1),
) -> Plan:
    """Return the plan of two maps and their correspondences.

    Args:
        title: title of the plan.
        maps: both maps.
        motions: pose (3,) of each map in the frame of the plan; a pose with NaN places the map
            beside the other one, in its own frame.
        index: rows of the N correspondences in each map.
        inlier: correspondences that support the motion, bool (N,).
        places: number of each map, which gives its colour.
    """
    T_a, T_b = motions
    if np.isnan(T_b).any():
        x_a, x_b = (each.position_m[:, 0] for each in maps)
        gap = _GAP * np.ptp(x_a) if len(x_a) else 1.0
        T_b = np.array([x_a.max(initial=0.0) + gap - x_b.min(initial=0.0), 0.0, 0.0])
    moved = zip(maps, (T_a, T_b), places, strict=True)
    parts = tuple(
        part_of(each, T, k, f"{each.name}: {len(each)} landmarks") for each, T, k in moved
    )
    ends = np.stack([part.position_m[rows] for part, rows in zip(parts, index, strict=True)], 1)
    return Plan(title, parts, ends[inlier], ends[~inlier])


def fused_plan(
    title: str, landmarks: LandmarkMap, parents: np.ndarray, maps: Sequence[LandmarkMap]
) -> Plan:
    """Return the plan of a fused map: landmarks of one map alone, and of several.

    Args:
        title: title of the plan.
        landmarks: the N fused landmarks.
        parents: row of each landmark in each map, shape (N, M); negative for none.
        maps: the M maps.
    """
    several, frame = (parents >= 0).sum(axis=1) > 1, np.zeros(3)
    parts = []
    for k, each in enumerate(maps):
        rows = np.flatnonzero((parents[:, k] >= 0) & ~several)
        if len(rows):
            name = f"of {each.name} alone: {len(rows)} of {len(each)}"
            parts.append(part_of(landmarks, frame, k, name, rows))
    rows = np.flatnonzero(several)
    common = part_of(landmarks, frame, 0, f"fused from several maps: {len(rows)}", rows)
    parts.append(common._replace(colour=FUSED_COLOUR, marker="s"))
    none = np.zeros((0, 2, 2))
    return Plan(title, tuple(parts), none, none)


def bounds(plan: Plan) -> tuple[Float, Float]:
    """Return the lowest and highest coordinates (2,) of a view without outliers."""
    points = [part.position_m for part in plan.parts if len(part.position_m)]
    if not points:
        return -np.ones(2), np.ones(2)
    ends = np.concatenate(
        [np.quantile(each, [_OUTLIER_SHARE, 1 - _OUTLIER_SHARE], axis=0) for each in points]
    )
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = max(_MARGIN * float((high - low).max()), _MIN_MARGIN_M)
    return low - margin, high + margin


_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)


def largest_magnification(size_m: float, limit_m: float) -> int:
    """Return the largest round factor at which a size stays within a limit."""
    return max((m for m in _MAGNIFICATIONS if m * size_m <= limit_m), default=1)


def magnification(plan: Plan) -> int:
    """Return the factor at which most ellipses of a plan are legible and do not cover others."""
    (low, high), parts = bounds(plan), [part.covariance_m2 for part in plan.parts]
    typical_m = [float(np.median(semi_axes(each)[0])) for each in parts if len(each)] or [0.0]
    # Ellipses of fused landmarks are the smallest; they must be larger than their markers.
    size_m = max(min(typical_m), max(typical_m) / _LARGEST_ELLIPSE)
    return largest_magnification(size_m, _ELLIPSE_SHARE * float((high - low).max()))


def plot_plans(plans: Sequence[Plan], heading: str) -> Figure:
    """Draw plans: the first one large, the others in rows below it; the heading is above.

    Places are computed from the numbers of lines: automatic layouts neglect that axes of equal
    scales shrink, and then titles overlap the heading.
    """
    import matplotlib.style
    from matplotlib.figure import Figure

    with matplotlib.style.context(["default", _RC]):
        first, *others = plans
        lines = textwrap.wrap(heading, _WRAP)
        factor = magnification(first)
        handles = _legend(plans, factor)
        longest = max(len(str(handle.get_label())) for handle in handles)
        n_columns = sum(longest <= wrap for wrap in _LEGEND_WRAPS) or 1
        legend_in = -(-len(handles) // n_columns) * _LEGEND_ROW_IN + _EDGE_IN

        low, high = bounds(first)
        wide_in = _PAGE_WIDTH_IN - _LEFT_IN - 2 * _EDGE_IN
        ratio = np.clip((high - low)[1] / (high - low)[0], _LEAST_RATIO, _LARGEST_RATIO)
        rows = [[(first, _TITLE_WRAP, wide_in, ratio * wide_in)]]
        per_row = min(max(len(others), 1), _MOST_PER_ROW)
        small_in = _PAGE_WIDTH_IN / per_row - _LEFT_IN - 2 * _EDGE_IN / per_row
        high_in = small_in * (min(ratio, _LARGEST_SINGLE_RATIO) if per_row == 1 else 1.0)
        for k in range(0, len(others), per_row):
            row = others[k : k + per_row]
            wrap = _SMALL_TITLE_WRAPS[per_row - 1]
            rows.append([(plan, wrap, small_in, high_in) for plan in row])

        boxes, top_in = [], _EDGE_IN + len(lines) * _HEADING_LINE_IN  # from the upper edge
        for row in rows:
            titles = [wrapped(plan.title, wrap) for plan, wrap, *_ in row]
            top_in += 2 * _EDGE_IN + _TITLE_LINE_IN * max(t.count("\n") + 1 for t in titles)
            for k, ((plan, _, width_in, height_in), title) in enumerate(
                zip(row, titles, strict=True)
            ):
                left_in = _LEFT_IN + k * (width_in + _LEFT_IN)
                boxes.append((plan, title, left_in, top_in, width_in, height_in))
            top_in += row[0][-1] + _BELOW_IN
        page = np.array([_PAGE_WIDTH_IN, top_in + legend_in])

        figure = Figure(figsize=(page[0], page[1]))
        at = _EDGE_IN / page
        figure.suptitle(
            "\n".join(lines), x=at[0], y=1 - at[1], ha="left", va="top", fontsize=_TITLE_POINTS
        )
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 0.0), "borderaxespad": 0.3}
        figure.legend(handles=handles, ncols=n_columns, frameon=False, **place)
        for plan, title, left_in, top_in, width_in, height_in in boxes:
            corner, size = np.array([left_in, page[1] - top_in - height_in]), [width_in, height_in]
            axes = figure.add_axes((*(corner / page), *(size / page)))  # type: ignore[arg-type]
            scale = 1.0 if plan is first else _SMALL_SCALES[per_row - 1]
            _draw(axes, plan, title, (width_in, height_in), scale, factor)
    return figure


def wrapped(title: str, width: int) -> str:
    """Break the lines of a title that are longer than `width` characters."""
    return "\n".join("\n".join(textwrap.wrap(line, width)) for line in title.splitlines())


def _legend(plans: Sequence[Plan], factor: int) -> list[Line2D]:
    """Return one entry for each look in the plans; numbers are those of the first plan."""
    from matplotlib.lines import Line2D

    first, handles = plans[0], list[Line2D]()
    for name, colour, width, style in _LINKS:
        ends = getattr(first, name)
        if any(len(getattr(plan, name)) for plan in plans):
            label = f"{_LINK_NAMES[name]} correspondence" + (f"s: {len(ends)}" if len(ends) else "")
            # dotted lines as thin as in a plan are not legible in a legend
            look: dict[str, Any] = {"color": colour, "linewidth": max(width, 1.0)}
            look["linestyle"] = style
            handles.append(Line2D([], [], label=label, **look))
    if any(len(plan.accepted) for plan in plans):
        label = "middle of a supporting correspondence"
        handles.append(Line2D([], [], label=label, **_ring(1.0)))
    shown = dict[tuple[str, str], Part]()
    for plan in plans:
        for part in plan.parts:
            shown.setdefault((part.colour, part.marker), part)
    longest = max(_LEGEND_WRAPS)
    for part in shown.values():
        label = part.name if len(part.name) <= longest else f"…{part.name[1 - longest :]}"
        handles.append(Line2D([], [], label=label, **_marker(part, 1.0)))
    return [*handles, ellipse_handle(FUSED_COLOUR, factor)]


def _ring(scale: float) -> dict[str, Any]:
    """Return the look of the rings around supporting correspondences."""
    look = {"marker": "o", "markersize": 10 * scale, "linestyle": "none", "color": ACCEPTED_COLOUR}
    return look | {"markerfacecolor": "none", "markeredgewidth": scale}


def _marker(part: Part, scale: float) -> dict[str, Any]:
    """Return the look of the landmarks of a part."""
    face = part.colour if part.marker == "x" else "none"
    size = 2.5 if part.colour == FUSED_COLOUR else 4.0  # fused landmarks have small ellipses
    look = {"marker": part.marker, "markersize": size * scale, "linestyle": "none"}
    return look | {"color": part.colour, "markeredgewidth": 0.8 * scale, "markerfacecolor": face}


def _draw(
    axes: Axes, plan: Plan, title: str, size_in: tuple[float, float], scale: float, factor: int
) -> None:
    """Draw one plan.

    Args:
        axes: axes of the plan.
        plan: what is drawn.
        title: its title in lines.
        size_in: width and height of the axes, which the view fills.
        scale: factor of the sizes of markers and lines.
        factor: factor of the ellipses.
    """
    from matplotlib.collections import LineCollection

    for name, colour, width, style in _LINKS:
        look = {"colors": colour, "linewidths": width * scale, "linestyles": style, "zorder": 2}
        axes.add_collection(LineCollection(list(getattr(plan, name)), **look), autolim=False)
    if len(plan.accepted):  # ends that coincide have no visible line
        axes.plot(*plan.accepted.mean(axis=1).T, **_ring(scale), zorder=2)
    for part in plan.parts:
        look = {"edgecolors": part.colour, "linewidths": 0.6 * scale, "alpha": 0.7, "zorder": 3}
        add_ellipses(axes, part.position_m, factor**2 * part.covariance_m2, **look)
        axes.plot(*part.position_m.T, **_marker(part, scale), zorder=4)
    low, high = bounds(plan)
    metres_an_inch = float(((high - low) / size_in).max())
    middle, half = (low + high) / 2, metres_an_inch * np.array(size_in) / 2
    (x0, y0), (x1, y1) = middle - half, middle + half
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    centre = (1 - _LEFT_IN / size_in[0]) / 2  # of the axes with its labels, which has more room
    axes.set_title(title, x=centre, fontsize=_TITLE_POINTS if scale == 1.0 else _SMALL_TITLE_POINTS)


def semi_axes(covariance_m2: Float, level: float = _LEVEL) -> tuple[Float, Float, Float]:
    """Compute the error ellipses that contain a share `level` of a normal distribution.

    The squared Mahalanobis distance of a normal point is chi-square with two degrees of freedom, so
    the semi-axes are sqrt(eigenvalue * quantile), along the eigenvectors.

    Args:
        covariance_m2: covariances, shape (N, 2 or more, 2 or more).
        level: probability of the ellipses.

    Returns:
        Semi-major axes (N,) and semi-minor axes (N,) in metres; direction of the major axis (N,)
        in rad.
    """
    values, vectors = np.linalg.eigh(covariance_m2[:, :2, :2])
    lengths = np.sqrt(np.maximum(values, 0.0) * chi_square_bound(level, _PLANE_DIMENSIONS))
    direction = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    return lengths[:, 1], lengths[:, 0], direction


def add_ellipses(axes: Axes, position_m: Float, covariance_m2: Float, **style: Any) -> None:
    """Draw 95 % ellipses to scale, from positions (N, 2 or 3) and covariances."""
    from matplotlib.collections import EllipseCollection

    major, minor, direction = semi_axes(covariance_m2)
    place = {"units": "xy", "offsets": position_m[:, :2], "offset_transform": axes.transData}
    sizes = (2 * major, 2 * minor, np.degrees(direction))
    collection = EllipseCollection(*sizes, facecolors="none", **place, **style)
    axes.add_collection(collection, autolim=False)


def ellipse_handle(colour: str, factor: int = 1) -> Line2D:
    """Return the legend entry of the ellipses, with their level."""
    from matplotlib.lines import Line2D

    style = {"marker": "o", "markerfacecolor": "none", "markersize": 7, "linestyle": "none"}
    label = f"{LEVEL_TEXT} ellipses, {f'{factor} x enlarged' if factor > 1 else 'to scale'}"
    return Line2D([], [], color=colour, label=label, **style)
