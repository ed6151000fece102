"""The map that a joint estimate is, with the joint covariance of its landmarks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.aligned_landmarks import ABSENT, AlignedLandmarks
from mapfusion.fuse.component import Component
from mapfusion.fuse.joint_estimate import JointEstimate
from mapfusion.fuse.joint_map import JointMap, weighted_information
from mapfusion.fuse.parameters import MergeParameters
from mapfusion.fused_map import FusedMap
from mapfusion.joint_covariance import JointCovariance, condensed
from mapfusion.landmark_map import LandmarkMap
from mapfusion.looks import DESCRIPTOR_LENGTH, NO_LABEL
from mapfusion.se2 import IDENTITY, Float
from mapfusion.smoother.blocks import inverses

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
            parameters.same_point(self.component.planar).duplicate_share(still),
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
        said = [estimate.said(self.maps, k, self.points[own, k]) for k, own in enumerate(rows)]
        W = [
            weighted_information(each, weight[own, k])
            for k, (own, each) in enumerate(zip(rows, said, strict=True))
        ]
        information = np.zeros((n, n_dimensions, n_dimensions))
        for own, its in zip(rows, W, strict=True):
            information[own] += its
        V = inverses(information)
        total, moved = np.zeros((n, n_dimensions)), np.zeros((n, n_dimensions, n_unknowns))
        for k, (own, each, its) in enumerate(zip(rows, said, W, strict=True)):
            gain = V[own] @ its
            total[own] += np.einsum("nij,nj->ni", gain, each.y_m)
            moved[own] += gain @ estimate.moved_m(self.maps, k, each, factor)
        covariance, position = np.zeros((n, 3, 3)), np.zeros((n, 3))
        covariance[:, :n_dimensions, :n_dimensions] = V
        position[:, :n_dimensions] = total
        shared = np.zeros((n_unknowns, n, 3))
        shared[:, :, :n_dimensions] = moved.transpose(2, 0, 1)
        return position, condensed(covariance, shared.reshape(n_unknowns, 3 * n))
