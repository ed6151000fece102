"""Figure 3: how the particle set spreads along the paths, and draws together again."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.reports.figures import floor_plan as plan
from experiments.reports.figures.result_tables import NothingToDraw, ResultTables
from experiments.reports.figures.style import BLACK, GRAY, PAGE_WIDTH_IN

READS = ("clouds", "paths", "robots")
_MAX_ROBOTS = 3
_ZOOM_MARGIN = 1.25
_RECENT_ITERATIONS = 50
_GRID_COLUMNS = 6  # holds one, two or three panels of one width
_LOWER_ROW_IN = 2.6
_HEADROOM = 0.5  # above the spread over time, as a share of it, for the legend
_PLANE = ["x_m", "y_m"]
Moments = tuple[str, int, int]  # a robot, and a wide and a tight iteration of it: A and B


def draw(data: ResultTables) -> Figure:
    """Particles along up to three paths, the spread over time, and a wide and a tight moment."""
    clouds = data.table("clouds")
    robots = [robot for robot in data.robots if (clouds["robot"] == robot).any()][:_MAX_ROBOTS]
    if not robots:
        raise NothingToDraw("no particles were kept")
    spread = spread_over_time(clouds[clouds["robot"].isin(robots)])
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    grid = figure.add_gridspec(2, _GRID_COLUMNS)
    span = _GRID_COLUMNS // max(2, len(robots))
    start = (_GRID_COLUMNS - span * len(robots)) // 2
    magnification = _magnification(data, robots)
    panels: dict[str, Axes] = {}
    for robot in robots:
        panels[robot] = figure.add_subplot(grid[0, start : start + span])
        _draw_path(panels[robot], data, robot, magnification)
        start += span
    timeline, *zooms = (figure.add_subplot(grid[1, start : start + 2]) for start in (0, 2, 4))
    _draw_timeline(timeline, data, spread)
    moments = choose_moments(spread)
    if moments is None:
        for axes in zooms:
            axes.set_axis_off()
    else:
        robot = moments[0]
        spread_m = spread[spread["robot"] == robot].set_index("iteration")["spread_m"]
        _mark(panels[robot], timeline, data.path_of(robot), spread_m, moments)
        _draw_zooms(zooms, data, spread_m, moments)
    upper = plan.height_of_row(list(panels.values()), PAGE_WIDTH_IN * span / _GRID_COLUMNS)
    grid.set_height_ratios([upper, _LOWER_ROW_IN])
    figure.set_figheight(upper + _LOWER_ROW_IN)
    return figure


def spread_over_time(clouds: pd.DataFrame) -> pd.DataFrame:
    """Root mean square distance of the particles from their mean: robot, iteration, spread_m.

    All particles counted alike, as it is the particle set that is drawn; the weights of one
    iteration come on top.
    """
    variance = clouds.groupby(["robot", "iteration"], sort=False)[_PLANE].var(ddof=0)
    return variance.sum(axis="columns").pow(0.5).rename("spread_m").reset_index()


def choose_moments(spread: pd.DataFrame) -> Moments | None:
    """The moments between which one robot's particles drew together the most; None if none did.

    Wide comes before tight, so the fall is what seeing old ground again did.
    """
    best, best_ratio = None, 1.0
    for robot, rows in spread[spread["spread_m"] > 0].groupby("robot", sort=False):
        values, iteration = rows["spread_m"].to_numpy(), rows["iteration"].to_numpy()
        ratio = np.maximum.accumulate(values) / values
        tight = int(np.argmax(ratio))
        if ratio[tight] > best_ratio:
            best_ratio = ratio[tight]
            wide = int(np.argmax(values[:tight]))
            best = (str(robot), int(iteration[wide]), int(iteration[tight]))
    return best


def _magnification(data: ResultTables, robots: list[str]) -> int:
    """By how much all particle sets are drawn larger, so that they can be seen on the paths."""
    extent = min(np.ptp(data.path_of(robot), axis=0).max() for robot in robots)
    clouds = data.table("clouds")
    sets = clouds[clouds["robot"].isin(robots)].groupby(["robot", "iteration"])[_PLANE]
    widest = (sets.max() - sets.min()).to_numpy().max()
    return plan.magnification(float(extent), float(widest))


def _draw_path(axes: Axes, data: ResultTables, robot: str, magnification: int) -> None:
    path, walls = data.path_of(robot), plan.start_plan(axes, data, robot)
    axes.plot(*path.T, color=GRAY, linewidth=0.7, zorder=2)
    style = {"marker": ".", "markersize": 1.0, "color": data.colours[robot], "zorder": 3}
    clouds = data.of_robot("clouds", robot)  # ordered by iteration
    ends = np.flatnonzero(np.diff(clouds["iteration"])) + 1
    sets = np.split(clouds[_PLANE].to_numpy(), ends)
    enlarged = [own.mean(axis=0) + magnification * (own - own.mean(axis=0)) for own in sets]
    plan.add_points(axes, np.concatenate(enlarged), **style)
    plan.add_frame(axes, length_m=1.5)
    plan.set_view(axes, path[:0], path, walls)
    said = f", spread x{magnification}" if magnification > 1 else ""
    axes.set_title(f"{robot}: particles{said}")


def _draw_timeline(axes: Axes, data: ResultTables, spread: pd.DataFrame) -> None:
    for robot, rows in spread.groupby("robot", sort=False):
        style = {"color": data.colours[str(robot)], "linewidth": 0.8, "label": robot}
        axes.plot(rows["iteration"], rows["spread_m"], **style)
    axes.set(xlabel="FastSLAM iteration k", ylabel="spread of the particles (m)")
    axes.margins(y=_HEADROOM)
    axes.set_ylim(bottom=0)
    axes.legend(loc="upper right")
    axes.set_title("spread over time")


def _mark(
    on_path: Axes, timeline: Axes, path: np.ndarray, spread_m: pd.Series, moments: Moments
) -> None:
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "linewidth": 0.5}
    look: dict[str, Any] = {"textcoords": "offset points", "fontweight": "bold"}
    boxed = {"bbox": box, "arrowprops": {"arrowstyle": "-", "linewidth": 0.8}, "zorder": 7}
    for name, k, side in zip("AB", moments[1:], (9, -15), strict=True):
        x, y = path[k]
        on_path.annotate(name, xy=(x, y), xytext=(side, 9), **look, **boxed)
        timeline.plot(k, spread_m[k], "o", color=BLACK, zorder=4)
        timeline.annotate(name, xy=(k, spread_m[k]), xytext=(3, 3), **look)


def _draw_zooms(
    zooms: list[Axes], data: ResultTables, spread_m: pd.Series, moments: Moments
) -> None:
    """Both moments at one scale, so that tight looks tight."""
    robot, *iterations = moments
    clouds = data.of_robot("clouds", robot).set_index("iteration")[_PLANE]
    n_landmarks = data.of_robot("robots", robot).set_index("iteration")["n_landmarks"]
    sets = [clouds.loc[[k]].to_numpy() for k in iterations]
    reach = _ZOOM_MARGIN * max(float(np.abs(p - p.mean(axis=0)).max()) for p in sets)
    style = {"marker": ".", "markersize": 2.5, "alpha": 0.7, "color": data.colours[robot]}
    names = ("A, wide", "B, tight")
    for axes, name, k, particles in zip(zooms, names, iterations, sets, strict=True):
        axes.plot(*data.path_of(robot).T, color=GRAY, zorder=1)
        plan.add_points(axes, particles, **style)
        plan.set_square(axes, particles.mean(axis=0), reach)
        axes.locator_params(nbins=4)
        plan.label_plan(axes, robot)
        # much in new territory, little on known ground
        grown = n_landmarks[k] - n_landmarks[max(0, k - _RECENT_ITERATIONS)]
        title = f"{name}: k = {k}, spread {1e3 * spread_m[k]:.1f} mm\n"
        # the panels are narrow, and the last one ends at the page's edge
        title += f"+{grown} landmarks in {_RECENT_ITERATIONS} iterations"
        axes.set_title(title, fontsize=6.5)
