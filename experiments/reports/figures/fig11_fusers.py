"""Figure 11: error of the fused map against the iteration, for each fuser."""

from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from experiments.reports.figures.result_tables import NothingToDraw, ResultTables
from experiments.reports.figures.style import (
    BLACK,
    PAGE_WIDTH_IN,
    aligner_legend,
    fuser_styles,
    plain_numbers,
)

READS = ("fusers",)

# Panels: title, the column drawn with markers, and that drawn beside it as a thin line.
_ERRORS = (
    ("in the frame of the first robot", "landmark_rmse_m", ""),
    ("after the best rigid fit", "fitted_rmse_m", "fitted_median_m"),
)
_WIDTHS = (3, 3, 2)  # the last: of the share of gross landmarks
_MEDIAN: dict[str, Any] = {"linewidth": 0.6, "marker": ".", "markersize": 2.0}
_TICKS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # of each decade
_LEAST_TOP = 0.01  # of the axis of shares: one landmark of hundreds is not to look like many


def draw(data: ResultTables) -> Figure:
    """RMS, and the median as a thin line, of the landmarks that are not gross; log axis."""
    rows = data.rows("fusers")
    if not rows["fitted_rmse_m"].notna().any():
        raise NothingToDraw("no fused map whose truth is known")
    fusers = rows["fuser"].drop_duplicates().tolist()
    of_fuser = {name: rows[rows["fuser"] == name].sort_values("iteration") for name in fusers}
    styles = fuser_styles(fusers)
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.2))
    *errors, gross = figure.subplots(1, 3, sharex=True, width_ratios=_WIDTHS)
    errors[1].sharey(errors[0])
    for axes, (title, bold, thin) in zip(errors, _ERRORS, strict=True):
        for name, own in of_fuser.items():
            axes.plot(own["iteration"], own[bold], **styles[name])
            if thin:
                axes.plot(own["iteration"], own[thin], **styles[name] | _MEDIAN)
        axes.set(title=title, yscale="log")
    for name, own in of_fuser.items():
        gross.plot(own["iteration"], own["gross_share"], **styles[name])
    _finish(errors, gross, rows)
    looks = {name: styles[name] for name in fusers}
    aligner_legend(figure, looks, 4, [Line2D([], [], color=BLACK, label="median", **_MEDIAN)])
    return figure


def _finish(errors: list[Axes], gross: Axes, rows: pd.DataFrame) -> None:
    errors[0].set_ylabel("error of landmarks, RMS (m)")
    # Errors span less than a decade: powers of ten alone would leave the axis without numbers.
    errors[0].yaxis.set_major_locator(LogLocator(subs=_TICKS))
    errors[0].yaxis.set_major_formatter(plain_numbers())
    errors[0].yaxis.set_minor_formatter(NullFormatter())
    errors[1].tick_params(labelleft=False)
    top = max(float(rows["gross_share"].max()), _LEAST_TOP)
    gross.set(title="gross landmarks (%)", ylim=(-0.05 * top, 1.1 * top))
    gross.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:.2g}"))
    gross.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    errors[1].set_xlabel("FastSLAM iteration k")
