"""Poses at times of their own, as trajectories and true states come, at the times of frames."""

from dataclasses import dataclass

import numpy as np

from mapfusion.arguments import require_finite, require_shape
from mapfusion.se2 import Float

_SAME_TIME_NS = 1_000  # a pose this near in time is the frame's own: what clocks are printed with


@dataclass(frozen=True)
class TimedPoses:
    """Poses of one body in one frame.

    Attributes:
        time_ns: (N,) int64, increasing.
        T: (N, 4, 4).
    """

    time_ns: np.ndarray
    T: Float

    def __post_init__(self) -> None:
        require_shape("T", self.T, (len(self.time_ns), 4, 4))
        require_finite("T", self.T)
        if np.any(np.diff(self.time_ns) <= 0):
            raise ValueError("time_ns: must increase")

    def moved(self, T_body_other: Float) -> "TimedPoses":
        """The poses of another body that is fixed to this one."""
        return TimedPoses(self.time_ns, self.T @ T_body_other)

    def at(self, time_ns: np.ndarray, longest_gap_s: float) -> Float:
        """Poses (T, 4, 4) at other times: the nearest within a microsecond, else between two.

        Between two the position is interpolated straight and the rotation at constant speed. NaN
        before the first, after the last and in gaps longer than `longest_gap_s`.
        """
        found = np.full((len(time_ns), 4, 4), np.nan)
        if not len(self.time_ns):
            return found
        after = np.clip(np.searchsorted(self.time_ns, time_ns), 1, max(len(self.time_ns) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self.time_ns) - 1)
        own = np.where(
            np.abs(self.time_ns[before] - time_ns) < np.abs(self.time_ns[after] - time_ns),
            before,
            after,
        )
        same = np.abs(self.time_ns[own] - time_ns) <= _SAME_TIME_NS
        found[same] = self.T[own[same]]
        gap_ns = self.time_ns[after] - self.time_ns[before]
        inside = (self.time_ns[before] <= time_ns) & (time_ns <= self.time_ns[after])
        rest = np.flatnonzero(~same & inside & (gap_ns <= 1e9 * longest_gap_s))
        if len(rest):
            share = (time_ns - self.time_ns[before])[rest] / gap_ns[rest]
            found[rest] = _between(self.T[before[rest]], self.T[after[rest]], share)
        return found


def _between(first: Float, second: Float, share: Float) -> Float:
    """Poses (N, 4, 4) at shares (N,) of the way from one to another."""
    from scipy.spatial.transform import Rotation

    made = np.array(first)
    made[:, :3, 3] += share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    turn = Rotation.from_matrix(first[:, :3, :3].swapaxes(1, 2) @ second[:, :3, :3])
    part = Rotation.from_rotvec(share[:, None] * turn.as_rotvec())
    made[:, :3, :3] = first[:, :3, :3] @ part.as_matrix()
    return made
