"""What the particles did, kept so that the path of any of them can be told afterwards."""

import numpy as np

from mapfusion.se2 import Float


class History:
    """Poses, ancestors and associations of M particles over the steps so far."""

    def __init__(self, n_particles: int) -> None:
        self._n_steps = 0
        self._n_observations = 0
        self._poses = np.empty((64, n_particles, 3))
        self._ancestors = np.empty((64, n_particles), dtype=np.int32)
        self._step = np.empty(1024, dtype=np.int64)
        self._source = np.empty((1024, n_particles), dtype=np.int32)

    def add(self, T_map_robot: Float, source: np.ndarray) -> None:
        """One step: poses (M, 3) before resampling, and what each observation went into (K, M)."""
        n_particles = len(T_map_robot)
        self._poses = _with_room(self._poses, self._n_steps + 1)
        self._ancestors = _with_room(self._ancestors, self._n_steps + 1)
        self._poses[self._n_steps] = T_map_robot
        self._ancestors[self._n_steps] = np.arange(n_particles)
        stop = self._n_observations + len(source)
        self._step = _with_room(self._step, stop)
        self._source = _with_room(self._source, stop)
        self._step[self._n_observations : stop] = self._n_steps
        self._source[self._n_observations : stop] = source
        self._n_steps += 1
        self._n_observations = stop

    def resampled(self, ancestors: np.ndarray) -> None:
        """After the last step, particle m became a child of ancestors[m] (M,)."""
        self._ancestors[self._n_steps - 1] = ancestors

    def path(self, particle: int) -> Float:
        """Poses (steps, 3) of a particle of today and its ancestors, before each resampling."""
        return self._poses[np.arange(self._n_steps), self._line(particle)]

    def associations(self, particle: int) -> np.ndarray:
        """(n,) int64 source of the landmark each observation went into, -1 where it was dropped."""
        line = self._line(particle)
        n = self._n_observations
        return self._source[np.arange(n), line[self._step[:n]]].astype(np.int64)

    def _line(self, particle: int) -> np.ndarray:
        """(steps,) the ancestors of a particle of today, as numbered before each resampling."""
        line = np.empty(self._n_steps, dtype=np.int64)
        for step in range(self._n_steps - 1, -1, -1):
            particle = self._ancestors[step, particle]
            line[step] = particle
        return line


def _with_room(array: np.ndarray, n_rows: int) -> np.ndarray:
    if n_rows <= len(array):
        return array
    larger = np.empty((max(2 * len(array), n_rows), *array.shape[1:]), dtype=array.dtype)
    larger[: len(array)] = array
    return larger
