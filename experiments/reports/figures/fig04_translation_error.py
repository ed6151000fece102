"""Figure 4: error of the alignments' translation against the iteration."""

from matplotlib.figure import Figure

from experiments.reports.figures.error_curves import draw_error_curves
from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.figures.style import write_plainly

READS = ("errors", "estimates")
_FLOOR_M = 1e-4  # a tenth of a millimetre: anything below is exact for a robot


def draw(data: ResultTables) -> Figure:
    """Median and 10-90 % band of the repetitions or the runs, log axis, per robot pair."""
    figure, drawn = draw_error_curves(data, "translation_error_m", "translation error (m)")
    axes = figure.axes[0]
    axes.set_yscale("log", nonpositive="clip")
    write_plainly(axes.yaxis)
    axes.set_ylim(max(drawn.min(), _FLOOR_M) / 1.3, max(drawn.max(), 2 * _FLOOR_M) * 1.3)
    return figure
