"""What a fuser is given: maps that believed alignments connect."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.align.correspondences import Correspondences
from mapfusion.fused_map import AlignedPair
from mapfusion.landmark_map import LandmarkMap
from mapfusion.name_order import name_order
from mapfusion.se2 import Float
from mapfusion.smoother.recording import Recording


@dataclass(frozen=True)
class Component:
    """Some of a team's M maps, placed; at least one.

    Attributes:
        maps: all M of them.
        members: (K,) places of those that are fused; the first has the frame.
        pairs: the alignments that are believed, each of two members.
        T_first_map: (M, 3) motion of each member into the fused frame; NaN for the others.
        motion_covariance: (M, 3, 3) of these.
        left_out: name of each other map, with the reason.
        recordings: what each of the M maps was smoothed from; empty or None where it is not known.
    """

    maps: tuple[LandmarkMap, ...]
    members: np.ndarray
    pairs: tuple[AlignedPair, ...]
    T_first_map: Float
    motion_covariance: Float
    left_out: tuple[tuple[str, str], ...]
    recordings: tuple[Recording | None, ...] = ()

    @property
    def by_name(self) -> list[int]:
        """The members in the order of their names, which does not depend on who has the frame."""
        return sorted(self.members.tolist(), key=lambda k: name_order(self.maps[k].name))

    @property
    def planar(self) -> bool:
        """Whether heights carry no information."""
        return any(self.maps[k].planar for k in self.members)

    @property
    def drift_sigma_m(self) -> Float:
        """s_drift (M,) of each map: the root of the mean of its halves; NaN for those left out.

        An alignment's s_drift^2 belongs to two maps and is given half to each.
        """
        drift = np.full(len(self.maps), np.nan)
        for k in self.members:
            own = [p.alignment.drift_sigma_m for p in self.pairs if k in (p.a, p.b)]
            drift[k] = np.sqrt(np.mean(np.square(own)) / 2) if own else 0.0
        return drift

    def on(self, maps: Sequence[LandmarkMap]) -> "Component":
        """The same with other maps of the same robots, whose landmarks came from the same places.

        Of the alignments' pairs those stay whose landmarks are in both.
        """
        row_of = [_rows(old, new) for old, new in zip(self.maps, maps, strict=True)]
        pairs = [_with_rows(pair, row_of[pair.a], row_of[pair.b]) for pair in self.pairs]
        return replace(self, maps=tuple(maps), pairs=tuple(pairs))


_NONE = -1


def _rows(old: LandmarkMap, new: LandmarkMap) -> np.ndarray:
    """(N,) row in the new map of each landmark of the old one."""
    place = {int(source): row for row, source in enumerate(new.source_observation)}
    return np.array([place.get(int(s), _NONE) for s in old.source_observation], dtype=np.int64)


def _with_rows(pair: AlignedPair, row_of_a: np.ndarray, row_of_b: np.ndarray) -> AlignedPair:
    known = pair.inliers
    index_a, index_b = row_of_a[known.index_a], row_of_b[known.index_b]
    kept = (index_a != _NONE) & (index_b != _NONE)
    offered = Correspondences(index_a[kept], index_b[kept], known.distance[kept])
    inlier = np.ones(len(offered), dtype=bool)
    return replace(pair, alignment=replace(pair.alignment, inlier=inlier), correspondences=offered)
