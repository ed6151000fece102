"""Page and picture of aligned or merged maps: correspondences, ellipses and other motions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

import mapfusion
from experiments.reports.report.charts import NEUTRAL, Attributes, chart_style, escaped, faint
from experiments.reports.report.document import write_page
from experiments.reports.report.map_view import SMOOTH, ellipse_polygons
from mapfusion.errors import InputError
from mapfusion.files import write_atomically
from mapfusion.fusion.map_merging import (
    MapAlignment,
    MergedMaps,
    advice,
    best_alignment,
    motion_text,
    sigma_text,
)
from mapfusion.geometry.numerics import Float
from mapfusion.plotting import (
    ACCEPTED_COLOUR,
    LEVEL_TEXT,
    ROBOT_COLOURS,
    Plan,
    bounds,
    plot_plans,
)

_DPI = 150
_HEIGHT_PX = 760
_POINT_PX, _RING_PX = 6, 13


def write_pictures(
    report: Path | None,
    plot: Path | None,
    found: Sequence[MapAlignment] | MergedMaps,
    paths: Sequence[Path],
    seed: int,
) -> None:
    """Write the page and the picture of alignments of two maps, or of merged maps.

    Args:
        report: HTML file; None writes none.
        plot: file of the picture, of the format of its suffix; None writes none.
        found: alignments of the same two maps by different methods, or merged maps.
        paths: files of the maps.
        seed: seed of the random numbers.

    Raises:
        InputError: a file cannot be written.
    """
    if report is None and plot is None:
        return
    shown = found if isinstance(found, MergedMaps) else best_alignment(found)
    text = found.advice if isinstance(found, MergedMaps) else advice(found)
    plans = shown.plans()
    try:
        if plot is not None:
            figure, kind = plot_plans(plans, text), plot.suffix.lower().removeprefix(".")
            # without the date, the same maps give the same file
            dated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
            write_atomically(
                plot, lambda file: figure.savefig(file, dpi=_DPI, format=kind, metadata=dated)
            )
        if report is not None:
            contents = _contents(found, plans, text, paths, seed)
            colours = (*ROBOT_COLOURS, ACCEPTED_COLOUR, NEUTRAL)
            write_page(report, "maps.html.j2", contents, colours)
    except OSError as error:
        raise InputError(f"{error.filename or report or plot}: {error.strerror}") from error


def _contents(
    found: Sequence[MapAlignment] | MergedMaps,
    plans: Sequence[Plan],
    text: str,
    paths: Sequence[Path],
    seed: int,
) -> dict[str, Any]:
    """Return the values that the page shows."""
    if isinstance(found, MergedMaps):
        alignments, command = list(found.alignments.values()), "merge"
        maps, n_merged = found.maps, len(found.fused.members)
        verdict = f"{n_merged} of {len(maps)} maps merged" if found.any_merged else "Not merged"
        compared = alignments
    else:
        alignments, command = list(found), "align"
        best = best_alignment(found)
        maps, verdict = (best.map_a, best.map_b), str(best.status).replace("_", " ").capitalize()
        compared = [best]
    rivals = [
        {
            "maps": f"{each.map_a.name}, {each.map_b.name}",
            "motion": motion_text(other.T_a_b),
            "pairs": f"{np.count_nonzero(other.inlier)} of {len(other.inlier)}",
            "chance": other.log10_false_alarms,
        }
        for each in compared
        for other in each.other_motions
    ]
    rows = []
    for alignment in alignments:
        refined = alignment.registered.refined
        known = bool(np.isfinite(alignment.T_a_b).all())
        sigma = sigma_text(refined.covariance, refined.lower_bound).removeprefix("sigma ")
        row = {
            "maps": f"{alignment.map_a.name}, {alignment.map_b.name}",
            "aligner": alignment.aligner,
            "accepted": alignment.accepted,
            "verdict": str(alignment.status).replace("_", " "),
            "motion": _kept_together(motion_text(alignment.T_a_b)) if known else "–",
            "sigma": _kept_together(sigma) if known else "–",
            "pairs": f"{np.count_nonzero(alignment.inlier)} of {len(alignment.inlier)}",
            "chance": alignment.registered.verdict.log10_false_alarms,
            "reason": alignment.reason,
        }
        rows.append(row)
    sources = {f"map {k}": str(path) for k, path in enumerate(paths, start=1)}
    return {
        "title": ", ".join(f"{each.name}: {len(each)} landmarks" for each in maps),
        "verdict": verdict,
        "advice": text,
        "command": command,
        "charts": {"map": plans_figure(plans)},
        "alignments": rows,
        "lower_bound": any(each.registered.refined.lower_bound for each in alignments),
        "rivals": rivals,
        "provenance": {**sources, "seed": seed, "mapfusion": mapfusion.__version__},
    }


def _kept_together(text: str) -> str:
    """Return text that may be broken after commas alone, so that numbers keep their units."""
    return text.replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")


def plans_figure(plans: Sequence[Plan]) -> go.Figure:
    """Return a figure of Plotly with a menu that selects one of the plans."""
    traces, plan_of = list[Attributes](), list[int]()
    for k, plan in enumerate(plans):
        plan_traces = _traces(plan)
        traces += [trace | {"visible": k == 0} for trace in plan_traces]
        plan_of += [k] * len(plan_traces)
    views = [bounds(plan) for plan in plans]
    choices = []
    for k, (plan, (low, high)) in enumerate(zip(plans, views, strict=True)):
        view = {"xaxis.range": [low[0], high[0]], "yaxis.range": [low[1], high[1]]}
        shown = {"visible": [plan_number == k for plan_number in plan_of]}
        label = escaped(plan.title.replace("\n", " "))
        choices.append({"label": label, "method": "update", "args": [shown, view]})
    low, high = views[0]
    axes = {"zeroline": False, "ticksuffix": " m"}
    menu = {"buttons": choices, "x": 0, "xanchor": "left", "y": 1.01, "yanchor": "bottom"}
    return go.Figure(data=traces).update_layout(
        height=_HEIGHT_PX,
        hovermode="closest",
        dragmode="pan",
        xaxis=axes | {"range": [low[0], high[0]], "constrain": "domain"},
        yaxis=axes | {"range": [low[1], high[1]], "scaleanchor": "x"},
        updatemenus=[menu],
        margin={"t": 70, "b": 60},
    )


def _traces(plan: Plan) -> list[Attributes]:
    """Return the traces of a plan: correspondences, then ellipses and points of each part."""
    kinds = (
        ("rejected", plan.rejected, {"color": NEUTRAL, "width": 0.8, "dash": "dot"}),
        ("supporting", plan.accepted, {"color": ACCEPTED_COLOUR, "width": 1.6}),
    )
    traces = list[Attributes]()
    for name, ends, line in kinds:
        if not len(ends):
            continue
        gaps = np.full((len(ends), 1, 2), np.nan)
        points = np.concatenate([ends, gaps], axis=1).reshape(-1, 2)
        about = {"name": f"{name} correspondences: {len(ends)}", "legendgroup": name}
        look = {"type": "scatter", "mode": "lines", "line": line, "hoverinfo": "skip"}
        traces.append(look | about | _xy(points))
        if name == "supporting":  # ends that coincide have no visible line
            ring = {"size": _RING_PX, "symbol": "circle-open", "color": ACCEPTED_COLOUR}
            look = {"type": "scatter", "mode": "markers", "marker": ring, "hoverinfo": "skip"}
            traces.append(look | about | {"showlegend": False} | _xy(ends.mean(axis=1)))
    for part in plan.parts:
        style = chart_style({"color": part.colour, "linestyle": "-", "marker": part.marker})
        name, colour = escaped(part.name), style["hex"]
        ellipses = {"type": "scatter", "mode": "lines", "fill": "toself", "hoverinfo": "skip"}
        ellipses |= {"fillcolor": faint(colour, 0.25), "line": SMOOTH | {"color": colour}}
        ellipses |= {"name": f"{LEVEL_TEXT} ellipses, {name}"}
        points = {"type": "scatter", "mode": "markers", "name": name}
        points |= {"marker": {"size": _POINT_PX, "color": colour, "symbol": style["marker"]}}
        points["hovertemplate"] = f"{name}<br>%{{x:.3f}}, %{{y:.3f}}<extra></extra>"
        outline = ellipse_polygons(part.position_m, part.covariance_m2)
        traces += [ellipses | _xy(outline), points | _xy(part.position_m)]
    return traces


def _xy(points: Float) -> Attributes:
    """Return coordinates in double precision: single would shift maps far from the origin."""
    return {name: points[:, k] for k, name in enumerate("xy")}
