"""Kalman fusion of pairs of landmarks (eq. 12-16), with and without the drift of the maps.

First by the inliers of its alignments with these, then what they missed is paired by gate and
descriptor with any fused landmark; the rest is carried over.
"""

from collections.abc import Sequence

import numpy as np

from mapfusion.fusion.aligned_landmarks import (
    ABSENT,
    AlignedLandmarks,
    AssociationTest,
    FusePairs,
    one_to_one,
)
from mapfusion.fusion.fused_map import AlignedPair, Component, FusedMap, MergeParameters
from mapfusion.geometry.numerics import Float


def fuse_sequentially(
    component: Component, parameters: MergeParameters, fuse_pairs: FusePairs, use_drift: bool
) -> FusedMap:
    """The members fused.

    Args:
        component: what is fused.
        parameters: how landmarks are paired that no alignment names.
        fuse_pairs: what becomes of two landmarks.
        use_drift: weigh with, and report, S + s_drift^2 I instead of the paper's S.
    """
    fused = fuse_landmarks_sequentially(component, parameters, fuse_pairs, use_drift)
    planar, drift = component.planar, component.drift_sigma_m
    return FusedMap(
        fused.landmark_map(planar, component.maps[component.members[0]].name),
        fused.parents,
        component.T_first_map,
        component.motion_covariance,
        drift if use_drift else np.where(np.isnan(drift), np.nan, 0.0),
        parameters.association_test(planar).duplicate_share(fused),
        component.left_out,
    )


def fuse_landmarks_sequentially(
    component: Component, parameters: MergeParameters, fuse_pairs: FusePairs, use_drift: bool
) -> AlignedLandmarks:
    """The landmarks alone, of the same."""
    members, planar = component.by_name, component.planar
    test, drift = parameters.association_test(planar), component.drift_sigma_m

    def moved(k: int) -> AlignedLandmarks:
        sigma_T = component.motion_covariance[k] if parameters.use_alignment_uncertainty else None
        T = component.T_first_map[k]
        return AlignedLandmarks.of(component.maps, k, T, sigma_T, drift[k], use_drift)

    fused = moved(members[0])
    for k in members[1:]:
        other = moved(k)
        rows, others = _paired(fused, other, *_inliers(fused, k, component.pairs), test)
        fused = fused.fuse_with(other, rows, others, 2 if planar else 3, fuse_pairs)
    return fused


def _inliers(
    fused: AlignedLandmarks, k: int, pairs: Sequence[AlignedPair]
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the fused map and of map k that alignments with maps in it say are one.

    Where two say different things, what is most alike counts.
    """
    rows, others, dissimilarity = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty(0)]
    for pair in pairs:
        if k not in (pair.a, pair.b):
            continue
        known, index, own = pair.a, pair.inliers.index_a, pair.inliers.index_b
        if k == pair.a:
            known, index, own = pair.b, own, index
        row_of = np.full(1 + index.max(initial=-1), ABSENT)
        parent = fused.parents[:, known]
        inside = (parent != ABSENT) & (parent < len(row_of))
        row_of[parent[inside]] = np.flatnonzero(inside)
        has = row_of[index] != ABSENT
        rows.append(row_of[index[has]])
        others.append(own[has])
        dissimilarity.append(pair.inliers.distance[has])
    return one_to_one(np.concatenate(rows), np.concatenate(others), np.concatenate(dissimilarity))


def _paired(
    fused: AlignedLandmarks,
    other: AlignedLandmarks,
    rows: np.ndarray,
    others: np.ndarray,
    test: AssociationTest,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the fused and of the other map that are one: those given, then what they missed."""
    missed_rows = np.setdiff1d(np.arange(len(fused)), rows)
    missed_others = np.setdiff1d(np.arange(len(other)), others)
    more_rows, more_others = one_to_one(*test.candidates(fused[missed_rows], other[missed_others]))
    return (
        np.concatenate([rows, missed_rows[more_rows]]),
        np.concatenate([others, missed_others[more_others]]),
    )


class Kalman:
    """With the landmarks' covariances as the filter states them, as the paper has it."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        return fuse_sequentially(component, parameters, kalman_update, use_drift=False)


def kalman_update(
    position_i: Float, covariance_i: Float, position_j: Float, covariance_j: Float
) -> tuple[Float, Float]:
    """Stationary Kalman filter on pairs of landmarks in one frame (eq. 12 to 14).

    Eq. 13 is printed with L_i - L_j, which moves the result away from L_j; the sign here is right.

    Positions are (N, D), covariances (N, D, D), those returned as well.
    """
    # S_i and S_i + S_j are symmetric, so K^T solves (S_i + S_j) K^T = S_i
    gain = np.swapaxes(np.linalg.solve(covariance_i + covariance_j, covariance_i), 1, 2)  # eq. 12
    position = position_i + np.einsum("nij,nj->ni", gain, position_j - position_i)  # eq. 13
    covariance = covariance_i - gain @ covariance_i  # eq. 14
    return position, (covariance + np.swapaxes(covariance, 1, 2)) / 2


class KalmanDrift:
    """With S + s_drift^2 I in place of the paper's S."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        return fuse_sequentially(component, parameters, kalman_update, use_drift=True)
