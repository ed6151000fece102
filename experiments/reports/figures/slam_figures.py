"""Figures of one robot's filter: tracked points (figure 1) and particle dispersion (figure 3)."""

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.image
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.evaluation.loop_closures import WINDOW_FRAMES, LoopClosure, loop_closures
from experiments.reports.figures import style as plan
from experiments.reports.figures.result_tables import NothingToDraw, ResultTables, read_png
from experiments.reports.figures.style import BLACK, GRAY, PAGE_WIDTH_IN

_MAX_FRAMES, _TRAIL_FRAMES = 4, 5
_KEY_FRAME = re.compile(r"(?P<robot>.+)_(?P<iteration>\d+)\.png")

_MAX_ROBOTS = 3
_ZOOM_MARGIN = 1.25
_GRID_COLUMNS = 6  # divisible into one, two or three panels of equal width
_LOWER_ROW_IN = 2.6
_HEADROOM = 0.5  # space for the legend above the spread, as a share of the spread
_PLANE = ["x_m", "y_m"]


class ClosureSnapshots(NamedTuple):
    """Loop closure of a robot, and the stored iterations before and after it."""

    closure: LoopClosure
    before: int
    after: int


def draw_tracks(data: ResultTables) -> Figure:
    """Draw the last consecutive key frames of one robot; colours give the age of each track."""
    # end of the longest run of consecutive key frames of one robot
    robot, best = "", {}
    named = [(_KEY_FRAME.fullmatch(p.name), p) for p in (data.folder / "keyframes").glob("*.png")]
    for each in data.robots:
        run: dict[int, Path] = {}
        own = {int(m["iteration"]): file for m, file in named if m and m["robot"] == each}
        for k, file in sorted(own.items()):
            run = (run if k - 1 in run else {}) | {k: file}
            if len(run) > len(best):
                robot, best = each, run
    if not best:
        raise NothingToDraw("no key frames were kept: no images, or none from `keep.images_at` on")
    frames = dict(list(best.items())[-_MAX_FRAMES:])
    tracks = data.of_robot("tracks", robot)
    shown = tracks[tracks["iteration"].isin(list(frames))]
    if shown.empty:
        raise NothingToDraw(f"no tracked points at {robot}'s key frames")
    columns = min(2, len(frames))
    rows = -(-len(frames) // columns)
    figure = Figure(figsize=(PAGE_WIDTH_IN, 2.55 * rows * 2 / columns + 0.5))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    colours = ScalarMappable(Normalize(1, max(2, shown["length"].max())), "viridis")
    for axes, (iteration, path) in zip(panels, frames.items(), strict=False):
        image = matplotlib.image.imread(io.BytesIO(read_png(path)))
        axes.imshow(image, cmap="gray", vmin=0, vmax=1)
        axes.autoscale(enable=False)  # points near the border must not widen the view
        axes.grid(visible=False)
        now = tracks[tracks["iteration"] == iteration]
        if len(now):
            # Trails of the points over the last frames, and the points
            since = tracks["iteration"].between(iteration - _TRAIL_FRAMES, iteration)
            recent = tracks[tracks["track"].isin(now["track"]) & since]
            recent = recent.sort_values("track", kind="stable")
            track = recent["track"].to_numpy()
            ends = np.flatnonzero(np.append(track[1:] != track[:-1], True))
            trails = np.split(recent[["u_px", "v_px"]].to_numpy(), ends[:-1] + 1)
            ages = recent["length"].to_numpy(np.float64)[ends]
            by_age: dict[str, Any] = {"cmap": colours.cmap, "norm": colours.norm, "zorder": 2}
            lines = LineCollection(trails, array=ages, linewidths=1.2, **by_age)
            axes.add_collection(lines, autolim=False)
            rim = {"s": 14, "edgecolors": "white", "linewidths": 0.5}
            axes.scatter(now["u_px"], now["v_px"], c=now["length"], **rim, **by_age | {"zorder": 3})
        axes.set_title(f"{robot}, k = {iteration}")
    for axes in panels[len(frames) :]:
        axes.set_axis_off()
    figure.supxlabel("u (pixels)", fontsize=8)
    figure.supylabel("v (pixels)", fontsize=8)
    scale = {"label": "age of the track (frames)", "ticks": MaxNLocator(integer=True)}
    figure.colorbar(colours, ax=list(panels), shrink=0.8, aspect=30, **scale)
    return figure


def draw_dispersion(data: ResultTables) -> Figure:
    """Draw the particles along up to three paths, and their spread before and after a closure."""
    clouds = data.table("clouds")
    robots = [robot for robot in data.robots if (clouds["robot"] == robot).any()][:_MAX_ROBOTS]
    if not robots:
        raise NothingToDraw("no particles were kept")
    spread = spread_over_time(clouds[clouds["robot"].isin(robots)])
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    grid = figure.add_gridspec(2, _GRID_COLUMNS)
    span = _GRID_COLUMNS // max(2, len(robots))
    start = (_GRID_COLUMNS - span * len(robots)) // 2
    # All particle sets are enlarged by one factor so that they are visible beside the paths.
    extent_m = min(np.ptp(data.path_of(robot), axis=0).max() for robot in robots)
    sets = clouds[clouds["robot"].isin(robots)].groupby(["robot", "iteration"])[_PLANE]
    widest_m = (sets.max() - sets.min()).to_numpy().max()
    magnification = plan.magnification(float(extent_m), float(widest_m))
    panels: dict[str, Axes] = {}
    for robot in robots:
        panels[robot] = figure.add_subplot(grid[0, start : start + span])
        _draw_path(panels[robot], data, robot, magnification)
        start += span
    timeline, *zooms = (figure.add_subplot(grid[1, start : start + 2]) for start in (0, 2, 4))
    for robot, rows in spread.groupby("robot", sort=False):
        style = {"color": data.colours[str(robot)], "linewidth": 0.8, "label": robot}
        timeline.plot(rows["iteration"], rows["spread_m"], **style)
    timeline.set(xlabel="FastSLAM iteration k", ylabel="spread of the particles (m)")
    timeline.margins(y=_HEADROOM)
    timeline.set_ylim(bottom=0)
    timeline.legend(loc="upper right")
    timeline.set_title("spread over time")
    closures = loop_closures(data.rows("sightings"), spread)
    snapshots = choose_snapshots(closures, spread)
    figure.set_label(_closure_caption(data, snapshots))
    if snapshots is None:
        for axes in zooms:
            axes.set_axis_off()
    else:
        robot = snapshots.closure.robot
        spread_m = spread[spread["robot"] == robot].set_index("iteration")["spread_m"]
        # mark the sets before and after the closure as A and B, on the path and the time line
        box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "linewidth": 0.5}
        look: dict[str, Any] = {"textcoords": "offset points", "fontweight": "bold"}
        boxed = {"bbox": box, "arrowprops": {"arrowstyle": "-", "linewidth": 0.8}, "zorder": 7}
        for name, k, side in zip("AB", snapshots[1:], (9, -15), strict=True):
            x, y = data.path_of(robot)[k]
            panels[robot].annotate(name, xy=(x, y), xytext=(side, 9), **look, **boxed)
            timeline.plot(k, spread_m[k], "o", color=BLACK, zorder=4)
            timeline.annotate(name, xy=(k, spread_m[k]), xytext=(3, 3), **look)
        _draw_zooms(zooms, data, spread_m, snapshots)
    upper = plan.height_of_row(list(panels.values()), PAGE_WIDTH_IN * span / _GRID_COLUMNS)
    grid.set_height_ratios([upper, _LOWER_ROW_IN])
    figure.set_figheight(upper + _LOWER_ROW_IN)
    return figure


