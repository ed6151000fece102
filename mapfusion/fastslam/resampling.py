"""Weights of particles, and drawing a new generation from them."""

import numpy as np

from mapfusion.se2 import Float


def normalised(log_weights: Float) -> tuple[Float, float]:
    """Log weights (M,) shifted so that the weights sum to one, and the log of their sum before."""
    top = log_weights.max()
    log_sum = float(top + np.log(np.sum(np.exp(log_weights - top))))
    return log_weights - log_sum, log_sum


def effective_sample_size(log_weights: Float) -> float:
    """1 / sum of squared weights: M when all are equal, 1 when one particle has all."""
    weights = np.exp(log_weights)
    return min(1.0 / float(np.sum(weights**2)), float(len(weights)))


def systematic_ancestors(log_weights: Float, rng: np.random.Generator) -> np.ndarray:
    """Parents (M,) int32 of the next generation, ascending (low-variance resampling).

    A particle of weight w has floor(M w) or ceil(M w) children, M w on average. So the heaviest
    particle always has one; rounding could only deny it where all weights are equal, and is
    overruled there.
    """
    n = len(log_weights)
    cumulated = np.cumsum(np.exp(log_weights))
    pointers = (np.arange(n) + rng.random()) * (cumulated[-1] / n)
    ancestors = np.minimum(np.searchsorted(cumulated, pointers, side="right"), n - 1)
    heaviest = int(np.argmax(log_weights))
    place = min(int(np.searchsorted(ancestors, heaviest)), n - 1)
    ancestors[place] = heaviest
    return ancestors.astype(np.int32)
