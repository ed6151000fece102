"""Resampling of particles and their genealogy.

Each resampling starts a generation. It copies no landmarks: a landmark keeps the generation in
which its row was written, and is read through the ancestors since then.
"""

import numpy as np

from mapfusion.geometry.numerics import Float


def normalised(log_weights: Float) -> tuple[Float, float]:
    """Return log weights (M,) whose weights sum to one, and the log of the sum before."""
    top = log_weights.max()
    log_sum = float(top + np.log(np.sum(np.exp(log_weights - top))))
    return log_weights - log_sum, log_sum


def effective_sample_size(log_weights: Float) -> float:
    """Return 1 / sum of squared weights: M for equal weights, 1 if one particle has all."""
    weights = np.exp(log_weights)
    return min(1.0 / float(np.sum(weights**2)), float(len(weights)))


def systematic_ancestors(log_weights: Float, rng: np.random.Generator) -> np.ndarray:
    """Draw the parents (M,) int32 of the next generation, ascending (low-variance resampling).

    A particle of weight w has floor(M w) or ceil(M w) children, and M w on average. Hence the
    heaviest particle has at least one child. For equal weights, rounding could deny it this child;
    the function corrects this.
    """
    n = len(log_weights)
    cumulated = np.cumsum(np.exp(log_weights))
    pointers = (np.arange(n) + rng.random()) * (cumulated[-1] / n)
    ancestors = np.minimum(np.searchsorted(cumulated, pointers, side="right"), n - 1)
    heaviest = int(np.argmax(log_weights))
    child_of_heaviest = min(int(np.searchsorted(ancestors, heaviest)), n - 1)
    ancestors[child_of_heaviest] = heaviest
    return ancestors.astype(np.int32)


# Generations that the genealogy holds. Every row is written at least once in this many resamplings
# (see `ParticleMaps`). A larger number makes each resampling slower; a smaller number makes rows
# be written more often.
MEMORY = 256


class Genealogy:
    """Ancestors of M particles in the last MEMORY generations.

    Attributes:
        generation: number of the present generation.
        ancestors: (MEMORY, M); `ancestors[g % MEMORY, m]` is the ancestor in generation g of the
            present particle m.
    """

    def __init__(self, n_particles: int) -> None:
        self.generation = 0
        self.ancestors = np.zeros((MEMORY, n_particles), dtype=np.int32)
        self.ancestors[0] = np.arange(n_particles)
        self._shared = -1  # up to this generation all particles have the same ancestor

    def resample(self, parents: np.ndarray) -> None:
        """Start a generation whose particle m is a child of the present particle parents[m]."""
        self.generation += 1
        table, newest = self.ancestors, self.generation
        # Only generations in which ancestors differ need an update.
        generations = np.arange(max(self._shared + 1, newest - MEMORY + 1), newest)
        rows = generations % MEMORY
        table[rows] = table[rows[:, None], parents]
        is_shared = np.all(table[rows] == table[rows, :1], axis=1)
        table[newest % MEMORY] = np.arange(table.shape[1])
        self._shared = int(generations[is_shared].max(initial=self._shared))
