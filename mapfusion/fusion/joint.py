"""Joint fusion: motions, shared errors and landmarks of all maps in one estimate.

Where maps carry joint covariances, landmarks that meet straighten their maps as a whole, so that
also those move that one robot alone has seen. Maps without one are fused by what they have.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from mapfusion.align.alignment import MIN_PAIRS
from mapfusion.fusion.aligned_landmarks import (
    ABSENT,
    AlignedLandmarks,
    CandidatePairs,
    cluster_landmarks,
)
from mapfusion.fusion.fused_map import Component, FusedMap, MergeParameters
from mapfusion.fusion.joint_estimate import (
    JointEstimate,
    JointMap,
    estimate_jointly,
    weighted_information,
)
from mapfusion.fusion.kalman import KalmanDrift
from mapfusion.geometry.joint_covariance import JointCovariance, condensed
from mapfusion.geometry.numerics import Float, inverses, one_blas_thread
from mapfusion.geometry.se2 import IDENTITY
from mapfusion.landmark_map import LandmarkMap
from mapfusion.smoother.robust_loss import student_bound
from mapfusion.tables import DESCRIPTOR_LENGTH, NO_LABEL

_SOURCE_UNKNOWN = -1  # a fused landmark comes from no single observation


@dataclass(frozen=True)
class JointlyFused:
    """K members of a component, estimated.

    Attributes:
        component: what was fused.
        maps: of the members.
        points: (C, K) rows of the members that are one point, ABSENT for none; those of several
            maps first.
        estimate: of these.
    """

    component: Component
    maps: Sequence[JointMap]
    points: np.ndarray
    estimate: JointEstimate

    def fused_map(self, parameters: MergeParameters) -> FusedMap:
        """As fusers return it."""
        members, n_maps = self.component.members, len(self.component.maps)
        T, covariance = np.full((n_maps, 3), np.nan), np.full((n_maps, 3, 3), np.nan)
        T[members] = self.estimate.T_first_map
        covariance[members] = self.estimate.motion_covariance
        parents = np.full((len(self.points), n_maps), ABSENT)
        parents[:, members] = self.points
        landmarks, joint = self._landmarks()
        # what all landmarks share moves duplicates together and does not keep them apart
        alone = replace(landmarks, covariance_m2=joint.own_m2, joint=None)
        still = AlignedLandmarks.of([alone], 0, IDENTITY, None, 0.0, use_drift=False)
        drift = np.full(n_maps, np.nan)
        drift[members] = 0.0
        return FusedMap(
            landmarks,
            parents,
            T,
            covariance,
            drift,
            parameters.association_test(self.component.planar).duplicate_share(still),
            self.component.left_out,
        )

    def _landmarks(self) -> tuple[LandmarkMap, JointCovariance]:
        position, joint = self._points()
        given = [self.component.maps[k] for k in self.component.members]
        n, has = len(self.points), self.points != ABSENT
        count, most = np.zeros(n, np.int64), np.zeros(n, np.int64)
        descriptor = np.full((n, DESCRIPTOR_LENGTH), np.nan, np.float32)
        label = np.full(n, NO_LABEL, np.int32)
        for k, own in enumerate(given):
            rows, its = np.flatnonzero(has[:, k]), self.points[has[:, k], k]
            count[rows] += own.count[its]
            if own.descriptor is not None:  # of the landmark that was seen most
                more = own.count[its] > most[rows]
                descriptor[rows[more]] = own.descriptor[its[more]]
                most[rows[more]] = own.count[its[more]]
            if own.label is not None:
                label[rows] = np.where(label[rows] == NO_LABEL, own.label[its], label[rows])
        made = LandmarkMap(
            position,
            joint.marginal_m2,
            count.astype(np.int32),
            np.full(n, _SOURCE_UNKNOWN, dtype=np.int64),
            None if np.isnan(descriptor).all() else descriptor,
            None if np.all(label == NO_LABEL) else label,
            self.component.planar,
            given[0].name,
            joint,
        )
        return made, joint

    def _points(self) -> tuple[Float, JointCovariance]:
        """Points g (C, 3) and what their errors have in common: dg/du of the unknowns' errors."""
        n, has, estimate = len(self.points), self.points != ABSENT, self.estimate
        n_dimensions, n_unknowns = self.maps[0].position_m.shape[1], len(estimate.covariance)
        weight = has.astype(np.float64)
        weight[: len(estimate.weight)] = estimate.weight
        factor = np.asarray(np.linalg.cholesky(estimate.covariance), np.float64)
        rows = [np.flatnonzero(has[:, k]) for k in range(len(self.maps))]
        transformed = [
            estimate.transformed(self.maps, k, self.points[own, k]) for k, own in enumerate(rows)
        ]
        W = [
            weighted_information(each, weight[own, k])
            for k, (own, each) in enumerate(zip(rows, transformed, strict=True))
        ]
        information = np.zeros((n, n_dimensions, n_dimensions))
        for own, its in zip(rows, W, strict=True):
            information[own] += its
        V = inverses(information)
        total, moved = np.zeros((n, n_dimensions)), np.zeros((n, n_dimensions, n_unknowns))
        for k, (own, each, its) in enumerate(zip(rows, transformed, W, strict=True)):
            gain = V[own] @ its
            total[own] += np.einsum("nij,nj->ni", gain, each.y_m)
            moved[own] += gain @ estimate.moved_m(self.maps, k, each, factor)
        covariance, position = np.zeros((n, 3, 3)), np.zeros((n, 3))
        covariance[:, :n_dimensions, :n_dimensions] = V
        position[:, :n_dimensions] = total
        shared = np.zeros((n_unknowns, n, 3))
        shared[:, :, :n_dimensions] = moved.transpose(2, 0, 1)
        return position, condensed(covariance, shared.reshape(n_unknowns, 3 * n))


