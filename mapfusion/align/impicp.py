"""ImpICP: ICP from the best of a few minimal sets (section 5)."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.icp import MAX_ROUNDS, ClosestPoints, draw_motion
from mapfusion.align.method import Fit, Needs
from mapfusion.align.pairs import Pairs
from mapfusion.arguments import Range, require_in_range


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
    needs: ClassVar[Needs] = Needs(dimensions=1)
    sets: Annotated[int, Range(1, 100_000, "sets")] = 3
    best_share: Annotated[float, Range(1e-3, 1, "1")] = 0.25
    max_rounds: Annotated[int, Range(1, 100_000, "rounds")] = MAX_ROUNDS

    def __post_init__(self) -> None:
        require_in_range(self)

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit:
        """T_a_b of the last pairing."""
        # equal distances (labels) are all as good as the last one taken
        last = np.sort(pairs.distance)[max(int(self.best_share * len(pairs)), 2) - 1]
        best = np.flatnonzero(pairs.distance <= last)
        closest = ClosestPoints.of(pairs)
        starts = [draw_motion(pairs, best, rng) for _ in range(self.sets)]
        return closest.descend(closest.nearest_of(starts), self.max_rounds)
