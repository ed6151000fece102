"""Regions that two maps must share under a motion, and how much of each is in both."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mapfusion.align.correspondences import HeightGate
from mapfusion.align.nearest_neighbours import Grid, ranges_within
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import inverse, transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.likelihood import (
    DECISIVE,
    TwinShares,
    log10_against_chance,
    log10_ratio,
    log10_without_discovery,
)
from mapfusion.verification.parameters import EvidenceParameters
from mapfusion.verification.rivals import (
    BETWEEN,
    RepeatedLandmarks,
    count_neighbours,
    mark_repeated,
)
from mapfusion.verification.visibility import (
    MUST,
    UNSEEN,
    ObservedLandmarks,
    ViewingHistory,
    classify_visibility,
)

# Of a descriptor's dimensions, those after which it is asked whether the distance is too large yet.
_AT_A_TIME = 8


class DescribedLandmarks(NamedTuple):
    """N landmarks by place and look, for the kernel.

    Attributes:
        near: the grid over their places in the plane.
        z_m: (N,) heights.
        z_m2: (N,) their variances.
        descriptor: (N, D) float32.
    """

    near: Grid
    z_m: Float
    z_m2: Float
    descriptor: np.ndarray


class MatchGates(NamedTuple):
    """How far off what is the same may be.

    Attributes:
        distance_m: in the plane.
        height_bound: of the squared difference of heights, over its variance; infinite where
            heights tell nothing.
        height_floor_m2: of that variance, what landmarks' own leave out.
        unlike: of descriptors.
    """

    distance_m: float
    height_bound: float
    height_floor_m2: float
    unlike: float


@kernel
def mark_matched(
    p: Float,
    rows: np.ndarray,
    own: DescribedLandmarks,
    other: DescribedLandmarks,
    gates: MatchGates,
) -> np.ndarray:
    """Bool (n,): whether `other` has some `rows` (n,) of `own`, whose places are p (N, 3) there.

    What has no descriptor (NaN) is not found.
    """
    # arrays by themselves: taken from a tuple, each access would count its references
    _, z_own, z2_own, look_own = own
    near, z_other, z2_other, look_other = other
    at, row_of, distance_m = near.p, near.row, gates.distance_m
    found = np.zeros(len(rows), np.bool_)
    runs = np.empty((near.shape[1], 2), np.int64)
    most, floor_m2, unlike2 = gates.height_bound, gates.height_floor_m2, gates.unlike**2
    for m in range(len(rows)):
        i = rows[m]
        for run in range(ranges_within(p[i, 0], p[i, 1], distance_m, near, runs)):
            for k in range(runs[run, 0], runs[run, 1]):
                dx, dy = at[k, 0] - p[i, 0], at[k, 1] - p[i, 1]
                if dx * dx + dy * dy > distance_m * distance_m:
                    continue
                j = row_of[k]
                dz = z_own[i] - z_other[j]
                if most < math.inf and dz * dz > most * (z2_own[i] + z2_other[j] + floor_m2):
                    continue
                if _alike(look_own, i, look_other, j, unlike2):
                    found[m] = True
                    break
            if found[m]:
                break
    return found


@kernel
def _alike(own: np.ndarray, i: int, other: np.ndarray, j: int, most: float) -> bool:
    """Whether descriptors i and j of (N, D) are no more than so much apart, squared."""
    square = 0.0
    for first in range(0, own.shape[1], _AT_A_TIME):
        for d in range(first, min(first + _AT_A_TIME, own.shape[1])):
            square += (own[i, d] - other[j, d]) ** 2
        if square > most:
            return False
    return square <= most


LEAST_EXPECTED = 5  # landmarks of a region; fewer say little, and mostly lie on its edge


@dataclass(frozen=True)
class Regions:
    """What became of what must be seen, region by region.

    Attributes:
        found: (R, 2, 2) landmarks that the other map has: in places that may be copies or not
            (OWN, COPIED), of those that it must have and that it may have.
        expected: (R, 2, 2) landmarks that are looked for, those of both maps.
    """

    found: np.ndarray
    expected: np.ndarray
    _evidence: dict[TwinShares, float] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __len__(self) -> int:
        return len(self.found)

    @cached_property
    def confirmed(self) -> np.ndarray:
        """Bool (R,): what is found there speaks for the motion, and nothing of it against."""
        return (self._all >= DECISIVE) & (self._parts > -DECISIVE).all(axis=1)

    @property
    def n_confirmed(self) -> int:
        """Regions of which most is there."""
        return int(np.sum(self.confirmed))

    @property
    def n_contradicted(self) -> int:
        """Regions of which hardly anything is there, or nothing but what may be a copy."""
        against = (self._all <= -DECISIVE) | (self._parts <= -DECISIVE).any(axis=1)
        return int(np.sum(against))

    @cached_property
    def _parts(self) -> Float:
        return log10_against_chance(self.found, self.expected)

    @cached_property
    def _all(self) -> Float:
        return self._parts.sum(axis=1)

    def beside_best(self, part: int) -> np.ndarray:
        """Bool (R,): regions with enough of a part (OWN, COPIED), but for that which agrees best.

        By that one a motion was found.
        """
        enough = self.expected[:, part].sum(axis=1) >= LEAST_EXPECTED
        if len(self):
            enough[np.argmax(self._all)] = False
        return enough

    def seen_again(self, part: int) -> tuple[int, int]:
        """Of a part (OWN, COPIED) of regions `beside_best`, the confirmed, and all."""
        enough = self.beside_best(part)
        return int(np.sum(self._parts[enough, part] >= DECISIVE)), int(np.sum(enough))

    def log10_ratio(self, shares: TwinShares) -> float:
        """log10 of how much likelier all of them are if right than if wrong; 0 of none."""
        return float(np.sum(log10_ratio(self.found, self.expected, shares)))

    def log10_evidence(self, shares: TwinShares) -> float:
        """The same, if wrong then found by one of them, which is no evidence; 0 of none."""
        if shares not in self._evidence:  # a verdict rests on it in several places
            ratios = log10_ratio(self.found, self.expected, shares)
            self._evidence[shares] = log10_without_discovery(ratios)
        return self._evidence[shares]


class RegionGrid(NamedTuple):
    """The squares of the plane that are one region each.

    Attributes:
        side_m: of a square.
        middle: (2,) of one of them, in frame a: where what supports a motion has its middle, so
            that one picture is one region and not the two or four that a line through it makes.
    """

    side_m: float
    middle: Float

    @classmethod
    def about(cls, p_a: Float, side_m: float) -> "RegionGrid":
        """About the middle of supporters (n, 2 or 3); about the origin without any."""
        if not len(p_a):
            return cls(side_m, np.zeros(2))
        return cls(side_m, (p_a[:, :2].min(axis=0) + p_a[:, :2].max(axis=0)) / 2)

    def of(self, p: Float) -> np.ndarray:
        """Number (n,) of the square in which each point (n, 2) lies, from 0 on."""
        column, row = np.floor((p - self.middle).T / self.side_m + 0.5).astype(np.int64)
        width = int(np.ptp(row)) + 1 if len(row) else 1
        return np.unique(column * width + row, return_inverse=True)[1]


class _Expected(NamedTuple):
    """Landmarks that another robot had in view (n,).

    Attributes:
        rows: of the map.
        how: MAY or MUST.
        found: whether the other map has them.
        copied: whether another motion lays their place on its like.
    """

    rows: np.ndarray
    how: np.ndarray
    found: np.ndarray
    copied: np.ndarray


class ViewedMap:
    """A map with viewing evidence, made ready to be asked what it must have seen."""

    def __init__(self, landmarks: LandmarkMap) -> None:
        """Of a map that has viewing evidence and descriptors."""
        viewing, descriptor = landmarks.viewing, landmarks.descriptor
        assert viewing is not None
        assert descriptor is not None
        self.landmarks, self._viewing = landmarks, viewing
        self.watch = ViewingHistory.of(viewing)
        position = np.ascontiguousarray(landmarks.position_m)
        z_m2 = landmarks.covariance_m2[:, 2, 2].copy()
        near = Grid.of(position[:, :2])
        self.looks = DescribedLandmarks(
            near, position[:, 2].copy(), z_m2, np.ascontiguousarray(descriptor)
        )
        # what was found of this map alone, by what was asked: several pairs have the same map
        self.kept: dict[tuple, Any] = {}

    @cached_property
    def crowd(self) -> np.ndarray:
        """(N,) landmarks about each."""
        return count_neighbours(np.ones(len(self.landmarks), np.bool_), self.looks.near)

    def laid_by(self, T: Float) -> Float:
        """Its landmarks (N, 3) where a motion of the plane lays them."""
        p = self.landmarks.position_m.copy()
        p[:, :2] = transform_points(T, p[:, :2])
        return p

    def seen_from(self, T: Float) -> ObservedLandmarks:
        """Its landmarks as another robot would find them, T from its frame to that one's."""
        viewing, p = self._viewing, self.laid_by(T)
        angle = viewing.direction_rad + T[2]
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        distance = np.where(viewing.n_views > 0, viewing.distance_m, 0.0)
        return ObservedLandmarks(p, direction, distance)


