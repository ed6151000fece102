"""How often each method is right, against what makes it hard, with Wilson intervals.

Rows of one run depend on each other: its maps grow from one another, its pairs share robots, the
repetitions share maps. So the trials of Wilson's interval are runs (`effective_trials`).
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import at_the_end, has_common_ground
from experiments.judge.judged_maps import methods_in
from experiments.study.statistics.intervals import clusters_of, effective_trials, wilson
from mapfusion.se2 import Float

LAST = "last"
# Counts roughly double or treble from bin to bin; shares lie dense where methods begin to fail.
# Below 3 true pairs not even the oracle has an answer worth the name.
_COUNT_EDGES = (0, 3, 10, 30, 100, 300, 1000, np.inf)
EDGES: dict[str, tuple[float, ...]] = {
    "n_common": _COUNT_EDGES,
    "n_true": _COUNT_EDGES,
    "overlap_share": (0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1),
    "outlier_share": (0, 0.2, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1),
    LAST: (0, np.inf),
}
BY = ("iteration", *EDGES)
_ITERATION_BINS = 8
_WITHOUT_TEST = ("estimated_success", "refined_success")
_WITH_TEST = (*_WITHOUT_TEST, "accepted", "false_accepted", "refused_apart")


def success_rates(
    maps: pd.DataFrame, by: str, edges: Sequence[float] | None = None
) -> pd.DataFrame:
    """Success rates of each method over rows of `maps_of`, binned.

    Args:
        maps: for overlap_share, only rows that `with_overlap_share` went over.
        by: iteration, n_common (landmarks that truly correspond), overlap_share (n_common over
            the smaller map's landmarks), n_true (true pairs among the correspondences),
            outlier_share (1 - n_true / n_correspondences) or last (the last iteration of each
            robot pair alone).
        edges: of the bins, rising; each holds its lower edge, the last one both.

    Returns:
        One row per bin and method: from, to, aligner, n_runs, n_maps, n_apart (those without common
        ground), unit, and shares with their 95 % interval (_low, _high): of the maps with
        common ground estimated_success, refined_success and accepted; of all false_accepted; of
        those without common ground refused_apart. Without a test of acceptance the first two.

    Raises:
        ValueError: an unknown `by`, or edges that do not rise.
    """
    if by not in BY:
        raise ValueError(f"by: is {by}, expected one of {', '.join(BY)}")
    if by != LAST and by not in maps:
        raise ValueError(f"by: these rows have no {by}")
    used = at_the_end(maps) if by == LAST else maps
    clusters = clusters_of(used)
    # of LAST a single bin holds all
    values = used["n_common" if by == LAST else by].to_numpy(dtype=np.float64)
    chosen = np.asarray(_edges(by, values) if edges is None else edges, dtype=np.float64)
    if len(chosen) < 2 or np.any(np.diff(chosen) <= 0):
        raise ValueError("edges: must be two or more that rise")
    place = np.searchsorted(chosen, values, side="right") - 1
    place[values == chosen[-1]] = len(chosen) - 2
    rows = []
    for number, limits in enumerate(pairwise(chosen)):
        for aligner in methods_in(maps, oracle=True):
            inside = (place == number) & (used["aligner"] == aligner).to_numpy()
            if inside.any():
                row = dict(zip(("from", "to"), limits, strict=True)) | {"aligner": aligner}
                row |= _rates(used[inside], clusters.codes[inside])
                rows.append(row | {"unit": clusters.unit})
    rates = pd.DataFrame(rows)
    return rates.drop(columns=["from", "to"]) if by == LAST else rates


def _edges(by: str, values: Float) -> Sequence[float]:
    if by != "iteration":
        return EDGES[by]
    iterations = np.unique(values)
    groups = np.array_split(iterations, min(_ITERATION_BINS, len(iterations)))
    return [*(group[0] for group in groups), values.max() + 1]


def _rates(rows: pd.DataFrame, codes: np.ndarray) -> dict[str, Any]:
    """Shares of one bin and method, with their intervals."""
    ground = has_common_ground(rows).to_numpy()
    found: dict[str, Any] = {"n_runs": rows["run_id"].nunique(), "n_maps": len(rows)}
    found |= {"n_apart": int(np.count_nonzero(~ground))}
    for name in _WITH_TEST if rows["accepted"].notna().any() else _WITHOUT_TEST:
        known = rows[name].notna().to_numpy() & (ground if name == "accepted" else True)
        share = low = high = np.nan
        if known.any():
            n = effective_trials(np.unique(codes[known], return_counts=True)[1])
            share = float(rows[name][known].mean())
            low, high = map(float, wilson(share * n, n))
        found |= {name: share, f"{name}_low": low, f"{name}_high": high}
    return found
