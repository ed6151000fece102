"""Which particle of an earlier generation each particle of today descends from.

A resampling makes a generation. Landmarks are not copied then: they keep the generation in which
they were written, and are read through the ancestors since.
"""

import numpy as np
from numba import njit

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

    def resampled(self, ancestors: np.ndarray) -> None:
        """A new generation: its particle m is a child of the present particle ancestors[m] (M,)."""
        self.generation += 1
        _compose(self.ancestors, ancestors, self.generation % MEMORY)

    # `ancestors[g % MEMORY, m]` is the ancestor in generation g of the present particle m.


@njit(cache=True)
def _compose(table: np.ndarray, ancestors: np.ndarray, newest: int) -> None:
    n_particles = table.shape[1]
    old = np.empty(n_particles, dtype=table.dtype)
    for row in range(len(table)):
        old[:] = table[row]
        for m in range(n_particles):
            table[row, m] = old[ancestors[m]]
    table[newest] = np.arange(n_particles)
