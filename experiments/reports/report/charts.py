"""Charts of the report page, and their colours on a light and on a dark background."""

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from matplotlib.colors import to_hex, to_rgb
from plotly.subplots import make_subplots

from experiments.evaluation.alignment_criteria import MAP_PAIR
from experiments.reports.figures.style import BLACK, BLUE, ORANGE
from experiments.studies.method_comparison import success_rates
from experiments.studies.statistics import error_bands, scarce_spans, time_bands

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


_DIGITS = 5  # significant digits; more than a chart can show
_MAX_POINTS = 400  # of a curve: a chart is about a thousand pixels wide
_MAX_TIMES = 40  # points of an aligner in the chart of times
_OFFERED = ["n_true", "n_correspondences"]
_ERRORS = {
    "translation_estimated": "translation_error_m",
    "translation_refined": "refined_translation_error_m",
    "rotation_estimated": "rotation_error_rad",
    "rotation_refined": "refined_rotation_error_rad",
}
# Row and column of each curve's panel in the error chart
_PANELS = {
    "translation_estimated": (1, 1),
    "translation_refined": (1, 2),
    "rotation_estimated": (2, 1),
    "rotation_refined": (2, 2),
}
_BIN_SHARE = 0.8  # share of a bin's width over which the intervals of the methods are spread

_PANELS_APART = 0.09  # share of the figure's width

Attributes = dict[str, Any]
Styles = Mapping[str, dict[str, Any]]  # of each aligner, by `theme.chart_style`


# Plotly interprets a few tags and entities in texts, so names are escaped.
escaped = partial(html.escape, quote=False)


def rounded(values: Any) -> list[float | None]:
    """Round floats to a few significant digits; None stands for values that are not finite."""
    return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in np.ravel(values)]


def thinned(values: np.ndarray, n: int) -> np.ndarray:
    """Return at most n of the values, evenly spread, with the last one among them."""
    last = len(values) - 1
    return values[np.linspace(last, 0, min(n, last + 1)).round().astype(int)[::-1]]


def _band(rows: pd.DataFrame, column: str, scale: float = 1.0) -> dict[str, list[float | None]]:
    """Return low, median and high, from columns with "_low", "" and "_high" in their braces."""
    ends = {"low": "_low", "median": "", "high": "_high"}
    return {name: rounded(scale * rows[column.format(end)]) for name, end in ends.items()}


def error_curves(rows: pd.DataFrame, aligners: Sequence[str]) -> dict[str, Any]:
    """Compute each aligner's median error with its band, and the offered pairs, by iteration.

    `rows` are of the table `errors` or of `medians_of_run`; rows of one iteration are pooled.
    """
    iterations = thinned(np.unique(rows["iteration"]), _MAX_POINTS)
    rows = rows[rows["iteration"].isin(iterations)]
    offered = rows.drop_duplicates(MAP_PAIR).groupby("iteration")[_OFFERED].median()
    # absolute: a logarithmic axis cannot show signs
    bands = error_bands(rows, by=(), absolute=True).set_index("iteration")
    of_aligner = {name: bands[bands["aligner"] == name].reindex(iterations) for name in aligners}
    return {
        "iteration": iterations.tolist(),
        **{name: rounded(offered[name]) for name in _OFFERED},
        "scarce": scarce_spans(rows),
        "aligners": {
            name: {curve: _band(own, f"{column}{{}}") for curve, column in _ERRORS.items()}
            for name, own in of_aligner.items()
        },
    }


def success_curves(maps: pd.DataFrame, aligners: Sequence[str]) -> list[dict[str, Any]]:
    """Compute success rates with intervals against each quantity that affects alignment.

    `maps` are alignment summaries with the column overlap_share, which may be unknown. Bins without
    maps that have common ground are left out: no answer is right there.
    """
    curves = []
    for by, (label, name) in _SUCCESS_AGAINST.items():
        rates = success_rates(maps, by)
        if rates.empty or rates["refined_success"].isna().all():
            continue
        rates = rates[rates["n_maps"] > rates["n_apart"]]
        bins = rates[["from", "to"]].drop_duplicates().sort_values("from")
        by_aligner = {}
        for aligner in aligners:
            own = rates[rates["aligner"] == aligner].set_index("from").reindex(bins["from"])
            band = _band(own, "refined_success{}")
            n_maps = (own["n_maps"] - own["n_apart"]).fillna(0).astype(int)
            by_aligner[aligner] = {"rate": band.pop("median"), **band, "n": n_maps.tolist()}
        labels = [name(*ends) for ends in bins.itertuples(index=False)]
        curves.append({"label": label, "bins": labels, "aligners": by_aligner})
    return curves


def _counts(low: float, high: float) -> str:
    """Name a bin of whole numbers from `low` to below `high`."""
    if math.isinf(high):
        return f"≥ {low:g}"
    return f"{low:g}" if high == low + 1 else f"{low:g}–{high - 1:g}"


