"""Joint fusion: poses, shared errors and landmarks of all maps in one least-squares estimate.

Common landmarks of maps with joint covariances also correct the landmarks that only one robot has
observed. Maps without a joint covariance are fused by their marginal covariances.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations

import numpy as np
import scipy

from mapfusion.align.alignment import MIN_PAIRS
from mapfusion.descriptors import USURF, merged_kind, relative_distance
from mapfusion.fusion.fusers import Component, FusedMap, MergeParameters
from mapfusion.fusion.joint_estimate import (
    JointEstimate,
    JointMap,
    estimate_jointly,
    weighted_information,
)
from mapfusion.fusion.kalman import KalmanDrift
from mapfusion.fusion.landmark_association import (
    ABSENT,
    AlignedLandmarks,
    CandidatePairs,
    cluster_landmarks,
)
from mapfusion.geometry.joint_covariance import JointCovariance, reduce_rank
from mapfusion.geometry.numerics import Float, inverses, one_blas_thread
from mapfusion.geometry.se2 import IDENTITY
from mapfusion.landmark_map import LandmarkMap
from mapfusion.smoother.robust_loss import student_bound
from mapfusion.tables import NO_LABEL

_SOURCE_UNKNOWN = -1  # a fused landmark has no source observation


@dataclass(frozen=True)
class JointlyFused:
    """Estimate of K members of a component.

    Attributes:
        component: the component.
        maps: maps of the members.
        points: rows of each point's landmarks in the members' maps, shape (C, K), ABSENT for none;
            points of several maps come first.
        estimate: the estimate.
    """

    component: Component
    maps: Sequence[JointMap]
    points: np.ndarray
    estimate: JointEstimate

    def fused_map(self, parameters: MergeParameters) -> FusedMap:
        """Return the fused map with descriptors, labels and parents."""
        members, n_maps = self.component.members, len(self.component.maps)
        position, joint = self._positions()
        maps = [self.component.maps[k] for k in members]
        n, has_parent = len(self.points), self.points != ABSENT
        count, largest_count = np.zeros(n, np.int64), np.zeros(n, np.int64)
        kind = merged_kind(*(landmark_map.descriptor_kind for landmark_map in maps))
        descriptor = np.full((n, USURF.length if kind is None else kind.length), np.nan, np.float32)
        label = np.full(n, NO_LABEL, np.int32)
        for k, landmark_map in enumerate(maps):
            rows, landmarks = np.flatnonzero(has_parent[:, k]), self.points[has_parent[:, k], k]
            count[rows] += landmark_map.count[landmarks]
            if landmark_map.descriptor is not None:  # of the landmark with most observations
                has_more = landmark_map.count[landmarks] > largest_count[rows]
                descriptor[rows[has_more]] = landmark_map.descriptor[landmarks[has_more]]
                largest_count[rows[has_more]] = landmark_map.count[landmarks[has_more]]
            if landmark_map.label is not None:
                unlabelled = label[rows] == NO_LABEL
                label[rows] = np.where(unlabelled, landmark_map.label[landmarks], label[rows])
        fused = LandmarkMap(
            position,
            joint.marginal_m2,
            count.astype(np.int32),
            np.full(n, _SOURCE_UNKNOWN, dtype=np.int64),
            None if np.isnan(descriptor).all() else descriptor,
            None if np.all(label == NO_LABEL) else label,
            self.component.planar,
            maps[0].name,
            joint,
            descriptor_kind=kind,
        )

        # duplicates are found by the independent errors, because shared errors move both landmarks
        independent = replace(fused, covariance_m2=joint.own_m2, joint=None)
        landmarks = AlignedLandmarks.of([independent], 0, IDENTITY, None, 0.0, use_drift=False)
        test = parameters.association_test(self.component.planar)

        T, covariance = np.full((n_maps, 3), np.nan), np.full((n_maps, 3, 3), np.nan)
        T[members] = self.estimate.T_first_map
        covariance[members] = self.estimate.motion_covariance
        parents, drift = np.full((n, n_maps), ABSENT), np.full(n_maps, np.nan)
        parents[:, members], drift[members] = self.points, 0.0
        duplicate_share, left_out = test.duplicate_share(landmarks), self.component.left_out
        return FusedMap(fused, parents, T, covariance, drift, duplicate_share, left_out)

    def _positions(self) -> tuple[Float, JointCovariance]:
        """Return the points (C, 3) and their joint covariance.

        A point g has the error dg/du of the unknowns' errors, and an independent error.
        """
        n, has_parent, estimate = len(self.points), self.points != ABSENT, self.estimate
        n_dimensions, n_unknowns = self.maps[0].position_m.shape[1], len(estimate.covariance)
        weight = has_parent.astype(np.float64)
        weight[: len(estimate.weight)] = estimate.weight
        factor = np.asarray(np.linalg.cholesky(estimate.covariance), np.float64)
        rows = [np.flatnonzero(has_parent[:, k]) for k in range(len(self.maps))]
        transformed = [
            estimate.transformed(self.maps, k, self.points[is_in_map, k])
            for k, is_in_map in enumerate(rows)
        ]
        W = [
            weighted_information(each, weight[is_in_map, k])
            for k, (is_in_map, each) in enumerate(zip(rows, transformed, strict=True))
        ]
        information = np.zeros((n, n_dimensions, n_dimensions))
        for is_in_map, its in zip(rows, W, strict=True):
            information[is_in_map] += its
        V = inverses(information)
        total, jacobian = np.zeros((n, n_dimensions)), np.zeros((n, n_dimensions, n_unknowns))
        for k, (is_in_map, each, its) in enumerate(zip(rows, transformed, W, strict=True)):
            gain = V[is_in_map] @ its
            total[is_in_map] += np.einsum("nij,nj->ni", gain, each.y_m)
            jacobian[is_in_map] += gain @ estimate.moved_m(self.maps, k, each, factor)
        covariance, position = np.zeros((n, 3, 3)), np.zeros((n, 3))
        covariance[:, :n_dimensions, :n_dimensions] = V
        position[:, :n_dimensions] = total
        shared_jacobian = np.zeros((n_unknowns, n, 3))
        shared_jacobian[:, :, :n_dimensions] = jacobian.transpose(2, 0, 1)
        return position, reduce_rank(covariance, shared_jacobian.reshape(n_unknowns, 3 * n))


# Largest number of rounds of association and estimation.
_MOST_ROUNDS = 5
# Landmarks whose variances are within this number of octaves are searched with one radius.
_OCTAVES = 3
# Smallest degrees of freedom of the gate. Heavier tails have no variance; they are due to false
# associations.
_LEAST_DOF = 2.0


class JointFuser:
    """Joint estimate of all maps in the frame of the first member.

    Kalman fusion with drift is the fallback if common landmarks do not connect all maps, or if the
    equations are singular.
    """

    smoothed = True

    @one_blas_thread
    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the maps of a component."""
        reason = f"a map has fewer than {MIN_PAIRS} landmarks in common with the others"
        try:
            fused = self._fuse_jointly(component, parameters)
        except np.linalg.LinAlgError:
            fused = None
            reason = "the maps' covariances differ too much in size for a joint estimate"
        if fused is None:
            return replace(KalmanDrift().fuse(component, parameters), fallback=reason)
        return fused

    @staticmethod
    def _fuse_jointly(component: Component, parameters: MergeParameters) -> FusedMap | None:
        """Return the fused map; None if common landmarks do not connect all maps."""
        n_dimensions = 2 if component.planar else 3
        drift, height = component.drift_sigma_m, component.height_sigma_m
        member_maps = [component.maps[k] for k in component.members]
        maps = [
            JointMap.of(landmarks, float(drift[k]), float(height[k]), n_dimensions)
            for landmarks, k in zip(member_maps, component.members, strict=True)
        ]
        # inliers of the alignments; `a` is the lesser of the two members
        member = {int(k): row for row, k in enumerate(component.members)}
        inliers = []
        for pair in component.pairs:
            pair_inliers = pair.inliers
            sides = [(member[pair.a], pair_inliers.index_a), (member[pair.b], pair_inliers.index_b)]
            (a, row_a), (b, row_b) = sorted(sides, key=lambda side: side[0])
            inliers.append(CandidatePairs(a, b, row_a, row_b, pair_inliers.distance))
        sizes = [len(landmarks) for landmarks in member_maps]
        points = cluster_landmarks(inliers, sizes)
        if not _is_connected(points):
            return None
        estimate = _estimate(maps, component.T_first_map[component.members], points)
        for _ in range(_MOST_ROUNDS):
            pairs = _candidates(member_maps, maps, estimate, inliers, parameters)
            new_points = cluster_landmarks(pairs, sizes)
            if np.array_equal(points, new_points) or not _is_connected(new_points):
                break
            points, estimate = new_points, _estimate(maps, estimate.T_first_map, new_points)
        return JointlyFused(component, maps, points, estimate).fused_map(parameters)


