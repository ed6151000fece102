"""Figures `refusal_kinds`, `refusal_roc`, `refusal_reliability`: verdicts and their worth."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.evaluation.criteria import MERGEABLE_PAIRS
from experiments.reports.figures import style
from experiments.reports.figures.roc_curves import draw_curves
from experiments.studies.refusal.rates import (
    VERDICTS,
    Reliability,
    as_they_came,
    ordinary,
    right_answers,
)

_COLOURS = dict(zip(VERDICTS, (style.BLUE, style.ORANGE, style.PURPLE, style.GRAY), strict=True))
_KIND_IN, _MARGIN_IN = 0.22, 1.3  # heights of one kind's bar, and of what is around all of them


def draw_kinds(refusals: pd.DataFrame) -> Figure:
    """Verdicts on right answers and on wrong ones, by kind of world, all methods together."""
    rows = as_they_came(refusals)
    right, wrong = right_answers(rows), rows[rows["beats_chance"] & ~rows["right"]]
    kinds = sorted(rows["kind"].unique())[::-1]
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, _MARGIN_IN + _KIND_IN * len(kinds)))
    panels = figure.subplots(1, 2, sharey=True)
    titles = (f"right, {MERGEABLE_PAIRS} or more true pairs", "wrong, though more than chance")
    for axes, own, title in zip(panels, (right, wrong), titles, strict=True):
        _draw_shares(axes, own, kinds)
        axes.set(title=title, xlabel="share of answers (%)", xlim=(0, 100))
    handles, labels = panels[0].get_legend_handles_labels()
    shown = [label.replace("_", " ") for label in labels]
    figure.legend(handles, shown, loc="outside upper center", ncols=len(VERDICTS))
    return figure


def _draw_shares(axes: Axes, rows: pd.DataFrame, kinds: list[str]) -> None:
    """A bar for each kind, of the shares of its verdicts; at its end the number of answers."""
    table = pd.crosstab(rows["kind"], rows["verdict"]).reindex(
        index=kinds, columns=list(VERDICTS), fill_value=0
    )
    n = table.sum(axis=1)
    left = np.zeros(len(kinds))
    for verdict in VERDICTS:
        share = (100 * table[verdict] / n.clip(lower=1)).to_numpy()
        axes.barh(kinds, share, left=left, color=_COLOURS[verdict], label=verdict, height=0.75)
        left += share
    for place, count in enumerate(n):
        axes.text(101, place, f"{count}", va="center", fontsize=6.5, clip_on=False)
    axes.grid(visible=False)


def draw_roc(refusals: pd.DataFrame) -> Figure:
    """False against missed merges of each method, of ordinary worlds and of such that repeat.

    By the test against chance, and below by the probability that verdicts state, where they do.
    """
    scores = {"log10_false_alarms": "by false alarms"}
    if refusals["probability"].notna().any():
        scores["doubt"] = "by probability"
    refusals = refusals.assign(doubt=-refusals["probability"])
    worlds = {
        "ordinary worlds": ordinary(refusals),
        "worlds that repeat themselves": refusals[refusals["repeats"]],
    }
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, 0.8 + 2.9 * len(scores)))
    panels = figure.subplots(len(scores), 2, squeeze=False)
    for row, (score, by) in zip(panels, scores.items(), strict=True):
        for axes, (title, own) in zip(row, worlds.items(), strict=True):
            if len(own):
                draw_curves(axes, own, score)
            axes.set_title(f"{title}, {by}")
    labelled = [axes.get_legend_handles_labels() for axes in panels.flat]
    legend = {"loc": "outside upper center", "ncols": 5, "handlelength": 3.2}
    figure.legend(*max(labelled, key=lambda both: len(both[1])), **legend)
    return figure


def draw_reliability(found: Reliability) -> Figure:
    """Share of right answers against the probability stated for them, in bins of equal count."""
    figure = Figure(figsize=(style.PAGE_WIDTH_IN / 2, 3.4))
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=style.PALE_GRAY, linewidth=2.5, label="as stated")
    bins = found.bins
    off = np.abs(bins[["right_low", "right_high"]].to_numpy().T - bins["right"].to_numpy())
    label = f"{found.n} answers, {found.n_wrong} wrong"
    axes.errorbar(
        bins["stated"],
        bins["right"],
        yerr=off,
        color=style.BLUE,
        marker="o",
        linestyle="",
        label=label,
    )
    error = found.calibration_error.value
    axes.set_title(f"calibration error {error:.3f}, Brier score {found.brier.value:.4f}")
    axes.set(xlabel="probability stated (mean of a tenth)", ylabel="share that is right")
    axes.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), aspect="equal")
    axes.legend(loc="upper left")
    return figure
