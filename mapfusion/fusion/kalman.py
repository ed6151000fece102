"""Kalman fusion of pairs of landmarks (eq. 12-16): corrected, with drift, and as printed.

Maps are fused one after the other. Landmarks are paired by the inliers of the alignments first, and
the remaining ones by gate and descriptor. Landmarks without a partner are kept.
"""

from dataclasses import replace

import numpy as np

from mapfusion.fusion.fusers import Component, FusedMap, MergeParameters
from mapfusion.fusion.landmark_association import (
    ABSENT,
    AlignedLandmarks,
    FusePairs,
    one_to_one,
)
from mapfusion.geometry.numerics import Float


def fuse_sequentially(
    component: Component, parameters: MergeParameters, fuse_pairs: FusePairs, use_drift: bool
) -> FusedMap:
    """Fuse the maps of a component one after the other.

    Args:
        component: the maps with their poses.
        parameters: parameters of the pairing.
        fuse_pairs: function that fuses two landmarks.
        use_drift: use S + s_drift^2 I instead of the paper's covariance S.
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
    """Return the landmarks that `fuse_sequentially` computes."""
    members, planar = component.by_name, component.planar
    test, drift = parameters.association_test(planar), component.drift_sigma_m

    def transformed(k: int) -> AlignedLandmarks:
        sigma_T = component.motion_covariance[k] if parameters.use_alignment_uncertainty else None
        T = component.T_first_map[k]
        return AlignedLandmarks.of(component.maps, k, T, sigma_T, drift[k], use_drift)

    fused = transformed(members[0])
    for k in members[1:]:
        other = transformed(k)
        # Rows of the fused map and of map k that are inliers of an alignment. Contradictory pairs
        # are resolved in the order of their descriptor distance.
        known_rows, other_rows = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        dissimilarity = [np.empty(0)]
        for pair in component.pairs:
            if k not in (pair.a, pair.b):
                continue
            placed, index, index_in_new = pair.a, pair.inliers.index_a, pair.inliers.index_b
            if k == pair.a:
                placed, index, index_in_new = pair.b, index_in_new, index
            row_of = np.full(1 + index.max(initial=-1), ABSENT)
            parent = fused.parents[:, placed]
            inside = (parent != ABSENT) & (parent < len(row_of))
            row_of[parent[inside]] = np.flatnonzero(inside)
            is_present = row_of[index] != ABSENT
            known_rows.append(row_of[index[is_present]])
            other_rows.append(index_in_new[is_present])
            dissimilarity.append(pair.inliers.distance[is_present])
        rows, others = one_to_one(
            np.concatenate(known_rows), np.concatenate(other_rows), np.concatenate(dissimilarity)
        )
        # associate the landmarks that are no inliers of an alignment
        unmatched = np.setdiff1d(np.arange(len(fused)), rows)
        unmatched_others = np.setdiff1d(np.arange(len(other)), others)
        candidates = test.candidates(fused[unmatched], other[unmatched_others])
        more_rows, more_others = one_to_one(*candidates)
        rows = np.concatenate([rows, unmatched[more_rows]])
        others = np.concatenate([others, unmatched_others[more_others]])
        fused = fused.fuse_with(other, rows, others, 2 if planar else 3, fuse_pairs)
    return fused


def kalman_update(
    position_i: Float, covariance_i: Float, position_j: Float, covariance_j: Float
) -> tuple[Float, Float]:
    """Fuse N pairs of landmarks in a common frame by a stationary Kalman filter (eq. 12 to 14).

    Eq. 13 is printed with L_i - L_j, which has the wrong sign.

    Args:
        position_i: positions of the first landmarks, shape (N, D).
        covariance_i: covariances of the first landmarks, shape (N, D, D).
        position_j: positions of the second landmarks, shape (N, D).
        covariance_j: covariances of the second landmarks, shape (N, D, D).

    Returns:
        fused positions (N, D) and covariances (N, D, D).
    """
    # S_i and S_i + S_j are symmetric, so K^T solves (S_i + S_j) K^T = S_i
    gain = np.swapaxes(np.linalg.solve(covariance_i + covariance_j, covariance_i), 1, 2)  # eq. 12
    position = position_i + np.einsum("nij,nj->ni", gain, position_j - position_i)  # eq. 13
    covariance = covariance_i - gain @ covariance_i  # eq. 14
    return position, (covariance + np.swapaxes(covariance, 1, 2)) / 2


def kalman_update_as_printed(
    position_i: Float, covariance_i: Float, position_j: Float, covariance_j: Float
) -> tuple[Float, Float]:
    """Fuse pairs of landmarks with the printed sign of eq. 13, L_F = L_i + K (L_i - L_j).

    The fused landmark moves away from L_j, by as much as the correct one moves towards it. Eq. 14
    does not depend on the sign, so the covariance states a precision that the position lacks.
    Arguments and results are those of `kalman_update`.
    """
    position, covariance = kalman_update(position_i, covariance_i, position_j, covariance_j)
    return 2 * position_i - position, covariance


class Kalman:
    """Kalman fusion with the covariances of the filter, as in the paper."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the maps of a component."""
        return fuse_sequentially(component, parameters, kalman_update, use_drift=False)


class KalmanDrift:
    """Kalman fusion with the covariances S + s_drift^2 I."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the maps of a component."""
        return fuse_sequentially(component, parameters, kalman_update, use_drift=True)


class KalmanAsPrinted:
    """Kalman fusion with eq. 13 as printed, to show the effect of its sign."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the maps of a component; `fallback` reports covariances that are not positive."""
        fused = fuse_sequentially(component, parameters, kalman_update_as_printed, use_drift=False)
        dimensions = fused.landmarks.n_dimensions
        several = np.count_nonzero(fused.parents != ABSENT, axis=1) > 1
        covariance = fused.landmarks.covariance_m2[several, :dimensions, :dimensions]
        n_wrong = int(np.count_nonzero(np.linalg.eigvalsh(covariance)[:, 0] <= 0))
        message = f"{n_wrong} of {len(covariance)} fused covariances are not positive definite"
        return replace(fused, fallback=message if n_wrong else "")