# What is one point is judged anew with each estimate, until nothing changes or for so many rounds.
_MOST_ROUNDS = 5
# Of landmarks' variances that are looked for with one radius: fewer take more searches, more find
# more that is out of reach.
_OCTAVES = 3
# Heavier tails have no variance: they are of false pairs, not of landmarks.
_LEAST_DOF = 2.0


class JointFuser:
    """All maps at once; the first member's frame is the frame.

    Where landmarks do not tie the maps to each other, or covariances are of sizes too different to
    be computed with, Kalman fusion with drift stands in.
    """

    smoothed = True

    @one_blas_thread
    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        try:
            made = self._fused(component, parameters)
        except np.linalg.LinAlgError:
            made = "the maps' covariances are of sizes too different to be computed with together"
        if isinstance(made, str):
            return replace(KalmanDrift().fuse(component, parameters), fallback=made)
        return made

    @staticmethod
    def _fused(component: Component, parameters: MergeParameters) -> FusedMap | str:
        """The fused map, or why it cannot be made so."""
        n_dimensions = 2 if component.planar else 3
        drift = component.drift_sigma_m
        given = [component.maps[k] for k in component.members]
        maps = [
            JointMap.of(landmarks, float(drift[k]), n_dimensions)
            for landmarks, k in zip(given, component.members, strict=True)
        ]
        sizes, inliers = [len(landmarks) for landmarks in given], _inliers(component)
        points = cluster_landmarks(inliers, sizes)
        if not _tied(points):
            return f"fewer than {MIN_PAIRS} landmarks tie some map to the others"
        estimate = _estimated(maps, component.T_first_map[component.members], points)
        for _ in range(_MOST_ROUNDS):
            pairs = _candidates(given, _placed(maps, estimate), inliers, parameters, estimate.dof)
            now = cluster_landmarks(pairs, sizes)
            if np.array_equal(points, now) or not _tied(now):
                break
            points, estimate = now, _estimated(maps, estimate.T_first_map, now)
        return JointlyFused(component, maps, points, estimate).fused_map(parameters)


def _tied(points: np.ndarray) -> bool:
    """Whether each map's motion is determined by points (C, K) that it has in common with others.

    Maps hang together by pairs of maps with enough points in common.
    """
    has = (points != ABSENT).astype(np.int64)
    n_components, _ = connected_components(csr_matrix(has.T @ has >= MIN_PAIRS), directed=False)
    return n_components == 1


def _estimated(maps: Sequence[JointMap], T_first_map: Float, points: np.ndarray) -> JointEstimate:
    """From the points of several maps: those of one map alone say nothing."""
    several = np.count_nonzero(points != ABSENT, axis=1) > 1
    return estimate_jointly(maps, T_first_map, points[several])


def _inliers(component: Component) -> list[CandidatePairs]:
    """What alignments say is one; places are among the members, the lesser first."""
    place = {int(k): row for row, k in enumerate(component.members)}
    found = []
    for p in component.pairs:
        sides = [(place[p.a], p.inliers.index_a), (place[p.b], p.inliers.index_b)]
        (a, row_a), (b, row_b) = sorted(sides, key=lambda side: side[0])
        found.append(CandidatePairs(a, b, row_a, row_b, p.inliers.distance))
    return found


@dataclass(frozen=True)
class _Placed:
    """A map's n landmarks in the common frame.

    Attributes:
        position_m: (n, D).
        own_m2: (n, D, D) covariance of what is each landmark's own.
        shared_m: (n, D, U) how far one sigma of U independent shared variables moves it.
    """

    position_m: Float
    own_m2: Float
    shared_m: Float

    @cached_property
    def widest_m2(self) -> Float:
        """(n,) two landmarks' together are no less than any variance of their difference."""
        own, shared = np.trace(self.own_m2, axis1=1, axis2=2), self.shared_m
        return own + 2 * np.einsum("nij,nij->n", shared, shared)


def _placed(maps: Sequence[JointMap], estimate: JointEstimate) -> list[_Placed]:
    factor = np.asarray(np.linalg.cholesky(estimate.covariance), np.float64)
    transformed = [estimate.transformed(maps, k, np.arange(len(own))) for k, own in enumerate(maps)]
    shared = [estimate.moved_m(maps, k, own, factor) for k, own in enumerate(transformed)]
    return [
        _Placed(own.y_m, own.own_m2, moved) for own, moved in zip(transformed, shared, strict=True)
    ]


