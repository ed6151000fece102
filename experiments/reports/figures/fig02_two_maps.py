"""Figure 2: the maps of two robots that know nothing of each other, each in its own frame."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.reports.figures import floor_plan as plan
from experiments.reports.figures.result_tables import NothingToDraw, ResultTables
from experiments.reports.figures.style import BLACK, GRAY, PAGE_WIDTH_IN
from mapfusion.geometry.numerics import Float

READS = ("clouds", "landmarks", "paths", "robots", "scenario", "smoothed_paths")


def draw(data: ResultTables) -> Figure:
    """Landmarks with their ellipses, paths of best particle and smoother, the last particles."""
    robots = [robot for robot in data.robots if len(data.landmarks_of(robot)[0])][:2]
    if not robots:
        raise NothingToDraw("no robot has a landmark in its map")
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    panels = figure.subplots(1, len(robots), squeeze=False)[0]
    enlarged = _magnification(data, robots)
    for axes, robot in zip(panels, robots, strict=True):
        _draw_map(axes, data, robot, enlarged)
    plan.set_one_scale(panels)
    handles, _ = panels[0].get_legend_handles_labels()
    handles.insert(1, plan.ellipse_handle(data.colours[robots[0]]))
    plan.finish_plans(figure, panels, handles, 3)
    return figure


def _last_particles(data: ResultTables, robot: str) -> Float:
    clouds = data.of_robot("clouds", robot)
    last = clouds["iteration"] == clouds["iteration"].max()
    return clouds.loc[last, ["x_m", "y_m"]].to_numpy()


def _magnification(data: ResultTables, robots: list[str]) -> int:
    extent = min(
        float(np.ptp(data.landmarks_of(robot)[0][:, :2], axis=0).max()) for robot in robots
    )
    sets = [points for robot in robots if len(points := _last_particles(data, robot))]
    return plan.magnification(
        extent, max((float(np.ptp(p, axis=0).max()) for p in sets), default=0)
    )


def _draw_map(axes: Axes, data: ResultTables, robot: str, enlarged: int) -> None:
    position, covariance = data.landmarks_of(robot)
    path, colour = data.path_of(robot), data.colours[robot]
    walls = plan.start_plan(axes, data, robot)
    points = {"marker": ".", "markersize": 1.5, "color": colour, "zorder": 2}
    plan.add_points(axes, position, label="landmarks", **points)
    ellipses = {"edgecolors": colour, "linewidths": 0.4, "alpha": 0.6, "zorder": 2}
    plan.add_ellipses(axes, position, covariance, rasterized=True, **ellipses)
    axes.plot(*path.T, color=GRAY, label="path of the best particle", zorder=3)
    if len(smoothed := data.smoothed_path_of(robot)):
        axes.plot(*smoothed.T, color=BLACK, linewidth=0.5, label="path of the smoother", zorder=4)
    axes.plot(0, 0, linestyle="none", marker="o", color=BLACK, label="start pose, the map's frame")
    last = _last_particles(data, robot)
    middle = last.mean(axis=0) if len(last) else 0.0
    points = {"marker": ".", "markersize": 2.5, "markeredgewidth": 0, "color": BLACK, "zorder": 5}
    label = "particles at the end" + (f", spread x{enlarged}" if enlarged > 1 else "")
    plan.add_points(axes, middle + enlarged * (last - middle), label=label, **points)
    plan.add_frame(axes)
    counted = plan.set_view(axes, position, path, walls)
    axes.set_title(f"{robot}: {counted}\n({data.sightings})")
