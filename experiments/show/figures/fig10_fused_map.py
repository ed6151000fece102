"""Figure 10: the fused map in plan."""

from matplotlib.figure import Figure

from experiments.show.figures.floor_plan import (
    add_frame,
    add_walls,
    height_of_row,
    label_plan,
    legend_height,
    set_view,
)
from experiments.show.figures.result_tables import (
    NothingToDraw,
    ResultTables,
    positions_and_covariances,
)
from experiments.show.figures.style import FUSED_COLOUR, PAGE_WIDTH_IN, robot_colours

_LEGEND_COLUMNS = 4
_ROBOT_MARKERS = ("*", "^", "v", "x", "d")


def draw(data: ResultTables) -> Figure:
    """Landmarks by where they come from: one robot's map, or fused from several."""
    fused = data.table("fused")
    if fused.empty:
        raise NothingToDraw("the fused map is empty")
    frame = data.robots[0]
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    axes = figure.subplots()
    walls = data.walls_in_frame_of(frame)
    add_walls(axes, walls)
    for place, (robot, colour) in enumerate(robot_colours(data.robots).items()):
        rows = fused[(fused["n_parents"] == 1) & (fused["robot_a"] == robot)]
        if rows.empty:
            continue
        axes.plot(
            rows["x_m"],
            rows["y_m"],
            linestyle="none",
            marker=_ROBOT_MARKERS[place % len(_ROBOT_MARKERS)],
            markersize=3,
            markeredgewidth=0.3,
            color=colour,
            label=f"from {robot} alone ({len(rows)})",
            rasterized=True,
        )
    rows = fused[fused["n_parents"] > 1]
    if len(rows):
        axes.plot(
            rows["x_m"],
            rows["y_m"],
            linestyle="none",
            marker="s",
            markersize=2.8,
            markerfacecolor="none",
            markeredgewidth=0.6,
            color=FUSED_COLOUR,
            label=f"fused from two or more ({len(rows)})",
            rasterized=True,
        )
    add_frame(axes)
    position, _ = positions_and_covariances(fused)
    outside = set_view(axes, position, *walls)
    label_plan(axes, frame)
    note = f", {outside} out of view" if outside else ""
    axes.set_title(f"fused map: {len(fused)} landmarks{note}")
    handles, _ = axes.get_legend_handles_labels()
    legend_in = legend_height(len(handles), _LEGEND_COLUMNS)
    figure.set_figheight(height_of_row([axes], PAGE_WIDTH_IN) + legend_in)
    figure.legend(loc="outside lower center", ncols=_LEGEND_COLUMNS, markerscale=1.6)
    return figure
