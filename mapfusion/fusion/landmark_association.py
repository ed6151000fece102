"""Landmarks of several maps in a common frame, and their association."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from mapfusion.align.correspondences import HeightGate
from mapfusion.descriptors import USURF, DescriptorKind, merged_kind, relative_distance
from mapfusion.geometry.numerics import Float, chi_square_bound, with_rows
from mapfusion.geometry.se2 import motion_jacobian, transform_covariances, transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.tables import NO_LABEL

ABSENT = -1


# Fuses pairs of landmarks: positions (N, D) and covariances (N, D, D) of both landmarks.
FusePairs = Callable[[Float, Float, Float, Float], tuple[Float, Float]]


@dataclass(frozen=True)
class AlignedLandmarks:
    """N landmarks in the frame of the fused map.

    Attributes:
        position_m: positions, shape (N, 3).
        covariance_m2: covariances, shape (N, 3, 3).
        drift_m2: variance per axis of the map drift that is not part of `covariance_m2`, shape
            (N,).
        count: numbers of observations, shape (N,).
        descriptor: vectors of the descriptors, shape (N, D); NaN if absent.
        label: labels, shape (N,); NO_LABEL if absent.
        parents: row of the landmark in each map, shape (N, M); ABSENT if the map lacks the
            landmark.
        kind: kind of the descriptors; None without any.
    """

    position_m: Float
    covariance_m2: Float
    drift_m2: Float
    count: np.ndarray
    descriptor: np.ndarray
    label: np.ndarray
    parents: np.ndarray
    kind: DescriptorKind | None = None

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
        """Transform map k of `maps` into the fused frame.

        Args:
            maps: all maps.
            k: index of the map.
            T_first_map: pose of the map in the fused frame, shape (3,).
            covariance_T: covariance of this pose, shape (3, 3), which is added to the landmark
                covariances; None: not added.
            drift_sigma_m: standard deviation of the map's drift per axis.
            use_drift: true if the drift is added to the landmark covariances.
        """
        source = maps[k]
        n = len(source)
        covariance = transform_covariances(T_first_map, source.covariance_m2)
        if covariance_T is not None:
            jacobian = motion_jacobian(T_first_map, source.position_m)
            covariance[:, :2, :2] += jacobian @ covariance_T @ np.swapaxes(jacobian, 1, 2)
        drift_m2 = np.full(n, drift_sigma_m**2)
        if use_drift:  # drift affects x and y only
            covariance[:, [0, 1], [0, 1]] += drift_m2[:, None]
            drift_m2 = np.zeros(n)
        parents = np.full((n, len(maps)), ABSENT, dtype=np.int64)
        parents[:, k] = np.arange(n)
        kind = merged_kind(*(each.descriptor_kind for each in maps))
        descriptor = np.full((n, USURF.length if kind is None else kind.length), np.nan, np.float32)
        if source.descriptor is not None:
            descriptor[:] = source.descriptor
        label = np.full(n, NO_LABEL, np.int32)
        if source.label is not None:
            label[:] = source.label
        position = transform_points(T_first_map, source.position_m)
        return cls(position, covariance, drift_m2, source.count, descriptor, label, parents, kind)

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
        """Fuse landmarks with those of another map and append the remaining ones.

        Args:
            other: landmarks of the other map.
            rows: rows of these landmarks that have a partner, shape (n,).
            others: rows of the partners in `other`, shape (n,).
            dimensions: 2 or 3, number of coordinates that are fused.
            fuse_pairs: function that fuses two landmarks.
        """
        a, b = self[rows], other[others]
        b_observed_more = b.count > a.count
        position, covariance = a.position_m.copy(), a.covariance_m2.copy()
        position[:, :dimensions], covariance[:, :dimensions, :dimensions] = fuse_pairs(
            a.position_m[:, :dimensions],
            a.covariance_m2[:, :dimensions, :dimensions],
            b.position_m[:, :dimensions],
            b.covariance_m2[:, :dimensions, :dimensions],
        )
        fused = AlignedLandmarks(
            position,
            covariance,
            np.minimum(a.drift_m2, b.drift_m2),
            a.count + b.count,
            np.where(b_observed_more[:, None] | np.isnan(a.descriptor), b.descriptor, a.descriptor),
            np.where(a.label == NO_LABEL, b.label, a.label),
            np.maximum(a.parents, b.parents),
            self.kind,
        )
        unmatched = other[np.setdiff1d(np.arange(len(other)), others)]
        columns = dict[str, Any]()
        for name, values in vars(self).items():
            if isinstance(values, np.ndarray):
                joined = values.copy()
                joined[rows] = getattr(fused, name)
                columns[name] = np.concatenate([joined, getattr(unmatched, name)])
        return AlignedLandmarks(**columns, kind=self.kind)

    def landmark_map(self, planar: bool, name: str) -> LandmarkMap:
        """Return the landmarks as a map without source observations."""
        return LandmarkMap(
            self.position_m,
            self.covariance_m2,
            self.count,
            np.full(len(self), ABSENT, dtype=np.int64),
            None if np.isnan(self.descriptor).all() else self.descriptor,
            None if np.all(self.label == NO_LABEL) else self.label,
            planar,
            name,
            descriptor_kind=self.kind,
        )


@dataclass(frozen=True)
class AssociationTest:
    """Test if two landmarks in a common frame can be the same point.

    Attributes:
        max_descriptor_distance: largest descriptor distance; not used if both landmarks have
            labels.
        gate_probability: probability that landmarks of the same point pass the gate (chi-square, 2
            degrees of freedom, drift included); not used for labels.
        height: test of the heights.
        planar: true if heights carry no information.
    """

    max_descriptor_distance: float
    gate_probability: float
    height: HeightGate
    planar: bool

    def candidates(
        self, a: AlignedLandmarks, b: AlignedLandmarks
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows of a and b that pass the test, and their descriptor distances.

        Landmarks with equal labels pass without a gate, and their distance is 0: in distorted maps
        they may be far apart, and a duplicate would remain.
        """
        labelled_a = np.flatnonzero(a.label != NO_LABEL)
        labelled_b = np.flatnonzero(b.label != NO_LABEL)
        same_a, same_b = np.nonzero(a.label[labelled_a][:, None] == b.label[labelled_b])
        i, j = self._gated(a, b)
        both_labelled = (a.label[i] != NO_LABEL) & (b.label[j] != NO_LABEL)
        apart = np.linalg.norm(a.descriptor[i] - b.descriptor[j], axis=1)
        distance = relative_distance(apart, a.kind, b.kind)
        passes = ~both_labelled & (distance <= self.max_descriptor_distance)  # False for NaN
        return (
            np.concatenate([labelled_a[same_a], i[passes]]),
            np.concatenate([labelled_b[same_b], j[passes]]),
            np.concatenate([np.zeros(len(same_a)), distance[passes]]),
        )

    def duplicate_share(self, landmarks: AlignedLandmarks) -> float:
        """Return the share of landmarks that pass the test with another landmark."""
        first, second, _ = self.candidates(landmarks, landmarks)
        return len(np.unique(first[first != second])) / max(len(landmarks), 1)

    def _gated(self, a: AlignedLandmarks, b: AlignedLandmarks) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of all pairs within the gate of positions and heights."""
        if not len(a) or not len(b):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        bound = chi_square_bound(self.gate_probability, 2)
        # a search radius that contains the gate of every pair
        variance_a, variance_b = (
            np.trace(x.covariance_m2[:, :2, :2], axis1=1, axis2=2) + x.drift_m2 for x in (a, b)
        )
        radius = np.sqrt(bound * (variance_a + variance_b.max()))
        tree = scipy.spatial.KDTree(b.position_m[:, :2])
        neighbours = tree.query_ball_point(a.position_m[:, :2], radius, return_sorted=True)
        lengths = [len(rows) for rows in neighbours]
        i = np.repeat(np.arange(len(a)), lengths)
        j = np.fromiter(itertools.chain.from_iterable(neighbours), np.int64, sum(lengths))

        drift_m2 = a.drift_m2[i] + b.drift_m2[j]
        (x_a, y_a), (x_b, y_b) = a.position_m[:, :2].T, b.position_m[:, :2].T
        x, y = x_a[i] - x_b[j], y_a[i] - y_b[j]
        xx, xy, yy = (
            a.covariance_m2[:, r, q][i] + b.covariance_m2[:, r, q][j]
            for r, q in ((0, 0), (0, 1), (1, 1))
        )
        xx, yy = xx + drift_m2, yy + drift_m2
        # (x, y) S^-1 (x, y)' <= bound, both sides multiplied by the determinant of S
        inside = yy * x**2 - 2 * xy * x * y + xx * y**2 <= bound * (xx * yy - xy**2)
        if not self.planar:
            inside &= self.height.agrees(
                a.position_m[i, 2],
                a.covariance_m2[i, 2, 2],
                b.position_m[j, 2],
                b.covariance_m2[j, 2, 2],
            )
        return i[inside], j[inside]


def one_to_one(
    i: np.ndarray, j: np.ndarray, dissimilarity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Select pairs in the order of their dissimilarity so that each landmark occurs once."""
    taken_i: set[int] = set()
    taken_j: set[int] = set()
    matches = []
    rows = np.argsort(dissimilarity, kind="stable")
    for row, at_i, at_j in zip(rows, i[rows].tolist(), j[rows].tolist(), strict=True):
        if at_i not in taken_i and at_j not in taken_j:
            taken_i.add(at_i)
            taken_j.add(at_j)
            matches.append(row)
    return i[matches], j[matches]