def _shares(low: float, high: float) -> str:
    return f"{100 * low:g}–{100 * high:g} %"


_SUCCESS_AGAINST = {
    "n_true": ("true pairs among the correspondences", _counts),
    "outlier_share": ("share of false correspondences", _shares),
    "overlap_share": ("common landmarks, share of the smaller map", _shares),
    "iteration": ("iteration", _counts),
}


def time_curves(timings: pd.DataFrame, aligners: Sequence[str]) -> dict[str, Any]:
    """Compute the time of one alignment in ms against the number of correspondences.

    If an aligner has many maps, those with similar numbers of correspondences become one point,
    and its band holds their medians instead of the repeats of one map.
    """
    curves = {}
    for aligner in aligners:
        rows = timings[timings["aligner"] == aligner].dropna(subset="elapsed_s")
        if len(rows) > _MAX_TIMES:
            rows = time_bands(rows, "n_correspondences", _MAX_TIMES)
        if len(rows):
            rows = rows.sort_values("n_correspondences")
            band = _band(rows, "elapsed{}_s", scale=1e3)
            curves[aligner] = band | {"n": rounded(rows["n_correspondences"])}
    return curves


def error_figure(groups: Sequence[tuple[str, dict[str, Any]]], styles: Styles) -> go.Figure:
    """Draw the `error_curves` of labelled groups of maps; a menu selects the group.

    Estimates are on the left, refined estimates on the right.
    """
    titles: Attributes = {"column_titles": ["as estimated", "refined"]}
    titles |= {"x_title": "FastSLAM iteration k"}
    grid: Attributes = {"vertical_spacing": 0.05, "horizontal_spacing": _PANELS_APART}
    grid |= {"row_heights": [0.4, 0.4, 0.2], "shared_xaxes": "all"}
    figure = make_subplots(3, 2, **titles, **grid)
    for name, style in styles.items():
        for curve, (row, col) in _PANELS.items():
            own = {"name": escaped(name), "legendgroup": name, "line_color": style["hex"]}
            band = {"fill": "toself", "fillcolor": faint(style["hex"]), "hoverinfo": "skip"}
            trace = go.Scatter(mode="none", showlegend=False, meta="band", **own, **band)
            figure.add_trace(trace, row, col)
            hover = "%{y:.3g} (%{customdata[0]:.3g}–%{customdata[1]:.3g})"
            median = go.Scatter(
                **own,
                mode="lines+markers",
                line_dash=style["dash"],
                marker={"size": 5, "symbol": style["marker"]},
                meta=curve,
                hovertemplate=hover,
                showlegend=(row, col) == (1, 1),
            )
            figure.add_trace(median, row, col)
    for col in (1, 2):
        for name, text, look in (
            ("n_correspondences", "offered pairs", {"line_dash": "dot"}),
            ("n_true", "true pairs", {"fill": "tozeroy", "fillcolor": faint(NEUTRAL)}),
        ):
            shared = {"legendgroup": name, "showlegend": col == 1, "line_color": NEUTRAL}
            line = go.Scatter(mode="lines", name=text, meta=name, **shared, **look)
            figure.add_trace(line, 3, col)
    contents = [_error_attributes(curves, styles) for _, curves in groups]
    values, shading = contents[0]
    traces: Any = figure.data
    for place, trace in enumerate(traces):
        trace.update({name: each[place] for name, each in values.items()})
    if len(groups) > 1:
        buttons = [
            {"label": escaped(label), "method": "update", "args": [each, {"shapes": shapes}]}
            for (label, _), (each, shapes) in zip(groups, contents, strict=True)
        ]
        place = {"x": 0, "xanchor": "left", "y": 1.05, "yanchor": "bottom"}
        figure.update_layout(updatemenus=[{"buttons": buttons, **place}], margin_t=80)
    log: Attributes = {
        "type": "log",
        "tickformat": "~g",
        "exponentformat": "none",
        "minor_showgrid": False,
    }
    figure.update_yaxes(**log, row=1, title_text="translation error (m)", dtick=1)
    figure.update_yaxes(**log, row=2, title_text="rotation error (rad)", dtick=1)
    figure.update_yaxes(row=3, title_text="pairs", rangemode="tozero", nticks=3)
    figure.update_yaxes(title_text="", col=2)
    figure.update_xaxes(hoverformat="d")
    return figure.update_layout(
        height=760,
        hovermode="x unified",
        hoverdistance=-1,  # no limit
        shapes=shading,
    )


