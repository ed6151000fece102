"""Figure 5: signed error of the alignments' rotation against the iteration."""

import numpy as np
from matplotlib.figure import Figure

from experiments.reports.figures.error_curves import draw_error_curves
from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.figures.style import plain_numbers

READS = ("errors", "estimates")

# The axis is linear up to here and logarithmic beyond: good alignments err by a few thousandths of
# a radian, bad ones by tenths or more, and both must be legible.
_LINEAR_RAD = 0.01
_NOTE = f"""FastSLAM iteration k
error = estimate - truth, counter-clockwise positive (the paper's sign is the opposite); \
axis linear within ±{_LINEAR_RAD} rad"""


def draw(data: ResultTables) -> Figure:
    """Median and 10-90 % band of the repetitions or the runs, per robot pair."""
    figure, drawn = draw_error_curves(data, "rotation_error_rad", "rotation error (rad)")
    axes = figure.axes[0]
    axes.set_yscale("symlog", linthresh=_LINEAR_RAD, linscale=1.0)
    axes.yaxis.set_major_formatter(plain_numbers())
    largest = max(np.abs(drawn).max(), _LINEAR_RAD)
    axes.set_ylim(-1.3 * largest, 1.3 * largest)
    figure.supxlabel(_NOTE, fontsize=8)
    return figure
