"""Common style of all figures: legible in print, colour-blind safe, reproducible."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import cycle
from typing import Any

import matplotlib.style
from matplotlib.artist import Artist
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogFormatter

from experiments.evaluation.criteria import ORACLE
from experiments.evaluation.map_errors import FILTERED, SMOOTHED
from mapfusion.fusion.fusers import REFERENCE
from mapfusion.plotting import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION

PAGE_WIDTH_IN = 7.2  # two columns of a journal page
# Four colours of Tol's (2021) muted scheme, for comparisons of many methods.
INDIGO, WINE, OLIVE, TEAL = "#332288", "#882255", "#999933", "#44AA99"
BLACK, GRAY, WALL_GRAY, PALE_GRAY = "#000000", "#7F7F7F", "#A8A8A8", "#C8C8C8"

_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # part of Matplotlib: the same on every machine
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.0,
    "legend.fontsize": 7.5,
    "legend.framealpha": 0.9,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titley": 1.0,  # skips Matplotlib's search for a free position
    "grid.alpha": 0.35,
    "grid.linewidth": 0.4,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "mapfusion",  # constant element ids in SVG files
}
# Colour, dashes and marker: lines also differ in gray print. A known method has a fixed style.
_KNOWN_ALIGNERS: dict[str, tuple[Any, ...]] = {
    "ransac": (BLUE, "-", "o"),
    "svd": (VERMILLION, (0, (6, 1, 1, 1)), "s"),
    "svd-solved": (ORANGE, (0, (1, 1)), "D"),
    "icp": (GREEN, (0, (5, 1)), "^"),
    "impicp": (PURPLE, (0, (3, 1, 1, 1, 1, 1)), "v"),
    "gnc": (SKY, (0, (8, 2)), "P"),
    "clique": (INDIGO, "-", "*"),
    "ransac_mahalanobis": (WINE, (0, (6, 1, 1, 1)), "X"),
    "opencv": (OLIVE, (0, (3, 1)), "<"),
    "kiss_matcher": (TEAL, (0, (3, 1, 1, 1, 1, 1)), ">"),
    ORACLE: (BLACK, (0, (4, 2)), "x"),
}
# Fusers, the most important ones with solid dark lines; below, the maps given to the fusers.
_KNOWN_FUSERS: dict[str, tuple[Any, ...]] = {
    "kalman": (ORANGE, (0, (1, 1)), "D"),
    "kalman-drift": (VERMILLION, (0, (6, 1, 1, 1)), "s"),
    "kalman_as_printed": (WINE, (0, (3, 1, 1, 1, 1, 1)), "X"),
    "covariance_intersection": (GREEN, (0, (5, 1)), "^"),
    "joint": (BLUE, "-", "o"),
    REFERENCE: (BLACK, (0, (4, 2)), "x"),
}
GIVEN_STYLES: dict[str, dict[str, Any]] = {
    FILTERED: {"color": GRAY, "linestyle": (0, (3, 1, 1, 1)), "marker": "v"},
    SMOOTHED: {"color": GRAY, "linestyle": "-", "marker": "P"},
}
# All others (plug-ins, names defined in a scenario) by their position. The lengths of the tuples
# have no common factor, so 99 styles come before one repeats.
_OTHER_COLOURS = (INDIGO, OLIVE, BLUE, WINE, TEAL, VERMILLION, SKY, ORANGE, PURPLE, GREEN, GRAY)
_DASHES_AND_GAPS = [(2, 2), (9, 1, 2, 1), (), (4, 1, 1, 1), (1, 2), (7, 3)]
_DASHES_AND_GAPS += [(5, 1, 1, 1, 1, 1, 1, 1), (3, 3), (10, 2, 4, 2)]
_OTHER_DASHES = [(0, lengths) if lengths else "-" for lengths in _DASHES_AND_GAPS]
_OTHER_MARKERS = ("p", "h", "d", "8", "H", "1", "2", "3", "4")


class _Between(LogFormatter):
    """Formatter of minor ticks: plain numbers on axes with few powers of ten, else none."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return _plain(x) if super().__call__(x, pos) else ""


def plain_numbers() -> FuncFormatter:
    """Return a formatter that writes plain numbers on logarithmic axes: 0.01, 0.1, 1, 10."""
    return FuncFormatter(lambda value, _: _plain(value))


def write_plainly(axis: Axis) -> None:
    """Write plain numbers on a logarithmic axis, also between the powers of ten."""
    axis.set_major_formatter(plain_numbers())
    axis.set_minor_formatter(_Between())


def _plain(value: float) -> str:
    return f"{value:g}".replace("-", "−")


def house_style() -> AbstractContextManager[None]:
    """Return a context with the common style; the user's own settings are restored afterwards."""
    return matplotlib.style.context(["default", _RC])


def aligner_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return line styles by aligner: fixed for known aligners, else by position in `names`."""
    return _styles(_KNOWN_ALIGNERS, names)


def fuser_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return line styles by fuser, as `aligner_styles` does."""
    return _styles(_KNOWN_FUSERS, names)


def _styles(
    known: Mapping[str, tuple[Any, ...]], names: Sequence[str]
) -> dict[str, dict[str, Any]]:
    others = [name for name in names if name not in known]
    looks = zip(cycle(_OTHER_COLOURS), cycle(_OTHER_DASHES), cycle(_OTHER_MARKERS), strict=False)
    chosen = {**known} | dict(zip(others, looks, strict=False))
    parts = ("color", "linestyle", "marker")
    return {name: dict(zip(parts, look, strict=True)) for name, look in chosen.items()}


def aligner_legend(
    figure: Figure,
    styles: Mapping[str, dict[str, Any]],
    columns: int,
    others: Sequence[Artist] = (),
) -> None:
    """Put a legend above a figure: line styles by label, then other entries."""
    lines = [Line2D([], [], label=label, **style) for label, style in styles.items()]
    handles = [*lines, *others]
    place = {"loc": "outside upper center", "ncols": min(len(handles), columns)}
    figure.legend(handles=handles, handlelength=3.2, **place)
