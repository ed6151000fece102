"""Colours of the page and of its charts, on a light and on a dark background."""

from collections.abc import Iterable
from typing import Any

import plotly.graph_objects as go
from matplotlib.colors import to_hex, to_rgb

from experiments.reports.figures.style import BLACK, BLUE, ORANGE

_SURFACES = {
    "page": ("#ffffff", "#101317"),
    "sheet": ("#ffffff", "#0b0e12"),
    "raised": ("#fafaf8", "#171b21"),
    "tint": ("#edf5fb", "#17242f"),
    "line": ("#e2e4e7", "#2b323b"),
    "ink": ("#15181d", "#eceef1"),
    "muted": ("#5a626d", "#9ca5b0"),
    "good": ("#00704f", "#3ecf9f"),
    "bad": ("#b3261e", "#ff8a7a"),
}
NEUTRAL = "#767676"  # replaces black in charts; visible on both backgrounds
MIN_CONTRAST = 4.5  # WCAG 2.2, level AA, for text; lines need 3
_LIGHTENING_STEP = 0.04  # share of white added at a time

# Plotly's names of matplotlib's markers
_MARKERS = {
    "o": "circle",
    "s": "square",
    "D": "diamond",
    "d": "diamond-tall",
    "^": "triangle-up",
    "v": "triangle-down",
    "<": "triangle-left",
    ">": "triangle-right",
    "P": "cross",
    "X": "x",
    "x": "x-thin-open",
    "*": "star",
    "p": "pentagon",
    "h": "hexagon",
    "H": "hexagon2",
    "8": "octagon",
    "1": "y-down-open",
    "2": "y-up-open",
    "3": "y-left-open",
    "4": "y-right-open",
}


def palette(colours: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the colours of the light and of the dark page by name, for colours of figures."""
    light, dark = ({name: pair[k] for name, pair in _SURFACES.items()} for k in (0, 1))
    used = {"accent": BLUE, "warm": ORANGE} | {css_name(c): c for c in colours if c != BLACK}
    light |= {name: colour.lower() for name, colour in used.items()}
    # the tint is the lightest surface that text is on
    dark |= {name: lightened(colour, dark["tint"]) for name, colour in used.items()}
    return {"light": light, "dark": dark}


def css_name(colour: str) -> str:
    """Return the page's name of a colour of the figures; black is the colour of text."""
    return "ink" if colour == BLACK else f"c{colour[1:].lower()}"


def chart_style(style: dict[str, Any]) -> dict[str, str]:
    """Translate an aligner's matplotlib style into the page's and Plotly's terms."""
    line = style["linestyle"]  # Plotly takes dashes as lengths in pixels, or a name
    return {
        "colour": css_name(style["color"]),
        "hex": NEUTRAL if style["color"] == BLACK else style["color"],
        "marker": _MARKERS.get(style["marker"], "circle"),
        "dash": "solid" if isinstance(line, str) else ",".join(f"{2 * n:g}px" for n in line[1]),
    }


def faint(colour: str, opacity: float = 0.14) -> str:
    """Return a hexadecimal colour with an opacity, in Plotly's terms."""
    red, green, blue = (round(255 * c) for c in to_rgb(colour))
    return f"rgba({red}, {green}, {blue}, {opacity:g})"


def chart_template(theme: str) -> dict[str, Any]:
    """Return Plotly's template of the charts on the `light` or the `dark` page."""
    own = palette([])[theme]
    axis = dict.fromkeys(("gridcolor", "zerolinecolor", "linecolor"), own["line"])
    font = {"color": own["muted"], "size": 12.5, "family": "system-ui, sans-serif"}
    control = {"bgcolor": own["raised"], "bordercolor": own["line"], "font": font}
    layout = {
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": font,
        "margin": {"l": 62, "r": 12, "t": 40, "b": 50},
        "legend": {"bgcolor": "rgba(0,0,0,0)"},
        "xaxis": axis | {"automargin": True},
        "yaxis": axis | {"automargin": True},
        "hoverlabel": {"bgcolor": own["sheet"], "bordercolor": own["line"]},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": own["muted"], "activecolor": own["ink"]},
        "updatemenudefaults": control,
        "sliderdefaults": control | {"activebgcolor": own["warm"], "tickcolor": own["line"]},
    }
    return go.layout.Template(layout=layout).to_plotly_json()


def lightened(colour: str, background: str) -> str:
    """Lighten a colour until its contrast with a dark background is `MIN_CONTRAST`."""
    white, found = 0.0, colour.lower()
    while contrast(found, background) < MIN_CONTRAST:
        white += _LIGHTENING_STEP
        red, green, blue = (c + (1 - c) * white for c in to_rgb(colour))
        found = to_hex((red, green, blue))
    return found


def contrast(first: str, second: str) -> float:
    """Compute the contrast ratio of two colours, 1 to 21 (WCAG 2.2)."""
    darker, lighter = sorted((_luminance(first), _luminance(second)))
    return (lighter + 0.05) / (darker + 0.05)


def _luminance(colour: str) -> float:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
