"""Figure 2: the maps of two robots that know nothing of each other, each in its own frame."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.show.figures import floor_plan as plan
from experiments.show.figures.result_tables import NothingToDraw, ResultTables
from experiments.show.figures.style import BLACK, GRAY, PAGE_WIDTH_IN, PURPLE


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
    handles.insert(1, plan.ellipse_handle(data.colours[robots[0]]))
    plan.finish_plans(figure, panels, handles, 3)
    return figure


def _draw_map(axes: Axes, data: ResultTables, robot: str) -> None:
    position, covariance = data.landmarks_of(robot)
    path, colour = data.path_of(robot), data.colours[robot]
    walls = plan.start_plan(axes, data, robot)
    points = {"marker": ".", "markersize": 1.5, "color": colour, "zorder": 2}
    plan.add_points(axes, position, label="landmarks", **points)
    ellipses = {"edgecolors": colour, "linewidths": 0.4, "alpha": 0.6, "zorder": 2}
    plan.add_ellipses(axes, position, covariance, rasterized=True, **ellipses)
    axes.plot(*path.T, color=GRAY, label="path of the best particle", zorder=3)
    axes.plot(0, 0, linestyle="none", marker="o", color=BLACK, label="start pose, the map's frame")
    clouds = data.of_robot("clouds", robot)
    last = clouds[clouds["iteration"] == clouds["iteration"].max()][["x_m", "y_m"]].to_numpy()
    points = {"marker": ".", "markersize": 2.0, "color": PURPLE, "zorder": 5}
    plan.add_points(axes, last, label="particles at the end", **points)
    plan.add_frame(axes)
    axes.set_title(f"{robot}: {plan.set_view(axes, position, path, *walls)}")