def spread_over_time(clouds: pd.DataFrame) -> pd.DataFrame:
    """Return the RMS distance of the particles from their mean: robot, iteration, spread_m.

    Particles are not weighted, because the figure shows the particle set itself.
    """
    variance = clouds.groupby(["robot", "iteration"], sort=False)[_PLANE].var(ddof=0)
    return variance.sum(axis="columns").pow(0.5).rename("spread_m").reset_index()


def choose_snapshots(
    closures: Sequence[LoopClosure], spread: pd.DataFrame
) -> ClosureSnapshots | None:
    """Return a moment before and one after the loop closure with the largest fall of the spread.

    In each window the stored iteration with the median spread is chosen, because the spread of a
    single frame varies with the resampling. Return None without a loop closure.

    Args:
        closures: loop closures of the robots.
        spread: rows of `spread_over_time`.
    """
    measured = [
        closure_of_robot
        for closure_of_robot in closures
        if min(closure_of_robot.before_m, closure_of_robot.after_m) > 0
    ]
    if not measured:
        return None
    closure = min(
        measured, key=lambda closure_of_robot: closure_of_robot.after_m / closure_of_robot.before_m
    )
    spread_of_robot = spread[spread["robot"] == closure.robot].set_index("iteration")["spread_m"]
    k = closure.iteration
    windows = ((k - WINDOW_FRAMES, k - 1), (k, k + WINDOW_FRAMES - 1))
    windows_spread = (
        spread_of_robot[(spread_of_robot.index >= first) & (spread_of_robot.index <= last)]
        for first, last in windows
    )
    before, after = (
        closure_of_robot.sort_values().index[len(closure_of_robot) // 2]
        for closure_of_robot in windows_spread
    )
    return ClosureSnapshots(closure, int(before), int(after))


def _closure_caption(data: ResultTables, snapshots: ClosureSnapshots | None) -> str:
    """Return the part of the caption about the loop closure."""
    if not data.has("sightings"):
        return "The result was made before loop closures were stored."
    if snapshots is None:
        return "No robot closes a loop: none comes back to its landmarks after new ground."
    closure = snapshots.closure
    before_mm, after_mm = (1e3 * value for value in (closure.before_m, closure.after_m))
    text = (
        f"{closure.robot} closes a loop at k = {closure.iteration}: {closure.n_returned} landmarks "
        f"come back into view in {WINDOW_FRAMES} iterations. A is a particle set before it, B one "
        f"after it. The median spread of the {WINDOW_FRAMES} iterations before and after is "
        f"{before_mm:.2g} and {after_mm:.2g} mm"
    )
    return f"{text}." if after_mm < before_mm else f"{text}; it does not fall."


def _draw_path(axes: Axes, data: ResultTables, robot: str, magnification: int) -> None:
    """Draw the path of one robot and its enlarged particle sets."""
    path, walls = data.path_of(robot), data.walls_in_frame_of(robot)
    plan.start_plan(axes, robot, walls)
    axes.plot(*path.T, color=GRAY, linewidth=0.7, zorder=2)
    style = {"marker": ".", "markersize": 1.0, "color": data.colours[robot], "zorder": 3}
    clouds = data.of_robot("clouds", robot)  # ordered by iteration
    set_ends = np.flatnonzero(np.diff(clouds["iteration"])) + 1
    sets = np.split(clouds[_PLANE].to_numpy(), set_ends)
    centers = (particles.mean(axis=0) for particles in sets)
    enlarged = [c + magnification * (p - c) for c, p in zip(centers, sets, strict=True)]
    plan.add_points(axes, np.concatenate(enlarged), **style)
    plan.add_frame(axes, length_m=1.5)
    plan.set_view(axes, path[:0], path, walls)
    scale = f", spread x{magnification}" if magnification > 1 else ""
    axes.set_title(f"{robot}: particles{scale}")


def _draw_zooms(
    zooms: list[Axes], data: ResultTables, spread_m: pd.Series, snapshots: ClosureSnapshots
) -> None:
    """Draw the particle sets before and after the closure at the same scale."""
    closure, *iterations = snapshots
    robot = closure.robot
    clouds = data.of_robot("clouds", robot).set_index("iteration")[_PLANE]
    sightings = data.of_robot("sightings", robot).set_index("iteration")
    sets = [clouds.loc[[k]].to_numpy() for k in iterations]
    reach = _ZOOM_MARGIN * max(float(np.abs(p - p.mean(axis=0)).max()) for p in sets)
    style = {"marker": ".", "markersize": 2.5, "alpha": 0.7, "color": data.colours[robot]}
    names = ("A, before", "B, after")
    for axes, name, k, particles in zip(zooms, names, iterations, sets, strict=True):
        axes.plot(*data.path_of(robot).T, color=GRAY, zorder=1)
        plan.add_points(axes, particles, **style)
        plan.set_square(axes, particles.mean(axis=0), reach)
        axes.locator_params(nbins=4)
        plan.label_plan(axes, robot)
        recent = sightings.loc[max(0, k - WINDOW_FRAMES + 1) : k, ["n_new", "n_returned"]].sum()
        title = f"{name}: k = {k}, spread {1e3 * spread_m[k]:.1f} mm\n"
        # Two lines: the panels are narrow, and the last one ends at the edge of the page.
        title += f"{recent['n_new']} new landmarks, {recent['n_returned']} came back"
        axes.set_title(title, fontsize=6.5)
