"""Landmarks of several maps in one frame, and which of them are the same point."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from mapfusion.align.correspondences import HeightGate
from mapfusion.align.rigid_motion import motion_jacobian
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import transform_covariances, transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import with_rows
from mapfusion.tables import DESCRIPTOR_LENGTH, NO_LABEL

ABSENT = -1


# Two landmarks made one: positions (N, D) and covariances (N, D, D) of the one and of the other.
FusePairs = Callable[[Float, Float, Float, Float], tuple[Float, Float]]


@dataclass(frozen=True)
class AlignedLandmarks:
    """N landmarks in the frame of the fused map.

    Attributes:
        position_m: (N, 3).
        covariance_m2: (N, 3, 3).
        drift_m2: (N,) variance per axis of the drift that covariance_m2 leaves out.
        count: (N,) observations.
        descriptor: (N, 64), NaN where absent.
        label: (N,), NO_LABEL where absent.
        parents: (N, M) row of each map, ABSENT where it has no part.
    """

    position_m: Float
    covariance_m2: Float
    drift_m2: Float
    count: np.ndarray
    descriptor: np.ndarray
    label: np.ndarray
    parents: np.ndarray

    @classmethod
    def of(
        cls,
        maps: Sequence[LandmarkMap],
        k: int,
        T_first_map: Float,
        covariance_T: Float | None,
        drift_sigma_m: float,
        use_drift: bool,
    ) -> "AlignedLandmarks":
        """Map k of `maps` in the fused frame.

        The covariance of the motion (3, 3) is added to the landmarks' unless it is None, the map's
        share in s_drift if `use_drift` is set.
        """
        source = maps[k]
        n = len(source)
        covariance = transform_covariances(T_first_map, source.covariance_m2)
        if covariance_T is not None:
            jacobian = motion_jacobian(T_first_map, source.position_m)
            covariance[:, :2, :2] += jacobian @ covariance_T @ np.swapaxes(jacobian, 1, 2)
        drift_m2 = np.full(n, drift_sigma_m**2)
        if use_drift:  # heights do not drift
            covariance[:, [0, 1], [0, 1]] += drift_m2[:, None]
            drift_m2 = np.zeros(n)
        parents = np.full((n, len(maps)), ABSENT, dtype=np.int64)
        parents[:, k] = np.arange(n)
        descriptor = np.full((n, DESCRIPTOR_LENGTH), np.nan, np.float32)
        if source.descriptor is not None:
            descriptor[:] = source.descriptor
        label = np.full(n, NO_LABEL, np.int32)
        if source.label is not None:
            label[:] = source.label
        position = transform_points(T_first_map, source.position_m)
        return cls(position, covariance, drift_m2, source.count, descriptor, label, parents)

    def __len__(self) -> int:
        return len(self.position_m)

    def __getitem__(self, rows: np.ndarray) -> "AlignedLandmarks":
        return with_rows(self, rows)

    def fuse_with(
        self,
        other: "AlignedLandmarks",
        rows: np.ndarray,
        others: np.ndarray,
        dimensions: int,
        fuse_pairs: FusePairs,
    ) -> "AlignedLandmarks":
        """These, with `rows` fused with the other's `others`, and the other's rest at the end."""
        a, b = self[rows], other[others]
        seen_more = b.count > a.count
        position, covariance = a.position_m.copy(), a.covariance_m2.copy()
        position[:, :dimensions], covariance[:, :dimensions, :dimensions] = fuse_pairs(
            a.position_m[:, :dimensions],
            a.covariance_m2[:, :dimensions, :dimensions],
            b.position_m[:, :dimensions],
            b.covariance_m2[:, :dimensions, :dimensions],
        )
        new = AlignedLandmarks(
            position,
            covariance,
            np.minimum(a.drift_m2, b.drift_m2),
            a.count + b.count,
            np.where(seen_more[:, None] | np.isnan(a.descriptor), b.descriptor, a.descriptor),
            np.where(a.label == NO_LABEL, b.label, a.label),
            np.maximum(a.parents, b.parents),
        )
        rest = other[np.setdiff1d(np.arange(len(other)), others)]
        columns = []
        for name in AlignedLandmarks.__dataclass_fields__:
            values = getattr(self, name).copy()
            values[rows] = getattr(new, name)
            columns.append(np.concatenate([values, getattr(rest, name)]))
        return AlignedLandmarks(*columns)

    def landmark_map(self, planar: bool, name: str) -> LandmarkMap:
        """The same as a map; its landmarks come from no single observation."""
        return LandmarkMap(
            self.position_m,
            self.covariance_m2,
            self.count,
            np.full(len(self), ABSENT, dtype=np.int64),
            None if np.isnan(self.descriptor).all() else self.descriptor,
            None if np.all(self.label == NO_LABEL) else self.label,
            planar,
            name,
        )


@dataclass(frozen=True)
class AssociationTest:
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
        dissimilarity = np.linalg.norm(a.descriptor[i] - b.descriptor[j], axis=1)
        passes = ~labelled & (dissimilarity <= self.max_descriptor_distance)  # False for NaN
        return (
            np.concatenate([known_i, i[passes]]),
            np.concatenate([known_j, j[passes]]),
            np.concatenate([np.zeros(len(known_i)), dissimilarity[passes]]),
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


def one_to_one(
    i: np.ndarray, j: np.ndarray, dissimilarity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The most alike first, each landmark once."""
    taken_i: set[int] = set()
    taken_j: set[int] = set()
    kept = []
    rows = np.argsort(dissimilarity, kind="stable")
    for row, at_i, at_j in zip(rows, i[rows].tolist(), j[rows].tolist(), strict=True):
        if at_i not in taken_i and at_j not in taken_j:
            taken_i.add(at_i)
            taken_j.add(at_j)
            kept.append(row)
    return i[kept], j[kept]


