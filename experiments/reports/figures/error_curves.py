"""Errors against the iteration, for all aligners and robot pairs: figures 4 and 5."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from experiments.evaluation.criteria import ANSWERABLE_PAIRS, ORACLE
from experiments.reports.figures.result_tables import NothingToDraw, Pair, ResultTables, of_pair
from experiments.reports.figures.style import PAGE_WIDTH_IN, PALE_GRAY, aligner_legend
from experiments.studies.error_bands import error_bands, scarce_spans

_PANEL_HEIGHT_IN, _EXTRA_HEIGHT_IN = 1.9, 0.9  # the latter of legend and common x label
_MOST_PAIRS = 10  # a figure of half a metre; 190 pairs would take minutes to draw
_MARKERS_PER_LINE = 8
_BAND_STYLE = {"alpha": 0.16, "linewidth": 0}
_SCARCE_STYLE = {"color": PALE_GRAY, "alpha": 0.5, "linewidth": 0}
# Bands, and lines of more points, are drawn as pixels: evaluated at each iteration, their outlines
# alone would make an SVG of megabytes.
_MAX_VECTOR_POINTS = 200


def draw_error_curves(data: ResultTables, quantity: str, label: str) -> tuple[Figure, np.ndarray]:
    """One row of panels per robot pair: as estimated on the left, refined on the right.

    Of many pairs those with the most to go by are drawn, which the label of the x axis then says.
    `quantity` is a column of the `errors` table. Also returns all values drawn, by which the y axis
    that all panels share is to be set.
    """
    if not data.pairs:
        raise NothingToDraw("no robot pair was aligned")
    if data.no_truth:
        raise NothingToDraw("no truth: errors are unknown")
    errors = data.table("errors")
    pairs = _shown_pairs(data.pairs, errors)
    errors = errors[pd.MultiIndex.from_frame(errors[["robot_a", "robot_b"]]).isin(pairs)]
    bands = error_bands(errors)
    kinds = {"as estimated": quantity, "refined": f"refined_{quantity}"}
    columns = [f"{column}{end}" for column in kinds.values() for end in ("_low", "", "_high")]
    drawn = bands[columns].to_numpy().ravel()
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):
        raise NothingToDraw("no aligner found an estimate at any iteration")
    figure = Figure(figsize=(PAGE_WIDTH_IN, len(pairs) * _PANEL_HEIGHT_IN + _EXTRA_HEIGHT_IN))
    panels = figure.subplots(len(pairs), 2, sharex=True, sharey=True, squeeze=False)
    for row, pair in zip(panels, pairs, strict=True):
        for axes, (kind, column) in zip(row, kinds.items(), strict=True):
            for start, stop in scarce_spans(of_pair(errors, pair)):
                axes.axvspan(start, stop, zorder=0, **_SCARCE_STYLE)
            _draw_panel(axes, data, of_pair(bands, pair), column)
            axes.set_title(f"{pair[0]} - {pair[1]}, {kind}")
        row[0].set_ylabel(label)
    left_out = len(data.pairs) > len(pairs)
    note = f"\n({len(pairs)} of {len(data.pairs)} robot pairs: those with the most true pairs)"
    figure.supxlabel(f"FastSLAM iteration k{note if left_out else ''}", fontsize=8)
    over = f"{errors['run_id'].nunique()} runs" if data.several_runs else "repetitions"
    explained = []
    if any(len(list(scarce_spans(of_pair(errors, pair)))) for pair in pairs):
        explained.append(Patch(label=f"< {ANSWERABLE_PAIRS} true pairs", **_SCARCE_STYLE))
    if banded := _with_band(bands, list(kinds.values())):
        shown = next(name for name in data.aligners if name in banded)
        colour = data.styles[shown]["color"]
        label = f"10-90 % of {over}, as here {shown}'s"
        explained.insert(0, Patch(color=colour, label=label, **_BAND_STYLE))
    looks = {label: data.styles[name] for name, label in data.labels.items()}
    aligner_legend(figure, looks, 4, explained)
    return figure, drawn


def _shown_pairs(pairs: list[Pair], errors: pd.DataFrame) -> list[Pair]:
    """Of many robot pairs those with the most true correspondences at any iteration, in order."""
    if len(pairs) <= _MOST_PAIRS:
        return pairs
    most = errors.groupby(["robot_a", "robot_b"])["n_true"].max()
    chosen = sorted(pairs, key=lambda pair: most[pair], reverse=True)[:_MOST_PAIRS]
    return [pair for pair in pairs if pair in chosen]


def _with_band(bands: pd.DataFrame, columns: Sequence[str]) -> set[str]:
    """Aligners whose repetitions, or runs, differ anywhere: the others' bands cannot be seen."""
    wide = [bands[f"{column}_high"] > bands[f"{column}_low"] for column in columns]
    return set(bands["aligner"][np.any(wide, axis=0)])


def _draw_panel(axes: Axes, data: ResultTables, bands: pd.DataFrame, column: str) -> None:
    shown = [f"{column}_low", column, f"{column}_high"]
    curves = dict(iter(bands.sort_values("iteration").groupby("aligner")))
    for place, name in enumerate(data.aligners):
        curve = curves.get(name, bands[:0])
        iteration = curve["iteration"].to_numpy()
        low, middle, high = curve[shown].to_numpy().T
        band = {"color": data.styles[name]["color"], "zorder": 1, "rasterized": True}
        axes.fill_between(iteration, low, high, **band, **_BAND_STYLE)
        step = max(1, len(curve) // _MARKERS_PER_LINE)
        line = data.styles[name] | {
            "label": name,
            "markevery": (place * step // len(data.aligners), step),
            "zorder": 3 if name == ORACLE else 2,
            "rasterized": len(curve) > _MAX_VECTOR_POINTS,
        }
        axes.plot(iteration, middle, **line)
