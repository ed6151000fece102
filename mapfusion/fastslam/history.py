"""What the particles did, kept so that the path of any of them can be told afterwards."""

import numpy as np

from mapfusion.se2 import Float


class History:
    """Poses, ancestors and associations of M particles, a list entry a step."""

    def __init__(self) -> None:
        self._poses: list[Float] = []
        self._ancestors: list[np.ndarray] = []
        self._sources: list[np.ndarray] = []

    def add(self, T_map_robot: Float, source: np.ndarray) -> None:
        """One step: poses (M, 3) before resampling, and what each observation went into (K, M)."""
        self._poses.append(T_map_robot.copy())
        self._ancestors.append(np.arange(len(T_map_robot), dtype=np.int32))
        self._sources.append(source.astype(np.int32))

    def resampled(self, ancestors: np.ndarray) -> None:
        """After the last step, particle m became a child of ancestors[m] (M,)."""
        self._ancestors[-1] = ancestors

    def path(self, particle: int) -> Float:
        """Poses (steps, 3) of a particle of today and its ancestors, before each resampling."""
        line = self._line(particle)
        own = [poses[m] for poses, m in zip(self._poses, line, strict=True)]
        return np.array(own).reshape(-1, 3)

    def associations(self, particle: int) -> np.ndarray:
        """(n,) int64 source of the landmark each observation went into, -1 where it was dropped."""
        line = self._line(particle)
        own = [source[:, m] for source, m in zip(self._sources, line, strict=True)]
        return np.concatenate([np.empty(0, dtype=np.int64), *own])

    def _line(self, particle: int) -> list[int]:
        """The ancestors of a particle of today, as numbered before each resampling."""
        line = []
        for ancestors in reversed(self._ancestors):
            particle = int(ancestors[particle])
            line.append(particle)
        return line[::-1]
