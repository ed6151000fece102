"""Input and result of a merge: aligned maps, parameters, the fused map."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Annotated, Any

import numpy as np

from mapfusion.align.alignment import Alignment
from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.fusion.aligned_landmarks import AssociationTest
from mapfusion.fusion.team_graph import EdgeStatus, TeamParameters
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Probability, Range, require_in_range
from mapfusion.smoother.joint_smoothing import AssociatedLog


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
    place: tuple[EdgeStatus, ...]


_DIGITS = re.compile("([0-9]+)")


def name_order(name: str) -> tuple[list[Any], str]:
    """A sorting key of names, in which R2 stands before R10."""
    parts = _DIGITS.split(name)  # words and numbers in turn, a word first
    numbers = [(len(digits), digits) for digits in (part.lstrip("0") for part in parts[1::2])]
    return [
        key for both in zip_longest(parts[::2], numbers) for key in both if key is not None
    ], name


@dataclass(frozen=True)
class MergeParameters:
    """How maps are merged.

    Attributes:
        team: which alignments of more than two maps are believed.
        max_descriptor_distance: of landmarks that are taken for one point though no alignment names
            them; with labels on both sides these decide instead.
        gate_probability: of keeping two landmarks of one point there (chi-square, 2 degrees of
            freedom, drift included; in joint fusion of the Student-t that is fitted).
        height: which landmarks can have one height (not for planar maps and joint covariances).
        use_alignment_uncertainty: add J S_T J^T, the covariance of the map's place to first order,
            to the landmarks that the Kalman fusers move. The paper does not. This error is common
            to all of them, which per-landmark covariances cannot say; and as it is told from the
            first map, the order of the maps then weighs their landmarks.
    """

    team: TeamParameters = field(default_factory=TeamParameters)
    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.3
    gate_probability: Probability = 0.99
    height: HeightGate = field(default_factory=HeightGate)
    use_alignment_uncertainty: bool = False

    def __post_init__(self) -> None:
        require_in_range(self)

    def association_test(self, planar: bool) -> AssociationTest:
        """The test for landmarks that no alignment names."""
        return AssociationTest(
            self.max_descriptor_distance, self.gate_probability, self.height, planar
        )


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
    recordings: tuple[AssociatedLog | None, ...] = ()

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
