"""Maps with joint covariances, drawn from just what they state."""

from dataclasses import replace

import numpy as np

from mapfusion.align.alignment import Alignment, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import AlignedPair
from mapfusion.geometry import se2
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.landmark_map import LandmarkMap

OWN_M = 0.01  # of landmarks' own errors
BENT_M, N_BENDS = 0.05, 4  # how far shared variables bend a map, and how many there are


class DrawnTeam:
    """Maps of parts of one world, and the alignments of those that share landmarks.

    Bends are smooth functions of the place: a landmark moves much as its neighbours do.
    """

    def __init__(
        self, parts: list[slice], seed: int, planar: bool = False, bent_m: float = BENT_M
    ) -> None:
        self._rng = rng = np.random.default_rng(seed)
        self._bent_m = bent_m
        self.parts, self.planar, n = parts, planar, max(part.stop for part in parts)
        self.world_m = rng.uniform(0, [20, 20, 0 if planar else 2.5], (n, 3))
        self.look = rng.normal(size=(n, 64))
        self.look /= np.linalg.norm(self.look, axis=1, keepdims=True)
        self.T_world_map = rng.uniform([-5, -5, -3], [5, 5, 3], (len(parts), 3))
        self.maps = [self._drawn(k) for k in range(len(parts))]
        self.pairs = [
            pair
            for a in range(len(parts))
            for b in range(a + 1, len(parts))
            if len((pair := self.pair(a, b)).inliers)
        ]

    def truth(self, k: int) -> np.ndarray:
        """True points of map k, in its frame."""
        return se2.transform_points(se2.inverse(self.T_world_map[k]), self.world_m[self.parts[k]])

    def _drawn(self, k: int) -> LandmarkMap:
        rng, point = self._rng, self.truth(k)
        n, free = len(point), np.array([1.0, 1.0, 0.0 if self.planar else 1.0])
        root = rng.normal(size=(n, 3, 3)) * OWN_M * free[:, None]
        own = root @ np.swapaxes(root, 1, 2) + (OWN_M / 3) ** 2 * np.diag(free)
        wave = rng.uniform(0.1, 0.4, (N_BENDS, 2))
        phase = point[:, :2] @ wave.T + rng.uniform(0, 6, N_BENDS)
        common = self._bent_m * np.sin(phase)[:, :, None] * rng.normal(size=(N_BENDS, 3)) * free
        drawn = np.linalg.cholesky(own + 1e-18 * np.eye(3)) @ rng.normal(size=(n, 3, 1))
        point = point + drawn[:, :, 0] * free
        point += np.einsum("nri,r->ni", common, rng.normal(size=N_BENDS))
        joint = JointCovariance(own, common)
        look = (self.look[self.parts[k]] + rng.normal(0, 0.01, (n, 64))).astype(np.float32)
        about = np.full(n, 9, np.int32), np.arange(n), look, None, self.planar, f"robot {k}"
        return LandmarkMap(point, joint.marginal_m2, *about, joint)

    def pair(self, a: int, b: int) -> AlignedPair:
        """Two maps, aligned by what they share, a few centimetres off."""
        rows = [np.arange(self.parts[k].start, self.parts[k].stop) for k in (a, b)]
        _, at_a, at_b = np.intersect1d(*rows, return_indices=True)
        T = se2.between(self.T_world_map[a], self.T_world_map[b])
        T = T + self._rng.normal(0, [0.03, 0.03, 0.004])
        found = Correspondences(at_a, at_b, np.full(len(at_a), 0.1))
        covariance, inlier = np.diag([0.03, 0.03, 0.004]) ** 2, np.ones(len(at_a), dtype=bool)
        return AlignedPair(
            a, b, Alignment(T, covariance, inlier, 0.0, Status.ACCEPTED, "", 0.05), found
        )

    def with_false_pairs(self, share: float) -> list[AlignedPair]:
        """The alignments, some of whose inliers are not one point."""
        changed = []
        for pair in self.pairs:
            index, n = pair.inliers.index_b.copy(), int(share * len(pair.inliers))
            index[:n] = np.roll(index[:n], 1)
            found = replace(pair.correspondences, index_b=index)
            changed.append(replace(pair, correspondences=found))
        return changed
