"""Which particle of an earlier generation each particle of today descends from.

A resampling makes a generation. Landmarks are not copied then: they keep the generation in which
they were written, and are read through the ancestors since.
"""

import numpy as np

from mapfusion.kernels import kernel

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


@kernel
def _compose(table: np.ndarray, ancestors: np.ndarray, newest: int, shared: int) -> int:
    """Follow a resampling, in the generations where it makes a difference; the new `shared`."""
    n_particles = table.shape[1]
    old = np.empty(n_particles, np.int32)
    for generation in range(max(shared + 1, newest - len(table) + 1), newest):
        g, is_shared = generation % len(table), True
        for m in range(n_particles):
            old[m] = table[g, m]
        for m in range(n_particles):
            table[g, m] = old[ancestors[m]]
            is_shared &= table[g, m] == table[g, 0]
        if is_shared:
            shared = generation
    for m in range(n_particles):
        table[newest % len(table), m] = m
    return shared
