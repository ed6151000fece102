"""Figure 12: true points inside ellipses against the probability these are of, by fuser."""

from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter

from experiments.evaluation.fused_map_errors import FILTERED, FUSED, SMOOTHED
from experiments.reports.figures.result_tables import NothingToDraw, ResultTables
from experiments.reports.figures.style import (
    GIVEN_STYLES,
    PAGE_WIDTH_IN,
    PALE_GRAY,
    aligner_legend,
    fuser_styles,
)

READS = ("fuser_coverage",)
_PANELS = {
    "coverage": "each map after its best rigid fit",
    "frame_coverage": "each map in its own frame",
}
_BEFORE = {FILTERED: "FastSLAM's maps, before", SMOOTHED: "smoothed maps, before"}
_DIAGONAL: dict[str, Any] = {"color": PALE_GRAY, "linewidth": 2.5, "zorder": 1}


def draw(data: ResultTables) -> Figure:
    """At the last iteration, without gross landmarks; below the diagonal a map is too sure."""
    rows = data.rows("fuser_coverage")
    if rows.empty:
        raise NothingToDraw("no fused map whose truth is known")
    fused = rows[rows["map"] == FUSED]
    fusers = fused["fuser"].drop_duplicates().tolist()
    styles = fuser_styles(fusers)
    curves = {
        label: (own, GIVEN_STYLES[kind])
        for kind, label in _BEFORE.items()
        if len(own := rows[rows["map"] == kind])
    }
    curves |= {name: (fused[fused["fuser"] == name], styles[name]) for name in fusers}
    figure = Figure(figsize=(PAGE_WIDTH_IN, 4.3))
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, (column, title) in zip(panels, _PANELS.items(), strict=True):
        axes.plot([0, 1], [0, 1], **_DIAGONAL)
        for own, look in curves.values():
            axes.plot(own["nominal"], own[column], **look)
        axes.set(title=title, xlabel="probability of the ellipses (%)", aspect="equal")
        axes.set(xlim=(0, 1), ylim=(0, 1.03))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(PercentFormatter(1.0, symbol=""))
    panels[0].set_ylabel("true points inside (%)")
    consistent = Line2D([], [], label="as stated", **_DIAGONAL)
    aligner_legend(figure, {name: look for name, (_, look) in curves.items()}, 4, [consistent])
    return figure
