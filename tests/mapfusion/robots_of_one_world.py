"""Maps of one world by robots that saw parts of it, and their alignments."""

import numpy as np

from mapfusion.align.alignment import Alignment, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import AlignedPair, MergeParameters
from mapfusion.fusion.kalman import KalmanDrift
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from tests.mapfusion.align.map_pairs import covariances

DRIFT_M = 0.05


class Robots:
    """Maps of one world by robots that saw parts of it, and the alignments to the first."""

    def __init__(self, parts, drift_m=DRIFT_M, planar=False, labels=False, seed=0, false_T=None):
        rng = np.random.default_rng(seed)
        n = 1 + max(p.stop for p in parts) - 1
        self.world = rng.uniform(0, [20, 20, 0 if planar else 2.5], (n, 3))
        descriptor = rng.standard_normal((n, 64))
        descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
        self.rows = [np.arange(p.start, p.stop) for p in parts]
        self.T_world_map = rng.uniform([-5, -5, -3], [5, 5, 3], (len(parts), 3))
        free = np.array([1, 1, 0 if planar else 1])
        self.maps = []
        for k, rows in enumerate(self.rows):
            rows = rng.permutation(rows)
            self.rows[k] = rows
            S = covariances(rng, len(rows)) * 0.2 * np.outer(free, free)
            noise = rng.standard_normal((len(rows), 3, 1))
            p = se2.transform_points(se2.inverse(self.T_world_map[k]), self.world[rows])
            p += (np.linalg.cholesky(S + 1e-18 * np.eye(3)) @ noise)[:, :, 0] * free
            p += rng.normal(0, drift_m, (len(rows), 3)) * [1, 1, 0]
            seen = descriptor[rows] + rng.normal(0, 0.01, (len(rows), 64))
            self.maps.append(
                LandmarkMap(
                    p,
                    S,
                    rng.integers(3, 20, len(rows)).astype(np.int32),
                    np.arange(len(rows)),
                    None if labels else seen.astype(np.float32),
                    rows.astype(np.int32) if labels else None,
                    planar,
                    f"robot {k}",
                )
            )
        self.correspondences, self.alignments = [], []
        for k in range(1, len(parts)):
            _, at_a, at_b = np.intersect1d(self.rows[0], self.rows[k], return_indices=True)
            self.correspondences.append(Correspondences(at_a, at_b, np.zeros(len(at_a))))
            T = se2.between(self.T_world_map[0], self.T_world_map[k])
            accepted = np.ones(len(at_a), dtype=bool)
            covariance = np.diag([0.02, 0.03, 0.004]) ** 2
            self.alignments.append(
                Alignment(T, covariance, accepted, 0.0, Status.ACCEPTED, "", drift_m * 2**0.5)
            )

    def fusion(self, fuser=None, **parameters):
        pairs = [
            AlignedPair(0, k, alignment, found)
            for k, (alignment, found) in enumerate(
                zip(self.alignments, self.correspondences, strict=True), start=1
            )
        ]
        return merge(self.maps, pairs, MergeParameters(**parameters), fuser or KalmanDrift())

    def merge(self, fuser=None, **parameters):
        return self.fusion(fuser, **parameters).fused[0]

    def point_of(self, fused):
        """Row of the world that each fused landmark is, after its first parent."""
        points = np.full(len(fused.landmarks), -1)
        for rows, parents in zip(self.rows, fused.parents.T, strict=True):
            points[(parents != ABSENT) & (points < 0)] = rows[
                parents[(parents != ABSENT) & (points < 0)]
            ]
        return points

    def errors(self, fused):
        truth = se2.transform_points(se2.inverse(self.T_world_map[0]), self.world)
        return fused.landmarks.position_m - truth[self.point_of(fused)]
