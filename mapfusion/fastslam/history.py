"""What the particles did, kept so that the path of any of them can be told afterwards."""

import numpy as np

from mapfusion.se2 import Float, compose

# Steps between two prunings, at least; as many as half of what the last one looked through, so that
# a step's share of them does not grow.
_PRUNED_EVERY = 256


class History:
    """Poses, ancestors and associations, a list entry a step.

    Of a step only those particles are kept from which some particle of today descends: at first all
    M, and one alone from where the lines of all have met.
    """

    def __init__(self) -> None:
        self._poses: list[Float] = []
        self._ancestors: list[np.ndarray] = []  # of the next step's particles, or of today's
        self._sources: list[np.ndarray] = []
        self._bent = np.empty((0, 3))  # motion of the map since each step, for the first steps
        self._n_pruned = 0
        self._next_pruning = _PRUNED_EVERY

    def add(self, T_map_robot: Float, source: np.ndarray) -> None:
        """One step: poses (M, 3) before resampling, and what each observation went into (K, M)."""
        self._poses.append(T_map_robot.copy())
        self._ancestors.append(np.arange(len(T_map_robot), dtype=np.int32))
        self._sources.append(source)
        if len(self._poses) == self._next_pruning:
            self._prune()

    def resampled(self, ancestors: np.ndarray) -> None:
        """After the last step, particle m became a child of ancestors[m] (M,)."""
        self._ancestors[-1] = ancestors

    def bent(self, T_map_bent: Float) -> None:
        """Every particle's poses (steps, 3) so far move by these motions of the map."""
        known = np.zeros((len(T_map_bent), 3))
        known[: len(self._bent)] = self._bent
        self._bent = compose(T_map_bent, known)

    def path(self, particle: int) -> Float:
        """Poses (steps, 3) of a particle of today and its ancestors, before each resampling."""
        line = self._line(particle)
        own = [poses[m] for poses, m in zip(self._poses, line, strict=True)]
        path = np.array(own).reshape(-1, 3)
        n_bent = len(self._bent)
        return np.concatenate([compose(self._bent, path[:n_bent]), path[n_bent:]])

    def associations(self, particle: int) -> np.ndarray:
        """(n,) int64 source of the landmark each observation went into, -1 where it was dropped."""
        line = self._line(particle)
        own = [source[:, m] for source, m in zip(self._sources, line, strict=True)]
        return np.concatenate([np.empty(0, dtype=np.int64), *own])

    @property
    def n_kept(self) -> int:
        """Particles that are kept, over all steps."""
        return sum(map(len, self._poses))

    def _line(self, particle: int) -> list[int]:
        """Where a particle of today and its ancestors are kept, step by step."""
        line = []
        for ancestors in reversed(self._ancestors):
            particle = int(ancestors[particle])
            line.append(particle)
        return line[::-1]

    def _prune(self) -> None:
        """Forget those whose line has died out."""
        step = len(self._poses) - 1
        while step >= 0:
            kept, place = np.unique(self._ancestors[step], return_inverse=True)
            all_live = len(kept) == len(self._poses[step])
            if all_live and step < self._n_pruned:
                break  # as it was after the last pruning, and so are those before it
            if not all_live:
                self._ancestors[step] = place.astype(np.int32)
                self._poses[step] = self._poses[step][kept]
                self._sources[step] = self._sources[step][:, kept]
                if step > 0:
                    self._ancestors[step - 1] = self._ancestors[step - 1][kept]
            step -= 1
        n_looked_through = len(self._poses) - 1 - step
        self._n_pruned = len(self._poses)
        self._next_pruning = self._n_pruned + max(_PRUNED_EVERY, n_looked_through // 2)