class CandidatePairs(NamedTuple):
    """Pairs of landmarks of two maps that may be the same point.

    Attributes:
        a: index of the first map.
        b: index of the second map.
        row_a: landmarks of the first map, shape (n,).
        row_b: landmarks of the second map, shape (n,).
        dissimilarity: descriptor distances, shape (n,); 0 for equal labels.
    """

    a: int
    b: int
    row_a: np.ndarray
    row_b: np.ndarray
    dissimilarity: np.ndarray


def cluster_landmarks(pairs: list[CandidatePairs], sizes: list[int]) -> np.ndarray:
    """Cluster landmarks of M maps so that a cluster has at most one landmark of each map.

    Single-linkage clustering in the order of the dissimilarity. A pair is skipped if the merged
    cluster would have two landmarks of one map. The order of maps and pairs changes only the order
    of the clusters.

    Args:
        pairs: candidate pairs.
        sizes: number of landmarks of each map.

    Returns:
        row of each cluster in each map, shape (C, M), ABSENT for none; single landmarks are last.
    """
    first = np.concatenate([[0], np.cumsum(sizes)])
    of_map = np.repeat(np.arange(len(sizes)), sizes)
    members = {int(i): {int(of_map[i]): int(i)} for i in range(first[-1])}
    root = np.arange(first[-1])
    empty = [np.empty(0, np.int64)]
    first_landmark = np.concatenate([first[pair.a] + pair.row_a for pair in pairs] or empty)
    other = np.concatenate([first[pair.b] + pair.row_b for pair in pairs] or empty)
    dissimilarity = np.concatenate([pair.dissimilarity for pair in pairs] or empty)
    for row in np.argsort(dissimilarity, kind="stable"):
        i, j = int(root[first_landmark[row]]), int(root[other[row]])
        if i == j or members[i].keys() & members[j].keys():
            continue
        root[list(members[j].values())] = i
        members[i] |= members.pop(j)
    points = np.full((len(members), len(sizes)), ABSENT)
    for row, cluster in enumerate(members.values()):
        for k, i in cluster.items():
            points[row, k] = i - first[k]
    several = np.count_nonzero(points != ABSENT, axis=1) > 1
    return np.concatenate([points[several], points[~several]])
