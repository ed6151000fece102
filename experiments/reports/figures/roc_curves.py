"""False merges against missed ones as the threshold of a verdict moves, a curve for each method."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from experiments.evaluation.criteria import MERGEABLE_PAIRS
from experiments.reports.figures import style
from experiments.reports.figures.style import BLACK, GRAY
from experiments.studies.refusal.rates import Rate, mergeable, swept, without_common_ground

_SUPPORT_OF = "ransac"  # whose plain number of inliers is swept for comparison
_LEAST_DECADES = 0.5  # shares of zero are drawn so far below one in all pairs


def draw_curves(axes: Axes, refusals: pd.DataFrame, score: str) -> None:
    """A curve for each method as the threshold on a column moves, and the point it works at.

    The smaller the score, the surer the verdict.
    """
    floor = _floor(refusals)
    scored = refusals.assign(score=refusals[score])
    styles = style.aligner_styles(refusals["aligner"].unique().tolist())
    for name, own in scored.groupby("aligner", sort=False):
        line = styles[str(name)] | {"marker": None, "label": name}
        _draw_sweep(axes, own, floor, **line)
        _draw_point(axes, own, floor, line["color"])
    axes.set(xscale="log", yscale="log", xlim=(floor[0] / 1.3, 1.3), ylim=(floor[1] / 1.3, 1.3))
    axes.set_xlabel("false merges: no common ground (left edge: none)")
    axes.set_ylabel(f"missed merges: {MERGEABLE_PAIRS}+ true pairs (bottom: none)")
    for axis in (axes.xaxis, axes.yaxis):
        style.write_plainly(axis)


def draw_support(axes: Axes, refusals: pd.DataFrame) -> None:
    """The curve that a threshold on the plain number of inliers gives."""
    own = refusals[refusals["aligner"] == _SUPPORT_OF]
    label = f"{_SUPPORT_OF}, number of inliers alone"
    line = {"color": GRAY, "linestyle": ":", "label": label}
    _draw_sweep(axes, own.assign(score=-own["n_inliers"]), _floor(refusals), **line)


def _floor(refusals: pd.DataFrame) -> np.ndarray:
    """Where shares (false, missed) of zero are drawn."""
    n_of_all = np.array([len(rows(refusals)) for rows in (without_common_ground, mergeable)])
    n_pairs = np.maximum(n_of_all / refusals["aligner"].nunique(), 1)
    return 10**-_LEAST_DECADES / n_pairs


def _draw_sweep(axes: Axes, own: pd.DataFrame, floor: np.ndarray, **line: Any) -> None:
    thresholds = np.unique(own["score"].dropna())
    false = swept(without_common_ground(own)["score"], thresholds)
    found = swept(mergeable(own)["score"], thresholds)
    axes.plot(np.maximum(false, floor[0]), np.maximum(1 - found, floor[1]), **line)


def _draw_point(axes: Axes, own: pd.DataFrame, floor: np.ndarray, colour: str) -> None:
    """The operating point with its Wilson intervals."""
    false, missed = without_common_ground(own)["accepted"], ~mergeable(own)["accepted"]
    rates = (Rate.of(false), Rate.of(missed))
    point = np.maximum([rate.share for rate in rates], floor)
    for axis, rate in enumerate(rates):
        ends = np.tile(point, (2, 1))
        low, high = np.clip(rate.interval, floor[0] / 2, None)
        ends[:, axis] = min(low, point[axis]), high
        axes.plot(*ends.T, color=colour, linewidth=3, alpha=0.35)
    axes.plot(*point, marker="o", color=colour, markeredgecolor=BLACK, clip_on=False, zorder=5)
