"""The figures' colours on the page: by name, with a lighter twin of each for a dark background."""

from typing import Any

from experiments.figures.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION

_NAMES = {
    BLUE: "blue",
    VERMILLION: "vermillion",
    GREEN: "green",
    PURPLE: "purple",
    ORANGE: "orange",
    SKY: "sky",
    BLACK: "ink",
}
_SURFACES = {
    "page": ("#ffffff", "#101317"),
    "sheet": ("#ffffff", "#0b0e12"),
    "raised": ("#fafaf8", "#171b21"),
    "tint": ("#edf5fb", "#17242f"),
    "shade": ("#d9dbdf", "#343b45"),
    "track": ("#8cbfe0", "#2f6f9f"),
    "line": ("#e2e4e7", "#2b323b"),
    "wall": ("#c8ccd2", "#4a535f"),
    "ink": ("#15181d", "#eceef1"),
    "muted": ("#5a626d", "#9ca5b0"),
    "good": ("#00704f", "#3ecf9f"),
    "bad": ("#b3261e", "#ff8a7a"),
}
# The figures' hues, lightened for a dark page: each stands out from it at least 4.5 to 1 (WCAG AA).
_LIGHTENED = {
    "blue": "#4aa3e0",
    "vermillion": "#f2813b",
    "green": "#2bc79a",
    "purple": "#e39cc6",
    "orange": "#f0b429",
    "sky": "#93d2f7",
}
LIGHT = {name: light for name, (light, _) in _SURFACES.items()}
LIGHT |= {name: colour for colour, name in _NAMES.items() if name != "ink"}
DARK = {name: dark for name, (_, dark) in _SURFACES.items()} | _LIGHTENED
# Plotly's names of matplotlib's markers
_MARKERS = {
    "o": "circle",
    "s": "square",
    "D": "diamond",
    "^": "triangle-up",
    "v": "triangle-down",
    "P": "cross",
    "x": "x",
}


def css_name(colour: str) -> str:
    """The page's name of one of the figures' colours."""
    return _NAMES[colour]


def chart_style(style: dict[str, Any]) -> dict[str, str]:
    """An aligner's matplotlib style in the page's and Plotly's terms."""
    marker = style["marker"]
    return {
        "colour": css_name(style["color"]),
        "marker": _MARKERS[marker],
        "dash": _dash(style["linestyle"]),
    }


def _dash(linestyle: Any) -> str:
    """Plotly takes dashes as lengths in pixels, or a name."""
    if isinstance(linestyle, str):
        return "solid"
    return ",".join(f"{2 * length:g}px" for length in linestyle[1])