def _is_connected(points: np.ndarray) -> bool:
    """Return True if pairs of maps with enough common points (C, K) connect all maps."""
    has_parent = (points != ABSENT).astype(np.int64)
    n_components, _ = scipy.sparse.csgraph.connected_components(
        scipy.sparse.csr_matrix(has_parent.T @ has_parent >= MIN_PAIRS), directed=False
    )
    return n_components == 1


def _estimate(maps: Sequence[JointMap], T_first_map: Float, points: np.ndarray) -> JointEstimate:
    """Estimate from the points of several maps; other points carry no information."""
    several = np.count_nonzero(points != ABSENT, axis=1) > 1
    return estimate_jointly(maps, T_first_map, points[several])


@dataclass(frozen=True)
class _PlacedMap:
    """Landmarks of a map in the common frame.

    Attributes:
        position_m: positions, shape (n, D).
        own_m2: covariances of the independent errors, shape (n, D, D).
        shared_m: displacement by one sigma of each of U independent shared variables, shape
            (n, D, U).
    """

    position_m: Float
    own_m2: Float
    shared_m: Float

    @cached_property
    def bound_m2(self) -> Float:
        """Share of each landmark in a bound of the variance of a difference, shape (n,)."""
        trace_m2, shared_m = np.trace(self.own_m2, axis1=1, axis2=2), self.shared_m
        return trace_m2 + 2 * np.einsum("nij,nij->n", shared_m, shared_m)


