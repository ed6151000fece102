"""Figure 10: the fused map in plan."""

from matplotlib.figure import Figure

from experiments.show.figures.floor_plan import (
    add_frame,
    add_points,
    finish_plans,
    set_view,
    start_plan,
)
from experiments.show.figures.result_tables import NothingToDraw, ResultTables
from experiments.show.figures.style import FUSED_COLOUR, PAGE_WIDTH_IN
from mapfusion.storage import POSITION_FIELDS

_ROBOT_MARKERS = ("*", "^", "v", "x", "d")
_FUSED_STYLE = {"marker": "s", "markersize": 2.8, "markerfacecolor": "none", "color": FUSED_COLOUR}


def draw(data: ResultTables) -> Figure:
    """Landmarks by where they come from: one robot's map, or fused from several."""
    fused = data.table("fused")
    if fused.empty:
        raise NothingToDraw("the fused map is empty")
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    axes = figure.subplots()
    walls = start_plan(axes, data, data.robots[0])
    position = fused[POSITION_FIELDS].to_numpy()
    for place, (robot, colour) in enumerate(data.colours.items()):
        own = ((fused["n_parents"] == 1) & (fused["robot_a"] == robot)).to_numpy()
        if own.any():
            marker = _ROBOT_MARKERS[place % len(_ROBOT_MARKERS)]
            style = {"marker": marker, "markersize": 3, "markeredgewidth": 0.3, "color": colour}
            add_points(axes, position[own], label=f"from {robot} alone ({own.sum()})", **style)
    several = (fused["n_parents"] > 1).to_numpy()
    if several.any():
        label = f"fused from two or more ({several.sum()})"
        add_points(axes, position[several], label=label, markeredgewidth=0.6, **_FUSED_STYLE)
    add_frame(axes)
    axes.set_title(f"fused map: {set_view(axes, position, *walls)}")
    finish_plans(figure, [axes], axes.get_legend_handles_labels()[0], 4, markerscale=1.6)
    return figure
