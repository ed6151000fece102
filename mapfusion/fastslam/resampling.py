"""Resampling of particles, and the ancestry that it leaves.

A resampling makes a generation. Landmarks are not copied then: they keep the generation in which
they were written, and are read through the ancestors since.
"""

import numpy as np

from mapfusion.geometry.numerics import Float


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


# Generations that are remembered. Every landmark is written at least once in this many resamplings
# (see `particles.py`); a longer memory costs each resampling more, a shorter one makes that
# refreshing dearer.
MEMORY = 256


class Genealogy:
    """The last MEMORY generations of M particles."""

    def __init__(self, n_particles: int) -> None:
        self.generation = 0
        self.ancestors = np.zeros((MEMORY, n_particles), dtype=np.int32)
        self.ancestors[0] = np.arange(n_particles)
        self._shared = -1  # up to this generation all particles have one and the same ancestor

    def resampled(self, ancestors: np.ndarray) -> None:
        """A new generation: its particle m is a child of the present particle ancestors[m] (M,)."""
        self.generation += 1
        self._shared = _compose(self.ancestors, ancestors, self.generation, self._shared)

    # `ancestors[g % MEMORY, m]` is the ancestor in generation g of the present particle m.


def _compose(table: np.ndarray, ancestors: np.ndarray, newest: int, shared: int) -> int:
    """Follow a resampling, in the generations where it makes a difference; the new `shared`."""
    generations = np.arange(max(shared + 1, newest - len(table) + 1), newest)
    rows = generations % len(table)
    table[rows] = table[rows[:, None], ancestors]
    is_shared = np.all(table[rows] == table[rows, :1], axis=1)
    table[newest % len(table)] = np.arange(table.shape[1])
    return int(generations[is_shared].max(initial=shared))
