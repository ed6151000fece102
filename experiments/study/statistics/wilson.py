"""Confidence intervals of success rates: Wilson's, and what dependent rows count for in it."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri

from mapfusion.se2 import Float

CONFIDENCE = 0.95


def wilson(
    successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE
) -> tuple[Float, Float]:
    """Lower and upper ends of the score interval of a binomial proportion (Wilson 1927).

    Unlike the textbook interval it keeps its level for few trials and for rates near 0 and 1.
    Counts need not be whole; where there are no trials, nothing is known: [0, 1].

    Raises:
        ValueError: negative counts, more successes than trials, or a level not in (0, 1).
    """
    k, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(trials, float))
    if not 0 < confidence < 1:
        raise ValueError("confidence: must lie between 0 and 1")
    if np.any(k < 0) or np.any(k > n + 1e-9 * (1 + n)):  # sums of fractions round
        raise ValueError("successes: must lie between 0 and trials")
    z2 = ndtri((1 + confidence) / 2) ** 2
    known = n > 0
    rate = np.minimum(np.divide(k, n, out=np.full(n.shape, 0.5), where=known), 1.0)
    centre = (n * rate + z2 / 2) / (n + z2)
    half = np.sqrt(z2 * (n * rate * (1 - rate) + z2 / 4)) / (n + z2)
    # at rates of 0 and 1 centre and half cancel to within rounding
    low = np.where(known & (rate > 0), np.maximum(centre - half, 0.0), 0.0)
    high = np.where(known & (rate < 1), np.minimum(centre + half, 1.0), 1.0)
    return low, high


def effective_trials(rows_per_cluster: ArrayLike) -> float:
    """How many independent trials rows in clusters are worth at the least (Kish 1965).

    Whatever the dependence inside a cluster, a rate p over rows has a variance of at most
    p (1 - p) sum m_i^2 / (sum m_i)^2, reached when all rows of a cluster share one fate. So an
    interval with n = (sum m_i)^2 / sum m_i^2 trials never claims too much.
    """
    rows = np.asarray(rows_per_cluster, dtype=np.float64)
    total = rows.sum()
    return float(total**2 / np.sum(rows**2)) if total > 0 else 0.0
