"""ImpICP: ICP from the best of a few minimal sets (section 5)."""

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mapfusion.align.correspondences import Correspondences
from mapfusion.align.icp import MAX_ROUNDS, ClosestPoints, draw_motion, why_no_start
from mapfusion.align.pairs import gather, undetermined
from mapfusion.align.result import Alignment
from mapfusion.landmark_map import LandmarkMap


@dataclass(frozen=True)
class ImpIcp:
    """ICP with a better start.

    The paper says only that ImpICP is an ad hoc change of ICP that makes a good estimate more
    probable. Our reading: draw a few minimal sets among the correspondences whose descriptors match
    best, and go on from the one after which map b's landmarks lie nearest to map a's (root mean
    square, what ICP itself minimises). Many sets, scored by support, would be RANSAC again.

    Attributes:
        sets: minimal sets drawn.
        best_share: of the correspondences, by descriptor distance, from which they are drawn.
        max_rounds: an estimate that still changes then is refused.
    """

    randomised: ClassVar[bool] = True
    sets: int = 3
    best_share: float = 0.25
    max_rounds: int = MAX_ROUNDS

    def __post_init__(self) -> None:
        if not self.sets > 0:
            raise ValueError("sets: must be positive")
        if not 0 < self.best_share <= 1:
            raise ValueError("best_share: must lie between 0 and 1")
        if not self.max_rounds > 0:
            raise ValueError("max_rounds: must be positive")

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        started_s = time.perf_counter()
        pairs = gather(map_a, map_b, correspondences)
        reason = why_no_start(map_a, map_b, pairs)
        if reason:
            return undetermined(reason, len(pairs), started_s)
        # equal distances (labels) are all as good as the last one taken
        last = np.sort(correspondences.distance)[max(int(self.best_share * len(pairs)), 2) - 1]
        best = np.flatnonzero(correspondences.distance <= last)
        closest = ClosestPoints(map_a, map_b)
        starts = [draw_motion(pairs, best, rng) for _ in range(self.sets)]
        start = min(starts, key=closest.cost_m2)
        return closest.align(start, correspondences, self.max_rounds, started_s)
