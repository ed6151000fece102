"""Which landmarks in one frame may be the same point of the world."""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from mapfusion.align.correspondences import HeightGate
from mapfusion.aligned_landmarks import AlignedLandmarks
from mapfusion.chi_square import chi_square_bound
from mapfusion.looks import NO_LABEL


@dataclass(frozen=True)
class SamePoint:
    """The test by which two landmarks in one frame can be one point of the world.

    Attributes:
        max_descriptor_distance: where not both carry labels; these decide by themselves.
        gate_probability: of keeping landmarks of one point (chi-square, 2 degrees of freedom,
            drift included); not for labels.
        height: which landmarks can have one height.
        planar: heights carry no information.
    """

    max_descriptor_distance: float
    gate_probability: float
    height: HeightGate
    planar: bool

    def candidates(
        self, a: AlignedLandmarks, b: AlignedLandmarks
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of a and of b that pass, and their descriptors' distance (0 by label).

        A known identity needs no gate: where the maps are distorted, two landmarks of one label
        stay one point, and leaving them apart would leave a duplicate for certain.
        """
        known_i, known_j = _of_one_label(a.label, b.label)
        i, j = self._neighbours(a, b)
        inside = self._inside(a, b, i, j)
        i, j = i[inside], j[inside]
        labelled = (a.label[i] != NO_LABEL) & (b.label[j] != NO_LABEL)
        unlike = np.linalg.norm(a.descriptor[i] - b.descriptor[j], axis=1)
        passes = ~labelled & (unlike <= self.max_descriptor_distance)  # False for NaN
        return (
            np.concatenate([known_i, i[passes]]),
            np.concatenate([known_j, j[passes]]),
            np.concatenate([np.zeros(len(known_i)), unlike[passes]]),
        )

    def duplicate_share(self, landmarks: AlignedLandmarks) -> float:
        """Share of the landmarks that another one still passes for."""
        first, second, _ = self.candidates(landmarks, landmarks)
        return len(np.unique(first[first != second])) / max(len(landmarks), 1)

    def _bound(self) -> float:
        return chi_square_bound(self.gate_probability, 2)

    def _neighbours(
        self, a: AlignedLandmarks, b: AlignedLandmarks
    ) -> tuple[np.ndarray, np.ndarray]:
        """All pairs that the gate could hold, and some more."""
        if not len(a) or not len(b):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        widest_a, widest_b = (
            np.trace(x.covariance_m2[:, :2, :2], axis1=1, axis2=2) + x.drift_m2 for x in (a, b)
        )
        radius = np.sqrt(self._bound() * (widest_a + widest_b.max()))
        tree, places = KDTree(b.position_m[:, :2]), a.position_m[:, :2]
        found = tree.query_ball_point(places, radius, return_sorted=True)
        lengths = [len(rows) for rows in found]
        rows = np.fromiter(itertools.chain.from_iterable(found), np.int64, sum(lengths))
        return np.repeat(np.arange(len(a)), lengths), rows

    def _inside(
        self, a: AlignedLandmarks, b: AlignedLandmarks, i: np.ndarray, j: np.ndarray
    ) -> np.ndarray:
        drift_m2 = a.drift_m2[i] + b.drift_m2[j]
        (x_a, y_a), (x_b, y_b) = a.position_m[:, :2].T, b.position_m[:, :2].T
        x, y = x_a[i] - x_b[j], y_a[i] - y_b[j]
        xx, xy, yy = (
            a.covariance_m2[:, r, q][i] + b.covariance_m2[:, r, q][j]
            for r, q in ((0, 0), (0, 1), (1, 1))
        )
        xx, yy = xx + drift_m2, yy + drift_m2
        # (x, y) S^-1 (x, y)' by the inverse of two by two, both sides times the determinant
        inside = yy * x**2 - 2 * xy * x * y + xx * y**2 <= self._bound() * (xx * yy - xy**2)
        if self.planar:
            return inside
        return inside & self.height.agrees(
            a.position_m[i, 2],
            a.covariance_m2[i, 2, 2],
            b.position_m[j, 2],
            b.covariance_m2[j, 2, 2],
        )


def _of_one_label(label_a: np.ndarray, label_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of rows that carry the same label."""
    rows_a, rows_b = np.flatnonzero(label_a != NO_LABEL), np.flatnonzero(label_b != NO_LABEL)
    i, j = np.nonzero(label_a[rows_a][:, None] == label_b[rows_b])
    return rows_a[i], rows_b[j]


def one_to_one(i: np.ndarray, j: np.ndarray, unlike: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The most alike first, each landmark once."""
    taken_i: set[int] = set()
    taken_j: set[int] = set()
    kept = []
    rows = np.argsort(unlike, kind="stable")
    for row, at_i, at_j in zip(rows, i[rows].tolist(), j[rows].tolist(), strict=True):
        if at_i not in taken_i and at_j not in taken_j:
            taken_i.add(at_i)
            taken_j.add(at_j)
            kept.append(row)
    return i[kept], j[kept]
