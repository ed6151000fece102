"""Graphs of poses and landmarks in the plane, in the g2o format.

Kuemmerle, Grisetti, Strasdat, Konolige, Burgard (2011), "g2o: A general framework for graph
optimization". An EDGE_SE2 measures Z by the error of Z^-1 (X_i^-1 X_j), whose position is in the
frame that Z leads to; a covariance of (x, y, theta) in the frame that it starts from, as all of
ours are, is turned for it.
"""

import numpy as np

from mapfusion.arguments import require_shape
from mapfusion.se2 import Float, rotation

_UPPER_3, _UPPER_2 = np.triu_indices(3), np.triu_indices(2)


class G2oGraph:
    """Vertices, numbered from 0 as they are added, and edges between them, as lines of text."""

    def __init__(self) -> None:
        self._vertices: list[str] = []
        self._edges: list[str] = []
        self._n = 0

    def add_comment(self, text: str) -> None:
        """A line above the vertices that follow, which readers pass over."""
        self._vertices.append(f"# {text}")

    def add_poses(self, T: Float) -> np.ndarray:
        """Poses (n, 3) in the frame of the graph; returns their numbers (n,)."""
        require_shape("T", T, (len(T), 3))
        return self._add("VERTEX_SE2", T)

    def add_points(self, p: Float) -> np.ndarray:
        """Landmarks (n, 2) in the frame of the graph; returns their numbers (n,)."""
        require_shape("p", p, (len(p), 2))
        return self._add("VERTEX_XY", p)

    def _add(self, kind: str, values: Float) -> np.ndarray:
        numbers = np.arange(self._n, self._n + len(values))
        self._n += len(values)
        rows = zip(numbers.tolist(), values.tolist(), strict=True)
        self._vertices += [f"{kind} {number} {_text(row)}" for number, row in rows]
        return numbers

    def add_motion(self, i: int, j: int, T_i_j: Float, covariance: Float) -> None:
        """A measured motion (3,) between poses i and j; covariance (3, 3) of x, y, theta in i."""
        turn = np.eye(3)
        turn[:2, :2] = rotation(T_i_j[2]).T
        information = turn @ np.linalg.inv(covariance) @ turn.T
        numbers = [*T_i_j.tolist(), *information[_UPPER_3].tolist()]
        self._edges.append(f"EDGE_SE2 {i} {j} {_text(numbers)}")

    def add_sighting(self, i: int, point: int, p_i: Float, covariance: Float) -> None:
        """A landmark (2,) as seen from pose i, with its covariance (2, 2) in the frame of i."""
        information = np.linalg.inv(covariance)
        numbers = [*p_i.tolist(), *information[_UPPER_2].tolist()]
        self._edges.append(f"EDGE_SE2_XY {i} {point} {_text(numbers)}")

    def text(self) -> str:
        """The file: vertices, then edges. Every number is read back exactly."""
        return "\n".join([*self._vertices, *self._edges, ""])


def _text(numbers: list[float]) -> str:
    return " ".join(map(str, numbers))
