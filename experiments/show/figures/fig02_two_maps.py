"""Figure 2: the maps of two robots that know nothing of each other, each in its own frame."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.show.figures.ellipses import add_ellipses, ellipse_handle
from experiments.show.figures.floor_plan import (
    add_frame,
    add_walls,
    height_of_row,
    label_plan,
    legend_height,
    set_view,
)
from experiments.show.figures.result_tables import NothingToDraw, ResultTables
from experiments.show.figures.style import BLACK, GRAY, PAGE_WIDTH_IN, PURPLE, robot_colours

_LEGEND_COLUMNS = 3


def draw(data: ResultTables) -> Figure:
    """Landmarks with their ellipses, the best particle's path and the last particles."""
    robots = [robot for robot in data.robots if len(data.landmarks_of(robot)[0])][:2]
    if not robots:
        raise NothingToDraw("no robot has a landmark in its map")
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    panels = figure.subplots(1, len(robots), squeeze=False)[0]
    for axes, robot in zip(panels, robots, strict=True):
        _draw_map(axes, data, robot)
    handles, _ = panels[0].get_legend_handles_labels()
    handles.insert(1, ellipse_handle(robot_colours(data.robots)[robots[0]]))
    figure.legend(handles=handles, loc="outside lower center", ncols=_LEGEND_COLUMNS)
    row = height_of_row(panels, PAGE_WIDTH_IN / len(panels))
    figure.set_figheight(row + legend_height(len(handles), _LEGEND_COLUMNS))
    return figure


def _draw_map(axes: Axes, data: ResultTables, robot: str) -> None:
    position, covariance = data.landmarks_of(robot)
    path = data.path_of(robot)
    colour = robot_colours(data.robots)[robot]
    walls = data.walls_in_frame_of(robot)
    add_walls(axes, walls)
    axes.plot(
        position[:, 0],
        position[:, 1],
        linestyle="none",
        marker=".",
        markersize=1.5,
        color=colour,
        label="landmarks",
        rasterized=True,
        zorder=2,
    )
    add_ellipses(
        axes,
        position,
        covariance,
        edgecolors=colour,
        linewidths=0.4,
        alpha=0.6,
        rasterized=True,
        zorder=2,
    )
    axes.plot(path[:, 0], path[:, 1], color=GRAY, label="path of the best particle", zorder=3)
    axes.plot(0, 0, linestyle="none", marker="o", color=BLACK, label="start pose, the map's frame")
    cloud = data.table("clouds")
    cloud = cloud[cloud["robot"] == robot]
    last = cloud[cloud["iteration"] == cloud["iteration"].max()]
    axes.plot(
        last["x_m"],
        last["y_m"],
        linestyle="none",
        marker=".",
        markersize=2.0,
        color=PURPLE,
        label="particles at the end",
        rasterized=True,
        zorder=5,
    )
    add_frame(axes)
    outside = set_view(axes, position, path, *walls)
    label_plan(axes, robot)
    note = f", {outside} out of view" if outside else ""
    axes.set_title(f"{robot}: {len(position)} landmarks{note}")
