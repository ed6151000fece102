"""Pose graph of a team: alignments as edges, robot poses by least squares.

Grisetti, Kuemmerle, Stachniss, Burgard (2010), "A tutorial on graph-based SLAM", with the residual
T_a_b(x) - T_a_b in the frame of a, whose covariance is the alignment's.
"""

from dataclasses import dataclass

import numpy as np

from mapfusion.geometry.numerics import Float, require_finite, require_shape
from mapfusion.geometry.se2 import IDENTITY, between, compose, inverse, rotation, wrap


@dataclass(frozen=True)
class AlignmentEdges:
    """E alignments between N robots' maps.

    Attributes:
        n_robots: number of robots N.
        robots: different robots a and b of each alignment, 0 to N - 1, shape (E, 2).
        T_a_b: pose of map b in map a, shape (E, 3).
        covariance: covariances of T_a_b, shape (E, 3, 3).
        log10_false_alarms: logarithm of the expected number of false alarms of each alignment,
            shape (E,).
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

    def __getitem__(self, rows: np.ndarray) -> "AlignmentEdges":
        """Return the edges with these row numbers."""
        parts = (self.robots, self.T_a_b, self.covariance, self.log10_false_alarms)
        return AlignmentEdges(self.n_robots, *(part[rows] for part in parts))

    def concatenated(self, other: "AlignmentEdges") -> "AlignmentEdges":
        """Return these edges followed by others between the same robots."""
        names = ("robots", "T_a_b", "covariance", "log10_false_alarms")
        joined = (np.concatenate([getattr(self, n), getattr(other, n)]) for n in names)
        return AlignmentEdges(self.n_robots, *joined)

    def max_distance_m(self) -> float:
        """Return the largest translation of an edge, in m."""
        return float(np.linalg.norm(self.T_a_b[:, :2], axis=1).max(initial=0.0))


@dataclass(frozen=True)
class Motions:
    """Motions (n, 3) with their covariances (n, 3, 3)."""

    T: Float
    covariance: Float

    def __getitem__(self, rows: np.ndarray) -> "Motions":
        return Motions(self.T[rows], self.covariance[rows])

    def inverse(self) -> "Motions":
        """Return the inverse motions, with covariances to first order."""
        T_inverse = inverse(self.T)
        cos, sin = np.cos(self.T[:, 2]), np.sin(self.T[:, 2])
        J = np.zeros((len(T_inverse), 3, 3))
        J[:, 0, 0] = J[:, 1, 1] = -cos
        J[:, 1, 0], J[:, 0, 1] = sin, -sin
        J[:, 0, 2], J[:, 1, 2], J[:, 2, 2] = T_inverse[:, 1], -T_inverse[:, 0], -1.0
        return Motions(T_inverse, J @ self.covariance @ J.swapaxes(1, 2))

    def compose_independent(self, other: "Motions") -> "Motions":
        """Compose with independent motions, with covariances to first order."""
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


# Number of Gauss-Newton steps. For consistent edges the steps converge after the third.
_STEPS = 4


@dataclass(frozen=True)
class Placement:
    """Poses of n robots' maps in the frame of one of them, the root.

    Attributes:
        row: row of each robot of the team in the arrays below, shape (N,); -1 for none.
        T_root_robot: poses, shape (n, 3); the first is the root, at the identity.
        covariance: joint covariance of all poses, shape (n, n, 3, 3); zero for the root.
    """

    row: np.ndarray
    T_root_robot: Float
    covariance: Float

    def contains(self, robots: np.ndarray) -> np.ndarray:
        """Return True for robots (...) with a pose."""
        return self.row[robots] >= 0

    def squared_distances(self, robots: np.ndarray, motions: Motions) -> tuple[Float, Float]:
        """Compare motions between pairs of robots (n, 2) with the placement.

        The motions are independent of the placement.

        Returns:
            squared Mahalanobis distances (n,) and their covariances S (n, 3, 3).
        """
        a, b = self.row[robots[:, 0]], self.row[robots[:, 1]]
        e, jacobian_a, jacobian_b = _residuals(self.T_root_robot, a, b, motions.T)
        P = self.covariance
        S = motions.covariance + jacobian_a @ P[a, a] @ jacobian_a.swapaxes(1, 2)
        S = S + jacobian_b @ P[b, b] @ jacobian_b.swapaxes(1, 2)
        cross = jacobian_a @ P[a, b] @ jacobian_b.swapaxes(1, 2)
        S = S + cross + cross.swapaxes(1, 2)
        return np.einsum("ni,ni->n", e, np.linalg.solve(S, e[:, :, None])[:, :, 0]), S

    def relative(self, robots: np.ndarray) -> Motions:
        """Return T_a_b of pairs (n, 2) of robots."""
        a, b = self.row[robots[:, 0]], self.row[robots[:, 1]]
        T = between(self.T_root_robot[a], self.T_root_robot[b])
        _, S = self.squared_distances(robots, Motions(T, np.zeros((len(T), 3, 3))))
        return Motions(T, S)


def optimize_poses(edges: AlignmentEdges, rows: np.ndarray, root: int | None = None) -> Placement:
    """Compute the poses of the robots that edges connect.

    Args:
        edges: the alignments.
        rows: rows of the edges that are used.
        root: robot that defines the frame; by default the first robot.

    Raises:
        ValueError: the edges do not connect their robots.
    """
    robots = np.unique(edges.robots[rows])
    if root is not None:
        robots = np.concatenate([[root], robots[robots != root]])
    row = np.full(edges.n_robots, -1)
    row[robots] = np.arange(len(robots))
    a, b = row[edges.robots[rows]].T
    T, covariance = edges.T_a_b[rows], edges.covariance[rows]
    # initial poses: chains of alignments from the root
    n = len(robots)
    at = np.full((n, 3), np.nan)
    at[0] = IDENTITY
    while not np.isfinite(at).all():
        is_placed = np.isfinite(at[:, 0])
        forward, backward = is_placed[a] & ~is_placed[b], is_placed[b] & ~is_placed[a]
        if not (forward | backward).any():
            raise ValueError("rows: these alignments do not connect their robots")
        at[b[forward]] = compose(at[a[forward]], T[forward])
        at[a[backward]] = compose(at[b[backward]], inverse(T[backward]))
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    for _ in range(_STEPS):
        normal, right = _equations(at, a, b, T, information)
        step = np.linalg.solve(normal, right).reshape(-1, 3)
        at[1:] += step
        at[:, 2] = wrap(at[:, 2])
    P = np.zeros((n, n, 3, 3))
    joint = np.linalg.inv(_equations(at, a, b, T, information)[0])
    P[1:, 1:] = joint.reshape(n - 1, 3, n - 1, 3).swapaxes(1, 2)
    return Placement(row, at, P)


def _residuals(at: Float, a: np.ndarray, b: np.ndarray, T_a_b: Float) -> tuple[Float, Float, Float]:
    """Return residuals (n, 3) and their Jacobians (n, 3, 3) by the poses of a and of b."""
    n = len(a)
    e = between(at[a], at[b]) - T_a_b
    e[:, 2] = wrap(e[:, 2])
    to_a = rotation(at[a, 2]).swapaxes(1, 2)
    translation = at[b, :2] - at[a, :2]
    jacobian_a, jacobian_b = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    jacobian_b[:, :2, :2], jacobian_b[:, 2, 2] = to_a, 1.0
    jacobian_a[:, :2, :2], jacobian_a[:, 2, 2] = -to_a, -1.0
    jacobian_a[:, :2, 2] = np.einsum(
        "nij,nj->ni", to_a, np.stack([translation[:, 1], -translation[:, 0]], 1)
    )
    return e, jacobian_a, jacobian_b


def _equations(
    at: Float, a: np.ndarray, b: np.ndarray, T_a_b: Float, information: Float
) -> tuple[Float, Float]:
    """Return normal matrix and right side for a step of all poses except the first."""
    n = len(at)
    e, jacobian_a, jacobian_b = _residuals(at, a, b, T_a_b)
    normal, right = np.zeros((n, n, 3, 3)), np.zeros((n, 3))
    for i, J in ((a, jacobian_a), (b, jacobian_b)):
        weighted = J.swapaxes(1, 2) @ information
        np.add.at(right, i, -np.einsum("nij,nj->ni", weighted, e))
        for k, K in ((a, jacobian_a), (b, jacobian_b)):
            np.add.at(normal, (i, k), weighted @ K)
    size = 3 * (n - 1)
    return normal[1:, 1:].swapaxes(1, 2).reshape(size, size), right[1:].ravel()
