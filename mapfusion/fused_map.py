"""What goes into a merge of maps beside the maps, and what comes out."""

from dataclasses import dataclass

import numpy as np

from mapfusion.align.correspondences import Correspondences
from mapfusion.align.result import Alignment
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float
from mapfusion.team.team_graph import Place


@dataclass(frozen=True)
class AlignedPair:
    """Two of the maps that are merged, and how the one lies in the other.

    Attributes:
        a: place of the map in whose frame it is.
        b: place of the one that is moved.
        alignment: T_a_b, refined; not used unless it was accepted.
        correspondences: that it was found from.
        log10_false_alarms: of the alignment; of those that contradict each other and that nothing
            else confirms, the lower counts.
    """

    a: int
    b: int
    alignment: Alignment
    correspondences: Correspondences
    log10_false_alarms: float = 0.0

    @property
    def inliers(self) -> Correspondences:
        """The pairs of landmarks that the alignment says are one."""
        return self.correspondences[self.alignment.inlier]


@dataclass(frozen=True)
class FusedMap:
    """N landmarks fused from some of M maps, in the frame of the first of these.

    Attributes:
        landmarks: the fused map.
        parents: (N, M) row of each map that went into each landmark, ABSENT for none.
        T_first_map: (M, 3) motion of each map into the fused frame; NaN for maps left out.
        motion_covariance: (M, 3, 3) of these; zero for the first, NaN for maps left out.
        drift_sigma_m: (M,) s_drift of each map as far as it was counted; NaN for maps left out.
        duplicate_share: share of the landmarks that another one still passes for, by the gate and
            descriptor test of the second pass.
        left_out: name of each map that has no part in it, with the reason.
        fallback: why it is by a simpler fuser than was asked for; empty if it is not.
        paths: (T_k, 3) the members' poses in the fused frame, in their order, by a fuser that finds
            them anew; else empty.
    """

    landmarks: LandmarkMap
    parents: np.ndarray
    T_first_map: Float
    motion_covariance: Float
    drift_sigma_m: Float
    duplicate_share: float
    left_out: tuple[tuple[str, str], ...]
    fallback: str = ""
    paths: tuple[Float, ...] = ()

    @property
    def members(self) -> np.ndarray:
        """Places of the maps in it; the first of them has the frame."""
        return np.flatnonzero(np.isfinite(self.T_first_map[:, 0]))


@dataclass(frozen=True)
class Fusion:
    """What a team's maps became.

    Attributes:
        fused: a map for each set of maps that alignments connect, that of the most maps first.
            Maps that nothing connects are none; if that is so of all, the first is there alone.
        place: of each pair, what the team's others say of its alignment.
    """

    fused: tuple[FusedMap, ...]
    place: tuple[Place, ...]