def _error_attributes(curves: dict[str, Any], styles: Styles) -> tuple[Attributes, list[Any]]:
    """Return the values of all traces of the error chart for one group, and its shading."""
    x = curves["iteration"]
    traces: list[tuple[list[Any], list[Any], Any]] = []
    for name in styles:
        for curve in _PANELS:
            own = curves["aligners"][name][curve]
            # Outline of the band, one polygon for each interval with estimates
            known = np.array([median is not None for median in own["median"]], dtype=int)
            edges = np.flatnonzero(np.diff(known, prepend=0, append=0))
            outline_x: list[Any] = []
            outline_y: list[Any] = []
            for first, last in edges.reshape(-1, 2):
                outline_x += [*x[first:last], *x[first:last][::-1], None]
                outline_y += [*own["low"][first:last], *own["high"][first:last][::-1], None]
            traces.append((outline_x, outline_y, None))
            traces.append((x, own["median"], list(zip(own["low"], own["high"], strict=True))))
    traces += [(x, curves[name], None) for name in ("n_correspondences", "n_true")] * 2
    attributes = zip(*traces, strict=True)
    shading = {"type": "rect", "yref": "paper", "y0": 0, "y1": 1, "layer": "below"}
    shading |= {"fillcolor": faint(NEUTRAL), "line_width": 0}
    shapes = [
        go.layout.Shape(**shading, xref=axis, x0=first, x1=last).to_plotly_json()
        for axis in ("x", "x2")
        for first, last in curves["scarce"]
    ]
    names = ("x", "y", "customdata")
    return {n: list(each) for n, each in zip(names, attributes, strict=True)}, shapes


def success_figure(curves: Sequence[dict[str, Any]], styles: Styles) -> go.Figure | None:
    """Draw `success_curves`, one panel for each quantity; None if there are none."""
    if not curves:
        return None
    n_rows = len(curves)  # over the whole width, so that intervals do not overlap
    figure = make_subplots(n_rows, 1, vertical_spacing=0.28 / n_rows)
    panel: Any
    for panel, panel_curves in enumerate(curves, start=1):
        bins = np.arange(len(panel_curves["bins"]))
        for number, (name, style) in enumerate(styles.items()):
            rates = panel_curves["aligners"][name]
            rate, low, high = (
                100 * np.array(rates[end], dtype=float) for end in ("rate", "low", "high")
            )
            label = escaped(name)
            hover = "%{y:.0f} % (%{customdata[0]:.0f} to %{customdata[1]:.0f} %), "
            interval = {"type": "data", "array": rounded(high - rate), "width": 0}
            interval |= {"arrayminus": rounded(rate - low), "thickness": 1.5}
            trace = go.Scatter(
                x=bins + _BIN_SHARE * ((number + 0.5) / len(styles) - 0.5),
                y=rounded(rate),
                customdata=list(zip(rounded(low), rounded(high), rates["n"], strict=True)),
                name=label,
                legendgroup=name,
                showlegend=panel == 1,
                mode="markers",
                marker={"size": 8, "symbol": style["marker"], "color": style["hex"]},
                error_y=interval | {"color": faint(style["hex"], 0.6)},
                hovertemplate=f"{label}: {hover}%{{customdata[2]}} maps<extra></extra>",
            )
            figure.add_trace(trace, panel, 1)
        ticks = {"tickvals": bins.tolist(), "ticktext": panel_curves["bins"], "showgrid": False}
        ticks |= {"range": [-0.5, len(bins) - 0.5]}
        figure.update_xaxes(**ticks, title_text=panel_curves["label"], row=panel)
        for edge in bins[1:] - 0.5:
            figure.add_vline(edge, line_width=1, line_color=faint(NEUTRAL), row=panel)
    figure.update_yaxes(range=[-3, 103], ticksuffix=" %", title_text="correct")
    return figure.update_layout(height=60 + 270 * n_rows, hovermode="closest")


def time_figure(curves: dict[str, Any], styles: Styles) -> go.Figure | None:
    """Draw `time_curves`; None if nothing was measured."""
    if not curves:
        return None
    figure = go.Figure()
    for name, own in curves.items():
        low, median, high = (np.array(own[end], dtype=float) for end in ("low", "median", "high"))
        shown, style = escaped(name), styles[name]
        band = {"type": "data", "array": rounded(high - median), "width": 0, "thickness": 1.2}
        figure.add_scatter(
            x=own["n"],
            y=own["median"],
            customdata=list(zip(own["low"], own["high"], strict=True)),
            name=shown,
            mode="markers",
            marker={"size": 8, "color": style["hex"], "symbol": style["marker"]},
            error_y=band | {"arrayminus": rounded(median - low)},
            hovertemplate=f"{shown}: %{{y:.3g}} ms (%{{customdata[0]:.3g}}–%{{customdata[1]:.3g}})"
            " for %{x} pairs<extra></extra>",
        )
    log: Attributes = {"type": "log", "tickformat": "~g", "exponentformat": "none", "dtick": "D2"}
    figure.update_xaxes(**log, title_text="correspondences")
    figure.update_yaxes(**log, title_text="time (ms)")
    return figure.update_layout(height=420, hovermode="closest")
