"""The regions that two maps must share under a motion, and how much of each is in both."""

from dataclasses import dataclass

import numpy as np

from mapfusion.align.closest import Grid
from mapfusion.align.correspondences import HeightGate
from mapfusion.evidence.expected import Seen, Watch, must_be_seen
from mapfusion.evidence.found import Gates, Looks, has
from mapfusion.evidence.likelihood import SHARE_CONFIRMED, SHARE_CONTRADICTED, log10_ratio
from mapfusion.evidence.parameters import EvidenceParameters
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float, inverse, transform_points

LEAST_EXPECTED = 5  # landmarks of a region; fewer say little, and mostly lie on its edge


@dataclass(frozen=True)
class Regions:
    """What became of what must be seen, region by region.

    Attributes:
        found: (R,) landmarks that the other map has.
        expected: (R,) landmarks that it must have, those of both maps.
    """

    found: np.ndarray
    expected: np.ndarray

    def __len__(self) -> int:
        return len(self.found)

    @property
    def n_confirmed(self) -> int:
        """Regions of which most is there."""
        return int(np.sum(self.found >= SHARE_CONFIRMED * self.expected))

    @property
    def n_contradicted(self) -> int:
        """Regions of which hardly anything is there."""
        return int(np.sum(self.found <= SHARE_CONTRADICTED * self.expected))

    def log10_ratio(self, twin_share: float) -> float:
        """log10 of how much likelier all of them are if the motion is right; 0 of none."""
        return float(np.sum(log10_ratio(self.found, self.expected, twin_share)))


class Witness:
    """A map with viewing evidence, made ready to be asked what it must have seen."""

    def __init__(self, landmarks: LandmarkMap) -> None:
        """Of a map that has viewing evidence and descriptors."""
        viewing, descriptor = landmarks.viewing, landmarks.descriptor
        assert viewing is not None
        assert descriptor is not None
        self.landmarks, self._viewing = landmarks, viewing
        self.watch = Watch.of(viewing)
        position = np.ascontiguousarray(landmarks.position_m)
        z_m2 = landmarks.covariance_m2[:, 2, 2].copy()
        near = Grid.of(position[:, :2])
        self.looks = Looks(near, position[:, 2].copy(), z_m2, np.ascontiguousarray(descriptor))

    def seen_from(self, T: Float) -> Seen:
        """Its landmarks as another robot would find them, T from its frame to that one's."""
        viewing, p = self._viewing, self.landmarks.position_m.copy()
        p[:, :2] = transform_points(T, p[:, :2])
        angle = viewing.direction_rad + T[2]
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        distance = np.where(viewing.n_views > 0, viewing.distance_m, 0.0)
        return Seen(p, direction, distance)


class Witnesses:
    """Two maps that may be asked about any motion between them."""

    def __init__(self, a: Witness, b: Witness, parameters: EvidenceParameters) -> None:
        self.a, self.b = a, b
        height = HeightGate()
        planar = a.landmarks.planar or b.landmarks.planar
        bound = np.inf if planar else height.bound
        unlike = parameters.max_descriptor_distance
        self._gates = Gates(parameters.gate_m, bound, height.floor_m**2, unlike)

    def regions(self, T_a_b: Float, region_m: float) -> Regions:
        """What each robot must have seen of the other's landmarks, and has, in squares of frame a.

        Both ways are counted into one square: they are of one part of the world.
        """
        rows_b, found_b, b_in_a = self._asked(self.b, self.a, T_a_b)
        rows_a, found_a, _ = self._asked(self.a, self.b, inverse(T_a_b))
        places = np.concatenate([b_in_a[rows_b], self.a.landmarks.position_m[rows_a]])
        found = np.concatenate([found_b, found_a])
        column, row = np.floor(places[:, :2].T / region_m).astype(np.int64)
        width = int(np.ptp(row)) + 1 if len(row) else 1
        _, place = np.unique(column * width + row, return_inverse=True)
        expected = np.bincount(place)
        n_found = np.bincount(place, found, len(expected)).astype(np.int64)
        counts = expected >= LEAST_EXPECTED
        return Regions(n_found[counts], expected[counts])

    def _asked(
        self, own: Witness, other: Witness, T: Float
    ) -> tuple[np.ndarray, np.ndarray, Float]:
        """Rows (n,) of `own` that `other` must have seen, which it has, all of own's in its frame.

        T (3,) maps own's frame into that of the other.
        """
        seen = own.seen_from(T)
        rows = must_be_seen(seen, other.watch)
        return rows, has(seen.p, rows, own.looks, other.looks, self._gates), seen.p