class ViewedMapPair:
    """Two maps that may be asked about any motion between them."""

    def __init__(self, a: ViewedMap, b: ViewedMap, parameters: EvidenceParameters) -> None:
        self.a, self.b, self._parameters = a, b, parameters
        height = HeightGate()
        planar = a.landmarks.planar or b.landmarks.planar
        bound = np.inf if planar else height.bound
        unlike = parameters.max_descriptor_distance
        self._gates = MatchGates(parameters.gate_m, bound, height.floor_m**2, unlike)
        # which of a's or b's landmarks (N,) the other has under a motion: copies ask for all, and
        # regions, after them, for some of the same; and how the other saw them
        self._found: dict[tuple[bool, bytes], np.ndarray] = {}
        self._how: dict[tuple[bool, bytes], np.ndarray] = {}

    @classmethod
    def beside_itself(cls, own: ViewedMap, parameters: EvidenceParameters) -> "ViewedMapPair":
        """A map that may be asked about motions onto itself, with what it was asked before."""
        key = cls, parameters
        if key not in own.kept:
            own.kept[key] = cls(own, own, parameters)
        return own.kept[key]

    @cached_property
    def _of(self) -> dict[str, "ViewedMapPair"]:
        """These, and each map beside itself, by what motions are of."""
        a, b = (self.beside_itself(own, self._parameters) for own in (self.a, self.b))
        return {BETWEEN: self, "a": a, "b": b}

    def regions(self, of: str, T: Float, squares: RegionGrid, copies: RepeatedLandmarks) -> Regions:
        """What must have been seen under a motion, and is there, in squares of frame a.

        Of two maps both ways are counted into one square: they are of one part of the world. What
        lies in `copies` is counted apart.
        """
        if of != BETWEEN:
            own = copies.in_a if of == "a" else copies.in_b
            return self._of[of].regions(BETWEEN, T, squares, RepeatedLandmarks(own, own))
        T_a_b = T
        asked_b, b_in_a = self._asked(self.b, self.a, T_a_b, copies.in_b)
        asked_a, _ = self._asked(self.a, self.b, inverse(T_a_b), copies.in_a)
        asked = _Expected(*map(np.concatenate, zip(asked_b, asked_a, strict=True)))
        places = np.concatenate([b_in_a[asked_b.rows], self.a.landmarks.position_m[asked_a.rows]])
        place = squares.of(places[:, :2])
        n = int(place.max(initial=-1)) + 1
        found, expected = np.zeros((n, 2, 2), np.int64), np.zeros((n, 2, 2), np.int64)
        at = place, asked.copied.astype(np.int64), np.where(asked.how == MUST, 0, 1)
        np.add.at(expected, at, 1)
        np.add.at(found, at, asked.found)
        counts = expected.sum(axis=(1, 2)) >= LEAST_EXPECTED
        return Regions(found[counts], expected[counts])

    def copies(self, of: str, T: Float) -> RepeatedLandmarks:
        """Landmarks of both maps that a motion lays on their like."""
        two = self._of[of]
        in_a, in_b = two._laid(two.a, two.b, inverse(T)), two._laid(two.b, two.a, T)
        if of == BETWEEN:
            return RepeatedLandmarks(in_a, in_b)
        none = RepeatedLandmarks.none(len(self.a.landmarks), len(self.b.landmarks))
        return none._replace(**{f"in_{of}": in_a | in_b})

    def _laid(self, own: ViewedMap, other: ViewedMap, T: Float) -> np.ndarray:
        key = own is self.a, T.tobytes()
        if key not in self._found:
            p = own.laid_by(T)
            found = mark_matched(p, np.arange(len(p)), own.looks, other.looks, self._gates)
            self._found[key] = found
        return mark_repeated(self._found[key], own.crowd, own.looks.near)

    def _asked(
        self, own: ViewedMap, other: ViewedMap, T: Float, copied: np.ndarray
    ) -> tuple[_Expected, Float]:
        """What `other` has of `own`, and all of own's landmarks in its frame.

        T (3,) maps own's frame into that of the other.
        """
        key = own is self.a, T.tobytes()
        if key in self._how:
            p = own.laid_by(T)
        else:
            seen = own.seen_from(T)
            self._how[key], p = classify_visibility(seen, other.watch), seen.p
        how, known = self._how[key], self._found.get(key)
        rows = np.flatnonzero(how != UNSEEN)
        looks = own.looks, other.looks
        found = mark_matched(p, rows, *looks, self._gates) if known is None else known[rows]
        return _Expected(rows, how[rows], found, copied[rows]), p