def _candidates(
    landmark_maps: Sequence[LandmarkMap],
    maps: Sequence[JointMap],
    estimate: JointEstimate,
    inliers: Sequence[CandidatePairs],
    parameters: MergeParameters,
) -> list[CandidatePairs]:
    """Return landmarks of every pair of maps that may be the same point.

    Landmarks with equal labels need no gate and have the dissimilarity 0. Other landmarks have to
    pass the gate and the descriptor test. Inliers of an alignment need no descriptor test;
    landmarks without descriptors have to be inliers. The gate is that of the fitted Student-t
    distribution, because a Gaussian gate would remove the tails that are fitted.
    """
    factor = np.asarray(np.linalg.cholesky(estimate.covariance), np.float64)
    placed = []
    for k, placed_map in enumerate(maps):
        transformed = estimate.transformed(maps, k, np.arange(len(placed_map)))
        shared_m = estimate.moved_m(maps, k, transformed, factor)
        placed.append(_PlacedMap(transformed.y_m, transformed.own_m2, shared_m))
    labels = [
        np.full(len(placed_map), NO_LABEL) if placed_map.label is None else placed_map.label
        for placed_map in landmark_maps
    ]
    dof = max(estimate.dof, _LEAST_DOF)
    bound = student_bound(parameters.gate_probability, dof, placed[0].position_m.shape[1])
    pairs = []
    for a, b in combinations(range(len(landmark_maps)), 2):
        first, second = landmark_maps[a].descriptor, landmark_maps[b].descriptor
        if first is None or second is None:
            of_maps = [pair for pair in inliers if (pair.a, pair.b) == (a, b)]
            rows = [np.stack([pair.row_a, pair.row_b]) for pair in of_maps]
            i, j = np.concatenate([np.empty((2, 0), np.int64), *rows], axis=1)
            distance = np.concatenate([np.empty(0), *(pair.dissimilarity for pair in of_maps)])
        else:
            i, j = _neighbours(placed[a], placed[b], bound)
            unlabelled = (labels[a][i] == NO_LABEL) | (labels[b][j] == NO_LABEL)
            i, j = i[unlabelled], j[unlabelled]
            apart = np.linalg.norm(first[i] - second[j], axis=1).astype(np.float64)
            distance = relative_distance(
                apart, landmark_maps[a].descriptor_kind, landmark_maps[b].descriptor_kind
            )
            similar = distance <= parameters.max_descriptor_distance
            for pair in inliers:
                if (pair.a, pair.b) == (a, b):  # an alignment tells that they are the same point
                    of_alignment = pair.row_a * len(second) + pair.row_b
                    similar |= np.isin(i * len(second) + j, of_alignment)
            i, j, distance = i[similar], j[similar], distance[similar]

        # gate of the differences, in which common errors cancel
        placed_a, placed_b = placed[a], placed[b]
        shared_difference_m = placed_a.shared_m[i] - placed_b.shared_m[j]
        S = (
            placed_a.own_m2[i]
            + placed_b.own_m2[j]
            + shared_difference_m @ np.swapaxes(shared_difference_m, 1, 2)
        )
        difference_m = placed_a.position_m[i] - placed_b.position_m[j]
        inside = np.einsum("ni,nij,nj->n", difference_m, inverses(S), difference_m) <= bound

        labelled_a, labelled_b = (np.flatnonzero(labels[k] != NO_LABEL) for k in (a, b))
        same_a, same_b = np.nonzero(labels[a][labelled_a][:, None] == labels[b][labelled_b])
        i = np.concatenate([labelled_a[same_a], i[inside]])
        j = np.concatenate([labelled_b[same_b], j[inside]])
        dissimilarity = np.concatenate([np.zeros(len(same_a)), distance[inside]])
        pairs.append(CandidatePairs(a, b, i, j, dissimilarity))
    return pairs


