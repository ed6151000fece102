"""Landmarks of several maps in one frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.align.rigid import motion_jacobian
from mapfusion.landmark_map import LandmarkMap
from mapfusion.looks import DESCRIPTOR_LENGTH, NO_LABEL
from mapfusion.robot_log import with_rows
from mapfusion.se2 import Float, transform_covariances, transform_points

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

    def joined(
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
