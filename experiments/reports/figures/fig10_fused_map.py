"""Figure 10: the fused map in plan."""

from matplotlib.figure import Figure

from experiments.reports.figures import floor_plan as plan
from experiments.reports.figures.result_tables import NothingToDraw, ResultTables
from experiments.reports.figures.style import FUSED_COLOUR, PAGE_WIDTH_IN
from mapfusion.files import POSITION_FIELDS

READS = ("fused", "fused_map", "fused_motions", "robots")
_ROBOT_MARKERS = ("*", "^", "v", "x", "d")


def draw(data: ResultTables) -> Figure:
    """Landmarks by where they come from: one robot's map, or fused from several."""
    fused = data.fused_map()
    if fused.empty:
        raise NothingToDraw("the fused map is empty")
    figure = Figure(figsize=(PAGE_WIDTH_IN, PAGE_WIDTH_IN))
    axes = figure.subplots()
    walls = plan.start_plan(axes, data, data.fused_frame)
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