class CandidatePairs(NamedTuple):
    """Landmarks of two maps that may be one point: n of them.

    Attributes:
        a: place of the one map.
        b: place of the other.
        row_a: (n,) landmarks of the one.
        row_b: (n,) landmarks of the other.
        dissimilarity: (n,) how little they look alike.
    """

    a: int
    b: int
    row_a: np.ndarray
    row_b: np.ndarray
    dissimilarity: np.ndarray


def cluster_landmarks(pairs: list[CandidatePairs], sizes: list[int]) -> np.ndarray:
    """Points (C, M): the row of each of M maps, ABSENT for none; those of one map come last.

    What is most alike is joined first, unless the point would then have two landmarks of one map.
    The order of maps and of pairs makes no difference but for the order of the points.

    Args:
        pairs: what may be one.
        sizes: landmarks of each map.
    """
    first = np.concatenate([[0], np.cumsum(sizes)])
    of_map = np.repeat(np.arange(len(sizes)), sizes)
    members = {int(i): {int(of_map[i]): int(i)} for i in range(first[-1])}
    root = np.arange(first[-1])
    nothing = [np.empty(0, np.int64)]
    one = np.concatenate([first[pair.a] + pair.row_a for pair in pairs] or nothing)
    other = np.concatenate([first[pair.b] + pair.row_b for pair in pairs] or nothing)
    dissimilarity = np.concatenate([pair.dissimilarity for pair in pairs] or nothing)
    for row in np.argsort(dissimilarity, kind="stable"):
        i, j = int(root[one[row]]), int(root[other[row]])
        if i == j or members[i].keys() & members[j].keys():
            continue
        root[list(members[j].values())] = i
        members[i] |= members.pop(j)
    points = np.full((len(members), len(sizes)), ABSENT)
    for row, own in enumerate(members.values()):
        for k, i in own.items():
            points[row, k] = i - first[k]
    several = np.count_nonzero(points != ABSENT, axis=1) > 1
    return np.concatenate([points[several], points[~several]])
