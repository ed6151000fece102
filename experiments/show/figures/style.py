"""One look for all figures: legible in print, safe for colour-blind readers, reproducible."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib.style
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from experiments.judge.criteria import ORACLE

PAGE_WIDTH_IN = 7.2  # two columns of a journal page
PNG_DPI = 200
SVG_DPI = 150  # of the parts that are drawn as pixels, which make up most of the file

# Okabe and Ito (2008): told apart by readers with any common colour blindness. Their yellow is left
# out: too pale for lines on white.
BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
)
# Four of Tol's (2021) muted scheme, darker or duller than those, where more methods are compared.
INDIGO, WINE, OLIVE, TEAL = "#332288", "#882255", "#999933", "#44AA99"
BLACK, GRAY, PALE_GRAY = "#000000", "#7F7F7F", "#C8C8C8"
SEQUENTIAL_MAP = "viridis"

_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same on every machine
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
    "grid.alpha": 0.35,
    "grid.linewidth": 0.4,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "mapfusion",  # else every SVG gets element ids of its own
}
# Lines also differ in dashes and markers, for prints in gray. Each known method always looks alike.
_ALIGNER_STYLES: dict[str, dict[str, Any]] = {
    "ransac": {"color": BLUE, "linestyle": "-", "marker": "o"},
    "svd": {"color": VERMILLION, "linestyle": (0, (6, 1, 1, 1)), "marker": "s"},
    "svd-solved": {"color": ORANGE, "linestyle": (0, (1, 1)), "marker": "D"},
    "icp": {"color": GREEN, "linestyle": (0, (5, 1)), "marker": "^"},
    "impicp": {"color": PURPLE, "linestyle": (0, (3, 1, 1, 1, 1, 1)), "marker": "v"},
    "gnc": {"color": SKY, "linestyle": (0, (8, 2)), "marker": "P"},
    "clique": {"color": INDIGO, "linestyle": "-", "marker": "*"},
    "ransac_mahalanobis": {"color": WINE, "linestyle": (0, (6, 1, 1, 1)), "marker": "X"},
    "opencv": {"color": OLIVE, "linestyle": (0, (3, 1)), "marker": "<"},
    "kiss_matcher": {"color": TEAL, "linestyle": (0, (3, 1, 1, 1, 1, 1)), "marker": ">"},
}
# All others (plug-ins, names of a scenario's own) by their place among themselves. The lengths have
# no common factor, so 99 styles come before one repeats.
_OTHER_COLOURS = (INDIGO, OLIVE, BLUE, WINE, TEAL, VERMILLION, SKY, ORANGE, PURPLE, GREEN, GRAY)
_OTHER_DASHES = (
    (0, (2, 2)),
    (0, (9, 1, 2, 1)),
    "-",
    (0, (4, 1, 1, 1)),
    (0, (1, 2)),
    (0, (7, 3)),
    (0, (5, 1, 1, 1, 1, 1, 1, 1)),
    (0, (3, 3)),
    (0, (10, 2, 4, 2)),
)
_OTHER_MARKERS = ("p", "h", "d", "8", "H", "1", "2", "3", "4")
_ORACLE_STYLE: dict[str, Any] = {"color": BLACK, "linestyle": (0, (4, 2)), "marker": "x"}
_ROBOT_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
FUSED_COLOUR = BLACK


def plain_numbers() -> FuncFormatter:
    """Ticks of logarithmic axes as people read them: 0.01, 0.1, 1, 10."""
    return FuncFormatter(lambda value, _: f"{value:g}".replace("-", "−"))


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib's defaults and ours, whatever the user's own settings; those come back after."""
    with matplotlib.style.context(["default", _RC]):
        yield


def aligner_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Line style of each aligner: its own if it has one, else by its place among those without."""
    styles = _ALIGNER_STYLES | {ORACLE: _ORACLE_STYLE}
    others = [name for name in names if name not in styles]
    return styles | {
        name: {
            "color": _OTHER_COLOURS[place % len(_OTHER_COLOURS)],
            "linestyle": _OTHER_DASHES[place % len(_OTHER_DASHES)],
            "marker": _OTHER_MARKERS[place % len(_OTHER_MARKERS)],
        }
        for place, name in enumerate(others)
    }


def aligner_legend(
    figure: Figure,
    labels: Mapping[str, str],
    styles: Mapping[str, dict[str, Any]],
    columns: int,
    others: Sequence[Artist] = (),
) -> None:
    """Put a legend of aligners above a figure.

    Args:
        figure: to which it belongs.
        labels: text of each aligner shown, by name.
        styles: of all aligners.
        columns: at most so many.
        others: what else the legend explains.
    """
    handles = [Line2D([], [], label=text, **styles[name]) for name, text in labels.items()]
    figure.legend(
        handles=[*handles, *others],
        loc="outside upper center",
        ncols=min(len(handles) + len(others), columns),
        handlelength=3.2,
    )


def robot_colours(names: Sequence[str]) -> dict[str, str]:
    """Colour of each robot by its place in the display order."""
    return {name: _ROBOT_COLOURS[place % len(_ROBOT_COLOURS)] for place, name in enumerate(names)}
