"""Alignments between the maps of a team, as arrays, and how motions and their covariances chain."""

from dataclasses import dataclass

import numpy as np

from mapfusion.arguments import require_finite, require_shape
from mapfusion.se2 import Float, compose, inverse


@dataclass(frozen=True)
class Relations:
    """E alignments between N robots' maps.

    Attributes:
        n_robots: N.
        robots: (E, 2) a and b of each, two different ones of 0 to N - 1.
        T_a_b: (E, 3).
        covariance: (E, 3, 3) of T_a_b.
        log10_false_alarms: (E,) of each alignment by itself, the lower the surer.
    """

    n_robots: int
    robots: np.ndarray
    T_a_b: Float
    covariance: Float
    log10_false_alarms: Float

    def __post_init__(self) -> None:
        n = len(self.robots)
        require_shape("robots", self.robots, (n, 2))
        require_shape("T_a_b", self.T_a_b, (n, 3))
        require_shape("covariance", self.covariance, (n, 3, 3))
        require_shape("log10_false_alarms", self.log10_false_alarms, (n,))
        require_finite("T_a_b", self.T_a_b)
        require_finite("covariance", self.covariance)
        if np.any((self.robots < 0) | (self.robots >= self.n_robots)):
            raise ValueError(f"robots: outside 0 to {self.n_robots - 1}")
        if np.any(self.robots[:, 0] == self.robots[:, 1]):
            raise ValueError("robots: an alignment of a map with itself")

    def __len__(self) -> int:
        return len(self.robots)

    def __getitem__(self, rows: np.ndarray) -> "Relations":
        """Some of them."""
        parts = (self.robots, self.T_a_b, self.covariance, self.log10_false_alarms)
        return Relations(self.n_robots, *(part[rows] for part in parts))

    def joined(self, other: "Relations") -> "Relations":
        """With others between the same robots behind them."""
        names = ("robots", "T_a_b", "covariance", "log10_false_alarms")
        both = (np.concatenate([getattr(self, n), getattr(other, n)]) for n in names)
        return Relations(self.n_robots, *both)

    def reach_m(self) -> float:
        """The farthest that any of them moves a map."""
        return float(np.linalg.norm(self.T_a_b[:, :2], axis=1).max(initial=0.0))


def whole_map_covariance(
    T_a_b: Float, covariance: Float, drift_sigma_m: float, p_a: Float
) -> Float:
    """(3, 3) of an alignment with what drift has in common over a map, which leaves no residual.

    The pairs, at p_a (n, 2) in the frame of a, are off by s_drift each; if neighbours are alike,
    as they are where a path bends, all of them shift by as much, and turn by as much as that is
    seen from their middle. An alignment's own covariance takes them for independent.
    """
    if drift_sigma_m == 0 or not len(p_a):
        return covariance
    middle = p_a.mean(axis=0)
    arm_m2 = np.sum((p_a - middle) ** 2, axis=1).mean()
    turn = np.array([middle[1] - T_a_b[1], T_a_b[0] - middle[0], 1.0])  # about the middle
    common = np.diag([1.0, 1.0, 0.0]) + np.outer(turn, turn) / max(arm_m2, drift_sigma_m**2)
    return covariance + drift_sigma_m**2 * common


@dataclass(frozen=True)
class Motions:
    """Motions (n, 3) with their covariances (n, 3, 3)."""

    T: Float
    covariance: Float

    def __getitem__(self, rows: np.ndarray) -> "Motions":
        return Motions(self.T[rows], self.covariance[rows])

    def inverse(self) -> "Motions":
        """The way back, to first order."""
        back = inverse(self.T)
        cos, sin = np.cos(self.T[:, 2]), np.sin(self.T[:, 2])
        J = np.zeros((len(back), 3, 3))
        J[:, 0, 0] = J[:, 1, 1] = -cos
        J[:, 1, 0], J[:, 0, 1] = sin, -sin
        J[:, 0, 2], J[:, 1, 2], J[:, 2, 2] = back[:, 1], -back[:, 0], -1.0
        return Motions(back, J @ self.covariance @ J.swapaxes(1, 2))

    def then(self, other: "Motions") -> "Motions":
        """Chained with motions that are independent of these, to first order."""
        cos, sin = np.cos(self.T[:, 2]), np.sin(self.T[:, 2])
        x, y = other.T[:, 0], other.T[:, 1]
        by_first = np.tile(np.eye(3), (len(x), 1, 1))
        by_first[:, 0, 2], by_first[:, 1, 2] = -sin * x - cos * y, cos * x - sin * y
        by_second = np.zeros((len(x), 3, 3))
        by_second[:, 0, 0] = by_second[:, 1, 1] = cos
        by_second[:, 1, 0], by_second[:, 0, 1], by_second[:, 2, 2] = sin, -sin, 1.0
        covariance = by_first @ self.covariance @ by_first.swapaxes(1, 2)
        covariance += by_second @ other.covariance @ by_second.swapaxes(1, 2)
        return Motions(compose(self.T, other.T), covariance)
