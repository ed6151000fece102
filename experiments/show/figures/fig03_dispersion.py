"""Figure 3: how the particle set spreads along the paths, and draws together again."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.show.figures.floor_plan import (
    add_frame,
    add_points,
    height_of_row,
    label_plan,
    set_square,
    set_view,
    start_plan,
)
from experiments.show.figures.result_tables import NothingToDraw, ResultTables
from experiments.show.figures.style import BLACK, GRAY, PAGE_WIDTH_IN

_MAX_ROBOTS = 3
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)
_WIDEST_SHARE = 1 / 10  # of the map's extent that the widest drawn particle set may take
_ZOOM_MARGIN = 1.25
_RECENT_ITERATIONS = 50
_FRAME_LENGTH_M = 1.5
_GRID_COLUMNS = 6  # holds one, two or three panels of one width
_LOWER_ROW_IN = 2.6
_NO_LANDMARKS = np.empty((0, 3))


class Moments(NamedTuple):
    """Two kept iterations of one robot."""

    robot: str
    wide: int
    tight: int

    @property
    def named(self) -> tuple[tuple[str, int], ...]:
        """As they are marked in the figure."""
        return ("A", self.wide), ("B", self.tight)


def draw(data: ResultTables) -> Figure:
    """Particles along up to three paths, the spread over time, and a wide and a tight moment."""
    clouds = data.table("clouds")
    robots = [robot for robot in data.robots if (clouds["robot"] == robot).any()][:_MAX_ROBOTS]
    if not robots:
        raise NothingToDraw("no particles were kept")
    spread = spread_over_time(clouds[clouds["robot"].isin(robots)])
    moments = choose_moments(spread)
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    grid = figure.add_gridspec(2, _GRID_COLUMNS)
    span = _GRID_COLUMNS // max(2, len(robots))
    first = (_GRID_COLUMNS - span * len(robots)) // 2
    panels = [
        figure.add_subplot(grid[0, first + i * span : first + (i + 1) * span])
        for i in range(len(robots))
    ]
    magnification = _magnification(data, robots)
    for axes, robot in zip(panels, robots, strict=True):
        _draw_path(axes, data, robot, magnification)
        if moments is not None and robot == moments.robot:
            _mark_on_path(axes, data, moments)
    timeline, *zooms = (
        figure.add_subplot(grid[1, column : column + 2]) for column in range(0, _GRID_COLUMNS, 2)
    )
    _draw_timeline(timeline, data, spread, moments)
    if moments is None:
        for axes in zooms:
            axes.set_axis_off()
    else:
        _draw_zooms(zooms, data, spread, moments)
    upper = height_of_row(panels, PAGE_WIDTH_IN * span / _GRID_COLUMNS)
    grid.set_height_ratios([upper, _LOWER_ROW_IN])
    figure.set_figheight(upper + _LOWER_ROW_IN)
    return figure


def spread_over_time(clouds: pd.DataFrame) -> pd.DataFrame:
    """Root mean square distance of the particles from their mean, all particles counted alike.

    Alike, because it is the particle set that is drawn; the weights of one iteration come on top.

    Returns:
        Columns robot, iteration, spread_m.
    """
    groups = clouds.groupby(["robot", "iteration"], sort=False)[["x_m", "y_m"]]
    variance = groups.var(ddof=0).sum(axis="columns")
    return variance.pow(0.5).rename("spread_m").reset_index()


def choose_moments(spread: pd.DataFrame) -> Moments | None:
    """The pair of moments between which one robot's particles drew together the most.

    Wide comes before tight, so the fall is what seeing old ground again did. None when no robot's
    particles ever did.
    """
    best, best_ratio = None, 1.0
    for robot, rows in spread[spread["spread_m"] > 0].groupby("robot", sort=False):
        values, iteration = rows["spread_m"].to_numpy(), rows["iteration"].to_numpy()
        ratio = np.maximum.accumulate(values) / values
        tight = int(np.argmax(ratio))
        if ratio[tight] > best_ratio:
            best_ratio = ratio[tight]
            wide = int(np.argmax(values[:tight]))
            best = Moments(str(robot), int(iteration[wide]), int(iteration[tight]))
    return best


def _magnification(data: ResultTables, robots: list[str]) -> int:
    """The largest round factor at which the particle sets still look like spots on the paths."""
    extent = min(float(np.ptp(data.path_of(robot)[:, :2], axis=0).max()) for robot in robots)
    sets = [data.clouds_of(robot).groupby("iteration")[["x_m", "y_m"]] for robot in robots]
    widest = max(float((each.max() - each.min()).to_numpy().max()) for each in sets)
    fitting = [m for m in _MAGNIFICATIONS if m * widest <= _WIDEST_SHARE * extent]
    return max(fitting, default=1)


def _draw_path(axes: Axes, data: ResultTables, robot: str, magnification: int) -> None:
    path = data.path_of(robot)
    walls = start_plan(axes, data, robot)
    axes.plot(*path[:, :2].T, color=GRAY, linewidth=0.7, zorder=2)
    style = {"marker": ".", "markersize": 1.0, "color": data.colours[robot], "zorder": 3}
    for _, rows in data.clouds_of(robot).groupby("iteration"):
        points = rows[["x_m", "y_m"]].to_numpy()
        mean = points.mean(axis=0)
        add_points(axes, mean + magnification * (points - mean), **style)
    add_frame(axes, _FRAME_LENGTH_M)
    set_view(axes, _NO_LANDMARKS, path, *walls)
    enlarged = f", spread x{magnification}" if magnification > 1 else ""
    axes.set_title(f"{robot}: particles{enlarged}")


def _mark_on_path(axes: Axes, data: ResultTables, moments: Moments) -> None:
    path = data.path_of(moments.robot)
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "linewidth": 0.5}
    look = {"bbox": box, "arrowprops": {"arrowstyle": "-", "linewidth": 0.8}, "zorder": 7}
    for (name, k), offset in zip(moments.named, ((9, 9), (-15, 9)), strict=True):
        _annotate(axes, name, tuple(path[k, :2]), offset, **look)


def _annotate(
    axes: Axes, name: str, at: tuple[Any, ...], offset: tuple[int, int], **look: Any
) -> None:
    look |= {"textcoords": "offset points", "fontweight": "bold"}
    axes.annotate(name, xy=(at[0], at[1]), xytext=offset, **look)


def _draw_timeline(
    axes: Axes, data: ResultTables, spread: pd.DataFrame, moments: Moments | None
) -> None:
    for robot, rows in spread.groupby("robot", sort=False):
        style = {"color": data.colours[str(robot)], "linewidth": 0.8, "label": robot}
        axes.plot(rows["iteration"], rows["spread_m"], **style)
    if moments is not None:
        spread_m = spread[spread["robot"] == moments.robot].set_index("iteration")["spread_m"]
        for name, k in moments.named:
            at = (k, spread_m[k])
            axes.plot(*at, "o", color=BLACK, zorder=4)
            _annotate(axes, name, at, (3, 3))
    axes.set_xlabel("FastSLAM iteration k")
    axes.set_ylabel("spread of the particles (m)")
    axes.set_ylim(bottom=0)
    axes.margins(y=0.15)
    axes.legend(loc="best")
    axes.set_title("spread over time")


def _draw_zooms(
    zooms: list[Axes], data: ResultTables, spread: pd.DataFrame, moments: Moments
) -> None:
    """Both moments at one scale, so that tight looks tight."""
    robot, path = moments.robot, data.path_of(moments.robot)
    clouds, slam = data.clouds_of(robot), data.table("robots")
    spread_m = spread[spread["robot"] == robot].set_index("iteration")["spread_m"]
    n_landmarks = slam[slam["robot"] == robot].set_index("iteration")["n_landmarks"]
    points = [clouds[clouds["iteration"] == k][["x_m", "y_m"]].to_numpy() for k in moments[1:]]
    reach = _ZOOM_MARGIN * max(float(np.abs(p - p.mean(axis=0)).max()) for p in points)
    style = {"marker": ".", "markersize": 2.5, "alpha": 0.7, "color": data.colours[robot]}
    for axes, particles, (name, k), kind in zip(
        zooms, points, moments.named, ("wide", "tight"), strict=True
    ):
        axes.plot(*path[:, :2].T, color=GRAY, zorder=1)
        add_points(axes, particles, **style)
        set_square(axes, particles.mean(axis=0), reach)
        axes.locator_params(nbins=4)
        label_plan(axes, robot)
        # much in new territory, little on known ground
        grown = n_landmarks[k] - n_landmarks[max(0, k - _RECENT_ITERATIONS)]
        axes.set_title(
            f"{name}, {kind}: k = {k}, spread {spread_m[k]:.3f} m\n"
            f"+{grown} landmarks in {_RECENT_ITERATIONS} iterations",
            fontsize=7.5,
        )