def _neighbours(a: _PlacedMap, b: _PlacedMap, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of all pairs of landmarks that a gate may contain.

    Landmarks of `b` are searched in groups of similar uncertainty, so that a few uncertain ones do
    not enlarge the search radius of all.
    """
    bound_a, bound_b = a.bound_m2, b.bound_m2
    octave = _OCTAVES * np.ceil(np.log2(bound_b) / _OCTAVES)
    rows_a, rows_b = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for each in np.unique(octave):
        rows = np.flatnonzero(octave == each)
        radius_m = np.sqrt(bound * (bound_a + 2.0**each))
        tree = scipy.spatial.KDTree(b.position_m[rows])
        neighbours = tree.query_ball_point(a.position_m, radius_m, return_sorted=True)
        rows_a.append(
            np.repeat(
                np.arange(len(bound_a)), [len(neighbour_rows) for neighbour_rows in neighbours]
            )
        )
        rows_b.append(rows[np.fromiter(chain.from_iterable(neighbours), np.int64)])
    i, j = np.concatenate(rows_a), np.concatenate(rows_b)
    difference_m = a.position_m[i] - b.position_m[j]
    is_near = np.einsum("ni,ni->n", difference_m, difference_m) <= bound * (bound_a[i] + bound_b[j])
    return i[is_near], j[is_near]