def _candidates(
    given: Sequence[LandmarkMap],
    placed: Sequence[_Placed],
    inliers: Sequence[CandidatePairs],
    parameters: MergeParameters,
    dof: float,
) -> list[CandidatePairs]:
    """Landmarks of every two maps that may be one point.

    Those of one label need nothing else and are not unlike at all. All others have to pass the
    gate, and their descriptors have to be alike; without descriptors, an alignment has to have
    named them. The gate is that of the Student-t with `dof` degrees of freedom which the points
    agreed on so far follow: a Gaussian's would cut its tails off, and then none would be seen.
    """
    dof = max(dof, _LEAST_DOF)
    bound = student_bound(parameters.gate_probability, dof, placed[0].position_m.shape[1])
    found = []
    for a, b in combinations(range(len(given)), 2):
        i, j, dissimilarity = _alike(given[a], given[b], *_near(placed[a], placed[b], bound))
        near = dissimilarity <= parameters.max_descriptor_distance
        i, j, dissimilarity = i[near], j[near], dissimilarity[near]
        if given[a].descriptor is None or given[b].descriptor is None:
            i, j, dissimilarity = _named(inliers, a, b)
        kept = _inside(placed[a], placed[b], i, j, bound)
        known_i, known_j = _of_one_label(given[a], given[b])
        i, j = np.concatenate([known_i, i[kept]]), np.concatenate([known_j, j[kept]])
        found.append(
            CandidatePairs(
                a, b, i, j, np.concatenate([np.zeros(len(known_i)), dissimilarity[kept]])
            )
        )
    return found


def _named(
    inliers: Sequence[CandidatePairs], a: int, b: int
) -> tuple[np.ndarray, np.ndarray, Float]:
    named = [pair for pair in inliers if (pair.a, pair.b) == (a, b)]
    rows = [(pair.row_a, pair.row_b) for pair in named]
    i, j = np.concatenate([np.empty((2, 0), np.int64), *map(np.stack, rows)], axis=1)
    return i, j, np.concatenate([np.empty(0), *(pair.dissimilarity for pair in named)])


def _inside(a: _Placed, b: _Placed, i: np.ndarray, j: np.ndarray, bound: float) -> np.ndarray:
    """Which differences (n,) can be zero: what both share cancels."""
    shared = a.shared_m[i] - b.shared_m[j]
    S = a.own_m2[i] + b.own_m2[j] + shared @ np.swapaxes(shared, 1, 2)
    off = a.position_m[i] - b.position_m[j]
    return np.einsum("ni,nij,nj->n", off, inverses(S), off) <= bound


def _of_one_label(a: LandmarkMap, b: LandmarkMap) -> tuple[np.ndarray, np.ndarray]:
    named_a, named_b = (np.flatnonzero(_labels(own) != NO_LABEL) for own in (a, b))
    i, j = np.nonzero(_labels(a)[named_a][:, None] == _labels(b)[named_b])
    return named_a[i], named_b[j]


def _labels(landmarks: LandmarkMap) -> np.ndarray:
    return np.full(len(landmarks), NO_LABEL) if landmarks.label is None else landmarks.label


def _alike(
    a: LandmarkMap, b: LandmarkMap, i: np.ndarray, j: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Float]:
    """The pairs of rows that not both carry labels, with the distance of their descriptors."""
    if a.descriptor is None or b.descriptor is None:
        return i[:0], j[:0], np.empty(0)
    unnamed = (_labels(a)[i] == NO_LABEL) | (_labels(b)[j] == NO_LABEL)
    i, j = i[unnamed], j[unnamed]
    return i, j, np.linalg.norm(a.descriptor[i] - b.descriptor[j], axis=1).astype(np.float64)


def _near(a: _Placed, b: _Placed, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of landmarks whose difference a gate could hold.

    Landmarks of the one map are taken by how uncertain they are, some octaves at a time: few that
    are far and uncertain would make the gates of all others wide.
    """
    wide_a, wide_b = a.widest_m2, b.widest_m2
    octave = _OCTAVES * np.ceil(np.log2(wide_b) / _OCTAVES)
    rows_a, rows_b = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for each in np.unique(octave):
        rows = np.flatnonzero(octave == each)
        radius_m = np.sqrt(bound * (wide_a + 2.0**each))
        tree = KDTree(b.position_m[rows])
        found = tree.query_ball_point(a.position_m, radius_m, return_sorted=True)
        rows_a.append(np.repeat(np.arange(len(wide_a)), [len(own) for own in found]))
        rows_b.append(rows[np.fromiter(chain.from_iterable(found), np.int64)])
    i, j = np.concatenate(rows_a), np.concatenate(rows_b)
    off = a.position_m[i] - b.position_m[j]
    near = np.einsum("ni,ni->n", off, off) <= bound * (wide_a[i] + wide_b[j])
    return i[near], j[near]
