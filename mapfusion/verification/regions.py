"""Regions that both robots must have seen under a motion, and the landmarks matched in each."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np

from mapfusion.align.correspondences import HeightGate
from mapfusion.align.nearest_neighbours import Grid, ranges_within
from mapfusion.descriptors import euclidean_distance_at
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import inverse, rotation, transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Range, require_in_range
from mapfusion.verification.likelihood import (
    DECISIVE,
    Rates,
    TwinShares,
    log10_against_chance,
    log10_ratio,
    log10_without_discovery,
    rates_of_maps,
)
from mapfusion.verification.rivals import (
    BETWEEN,
    RepeatedLandmarks,
    count_neighbours,
    mark_repeated,
)
from mapfusion.verification.visibility import (
    MAY,
    MUST,
    SURE_FRAMES,
    UNSEEN,
    ObservedLandmarks,
    ViewingHistory,
    classify_visibility,
    wall_directions,
)


@dataclass(frozen=True)
class EvidenceParameters:
    """Gates for landmarks seen again, and thresholds of the verdict.

    Attributes:
        gate_m: largest distance between a landmark and its match in the other map. It covers the
            landmarks' covariances, the alignment's uncertainty and the drift of both maps.
        max_descriptor_distance: largest descriptor distance of a match; that of the observations of
            one landmark in the filter.
        region_m: smallest side of a region that counts as one piece of evidence, since neighbouring
            corners belong to one texture. It grows to the largest structure that the maps repeat.
        place_m: longest side of a place that may occur twice as a whole, such as a room. If most of
            the smaller map lies in such a place and agrees, its surroundings were not compared.
        least_ratio: smallest likelihood ratio of the regions, right motion over wrong motion, if
            maps repeat structure or another motion fits; multiplied by the number of motions that
            pass the test against chance. In other maps it is needed if a region contradicts, or for
            supporters within two regions, by the regions around them.
            At most one pair of maps in this number has a wrong motion that reaches it (Markov's and
            Boole's inequalities). By default this is at most 2 % of runs with 20 evaluated pairs of
            maps.
        most_against: inverse of the likelihood ratio below which an alignment is contradicted; at
            most one right motion in this number falls below it.
        max_sigma_m: largest standard deviation of the other map's landmarks under the alignment,
            RMS. Two standard deviations (95 %) are 0.5 m, the limit of a useful merged map.
        max_sigma_rad: largest standard deviation of the rotation; two standard deviations move a
            landmark at 5 m by 0.5 m.
    """

    gate_m: Annotated[float, Range(0.01, 10, "m")] = 0.3
    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.5
    region_m: Annotated[float, Range(0.1, 100, "m")] = 2.0
    place_m: Annotated[float, Range(0, 1000, "m")] = 6.0
    least_ratio: Annotated[float, Range(1, 1e12, "1")] = 1000.0
    most_against: Annotated[float, Range(1, 1e12, "1")] = 10.0
    max_sigma_m: Annotated[float, Range(1e-3, 1e6, "m")] = 0.25
    max_sigma_rad: Annotated[float, Range(1e-4, 10, "rad")] = 0.05

    def __post_init__(self) -> None:
        require_in_range(self)


_DESCRIPTOR_STEP = 8  # dimensions summed between two tests of the distance against its limit


class DescribedLandmarks(NamedTuple):
    """N landmarks with positions and descriptors, as arrays for kernels.

    Attributes:
        near: grid over the positions in the plane.
        z_m: heights, shape (N,).
        z_m2: variances of the heights, shape (N,).
        descriptor: descriptors, shape (N, D), float32.
    """

    near: Grid
    z_m: Float
    z_m2: Float
    descriptor: np.ndarray


class MatchGates(NamedTuple):
    """Largest differences between two landmarks that are the same point.

    Attributes:
        distance_m: distance in the plane.
        height_bound: squared difference of heights over its variance; infinite for planar maps.
        height_floor_m2: variance of a height difference beyond the landmarks' own variances.
        unlike: Euclidean distance of the descriptors' vectors.
    """

    distance_m: float
    height_bound: float
    height_floor_m2: float
    unlike: float


@kernel
def mark_matched(
    p: Float,
    rows: np.ndarray,
    landmarks: DescribedLandmarks,
    other: DescribedLandmarks,
    gates: MatchGates,
) -> np.ndarray:
    """Mark the landmarks of `landmarks` that have a match in `other`; return bool, shape (n,).

    Landmarks without a descriptor (NaN) have no match.

    Args:
        p: positions of all own landmarks in the frame of the other map, shape (N, 3).
        rows: own landmarks to search for, shape (n,).
        landmarks: own landmarks.
        other: landmarks of the other map.
        gates: largest differences of a match.
    """
    # unpacked once: each access through the tuple would count references
    _, z_own, z2_own, descriptor_own = landmarks
    grid, z_other, z2_other, descriptor_other = other
    at, row_of, distance_m = grid.p, grid.row, gates.distance_m
    is_matched = np.zeros(len(rows), np.bool_)
    runs = np.empty((grid.shape[1], 2), np.int64)
    height_bound, floor_m2, unlike2 = gates.height_bound, gates.height_floor_m2, gates.unlike**2
    for m in range(len(rows)):
        i = rows[m]
        for run in range(ranges_within(p[i, 0], p[i, 1], distance_m, grid, runs)):
            for k in range(runs[run, 0], runs[run, 1]):
                dx, dy = at[k, 0] - p[i, 0], at[k, 1] - p[i, 1]
                if dx * dx + dy * dy > distance_m * distance_m:
                    continue
                j = row_of[k]
                dz = z_own[i] - z_other[j]
                if height_bound < math.inf and dz * dz > height_bound * (
                    z2_own[i] + z2_other[j] + floor_m2
                ):
                    continue
                square = 0.0  # distance of the descriptors
                for first in range(0, descriptor_own.shape[1], _DESCRIPTOR_STEP):
                    for d in range(first, min(first + _DESCRIPTOR_STEP, descriptor_own.shape[1])):
                        square += (descriptor_own[i, d] - descriptor_other[j, d]) ** 2
                    if square > unlike2:
                        break
                if square <= unlike2:
                    is_matched[m] = True
                    break
            if is_matched[m]:
                break
    return is_matched


LEAST_EXPECTED = 5  # landmarks of a region; regions with fewer are not evaluated


@dataclass(frozen=True)
class Regions:
    """Counts of expected and matched landmarks in R regions.

    The second axis separates landmarks outside (OWN) and inside (COPIED) structure that another
    motion also explains; the third axis separates landmarks that the other robot must have seen
    and may have seen.

    Attributes:
        found: landmarks of either map that the other map contains, shape (R, 2, 2).
        expected: landmarks of either map that are searched for, shape (R, 2, 2).
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
        """Regions that support the motion and have no part that contradicts it, bool (R,)."""
        return (self._all >= DECISIVE) & (self._parts > -DECISIVE).all(axis=1)

    @property
    def n_confirmed(self) -> int:
        """Number of confirmed regions."""
        return int(np.sum(self.confirmed))

    @property
    def n_contradicted(self) -> int:
        """Number of regions that contradict the motion as a whole or in one part."""
        against = (self._all <= -DECISIVE) | (self._parts <= -DECISIVE).any(axis=1)
        return int(np.sum(against))

    @cached_property
    def rates(self) -> Rates:
        """Rates of landmarks seen again under the motion if it is right."""
        return rates_of_maps(self.found.sum(axis=1), self.expected.sum(axis=1))

    @cached_property
    def _parts(self) -> Float:
        return log10_against_chance(self.found, self.expected, self.rates)

    @cached_property
    def _all(self) -> Float:
        return self._parts.sum(axis=1)

    def beside_best(self, part: int) -> np.ndarray:
        """Return the regions with enough landmarks in a part (OWN or COPIED), bool (R,).

        The region with the best agreement is left out, because the motion was found from it.
        """
        enough = self.expected[:, part].sum(axis=1) >= LEAST_EXPECTED
        if len(self):
            enough[np.argmax(self._all)] = False
        return enough

    def count_confirmed(self, part: int) -> tuple[int, int]:
        """Return the number of confirmed and of all regions `beside_best` in a part."""
        enough = self.beside_best(part)
        return int(np.sum(self._parts[enough, part] >= DECISIVE)), int(np.sum(enough))

    def log10_ratio(self, shares: TwinShares) -> float:
        """Return the log10 likelihood ratio of all regions, right motion over wrong motion."""
        return float(np.sum(log10_ratio(self.found, self.expected, shares, self.rates)))

    def log10_evidence(self, shares: TwinShares) -> float:
        """Return the log10 likelihood ratio without the region that led to the motion.

        It is 0 without regions.
        """
        if shares not in self._evidence:  # used several times by a verdict
            ratios = log10_ratio(self.found, self.expected, shares, self.rates)
            self._evidence[shares] = log10_without_discovery(ratios)
        return self._evidence[shares]


class RegionGrid(NamedTuple):
    """Square regions of the plane.

    Attributes:
        side_m: side of a square.
        middle: centre of one square in frame a, shape (2,). It is the centre of the supporters of a
            motion, so that no edge divides them.
    """

    side_m: float
    middle: Float

    @classmethod
    def about(cls, p_a: Float, side_m: float) -> "RegionGrid":
        """Return the grid centred on supporters (n, 2 or 3), or on the origin without any."""
        if not len(p_a):
            return cls(side_m, np.zeros(2))
        return cls(side_m, (p_a[:, :2].min(axis=0) + p_a[:, :2].max(axis=0)) / 2)

    def of(self, p: Float) -> np.ndarray:
        """Return the number of the square of each point (n, 2), from 0, shape (n,)."""
        column, row = np.floor((p - self.middle).T / self.side_m + 0.5).astype(np.int64)
        width = int(np.ptp(row)) + 1 if len(row) else 1
        return np.unique(column * width + row, return_inverse=True)[1]


class _Expected(NamedTuple):
    """Landmarks of one map that the robot of the other map had in view, arrays (n,).

    Attributes:
        rows: rows of the map.
        how: visibility, MAY or MUST.
        found: True for landmarks with a match in the other map.
        copied: True for landmarks in structure that another motion also explains.
    """

    rows: np.ndarray
    how: np.ndarray
    found: np.ndarray
    copied: np.ndarray


class ViewedMap:
    """Map with descriptors and viewing evidence, prepared for queries of visibility and matches."""

    def __init__(self, landmarks: LandmarkMap) -> None:
        """Prepare a map that has viewing evidence and descriptors."""
        viewing, descriptor = landmarks.viewing, landmarks.descriptor
        assert viewing is not None
        assert descriptor is not None
        self.landmarks, self._viewing = landmarks, viewing
        self.history = ViewingHistory.of(viewing)
        position = np.ascontiguousarray(landmarks.position_m)
        z_m2 = landmarks.covariance_m2[:, 2, 2].copy()
        near = Grid.of(position[:, :2])
        self.described = DescribedLandmarks(
            near, position[:, 2].copy(), z_m2, np.ascontiguousarray(descriptor)
        )
        # results that depend on this map alone, by query: several pairs share a map
        self.cache: dict[tuple, Any] = {}

    @cached_property
    def n_near(self) -> np.ndarray:
        """Number of landmarks near each landmark, shape (N,)."""
        return count_neighbours(np.ones(len(self.landmarks), np.bool_), self.described.near)

    @cached_property
    def _walls(self) -> Float:
        return wall_directions(self.described.near)

    @cached_property
    def recognisable(self) -> np.ndarray:
        """Landmarks on a known wall that their own robot observed often, bool (N,).

        Others, such as landmarks on a ceiling, are often missed from a similar viewpoint, too.
        """
        return (self._viewing.n_views >= SURE_FRAMES) & self._walls.any(axis=1)

    def transformed(self, T: Float) -> Float:
        """Return the positions under a motion of the plane, shape (N, 3)."""
        p = self.landmarks.position_m.copy()
        p[:, :2] = transform_points(T, p[:, :2])
        return p

    def observed_from(self, T: Float) -> ObservedLandmarks:
        """Return the landmarks with their viewpoints in another frame, T from this frame to it."""
        viewing, p = self._viewing, self.transformed(T)
        angle = viewing.direction_rad + T[2]
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        distance = np.where(viewing.n_views > 0, viewing.distance_m, 0.0)
        return ObservedLandmarks(p, direction, distance, self._walls @ rotation(T[2]).T)


class ViewedMapPair:
    """Two maps prepared for queries about any motion between them."""

    def __init__(self, a: ViewedMap, b: ViewedMap, parameters: EvidenceParameters) -> None:
        self.a, self.b, self._parameters = a, b, parameters
        height = HeightGate()
        planar = a.landmarks.planar or b.landmarks.planar
        bound = np.inf if planar else height.bound
        kinds = a.landmarks.descriptor_kind, b.landmarks.descriptor_kind
        unlike = euclidean_distance_at(parameters.max_descriptor_distance, *kinds)
        self._gates = MatchGates(parameters.gate_m, bound, height.floor_m**2, unlike)
        # matches and visibility of all landmarks of a map (first key: True for map a) by motion
        self._found: dict[tuple[bool, bytes], np.ndarray] = {}
        self._how: dict[tuple[bool, bytes], np.ndarray] = {}

    @classmethod
    def beside_itself(
        cls, viewed_map: ViewedMap, parameters: EvidenceParameters
    ) -> "ViewedMapPair":
        """Return the pair of a map with itself, kept with the map for later queries."""
        key = cls, parameters
        if key not in viewed_map.cache:
            viewed_map.cache[key] = cls(viewed_map, viewed_map, parameters)
        return viewed_map.cache[key]

    @cached_property
    def _of(self) -> dict[str, "ViewedMapPair"]:
        """Pairs by the domain of a motion: both maps, or either map with itself."""
        a, b = (self.beside_itself(own, self._parameters) for own in (self.a, self.b))
        return {BETWEEN: self, "a": a, "b": b}

    def regions(
        self, side: str, T: Float, squares: RegionGrid, copies: RepeatedLandmarks
    ) -> Regions:
        """Count expected and matched landmarks under a motion, in square regions of frame a.

        Landmarks of both maps are counted in the same square.

        Args:
            side: domain of the motion: BETWEEN, "a" or "b".
            T: motion, shape (3,).
            squares: the regions.
            copies: landmarks in structure that another motion also explains.
        """
        if side != BETWEEN:
            copied = copies.in_a if side == "a" else copies.in_b
            return self._of[side].regions(BETWEEN, T, squares, RepeatedLandmarks(copied, copied))
        T_a_b = T
        of_b, b_in_a = self._expected(self.b, self.a, T_a_b, copies.in_b)
        of_a, _ = self._expected(self.a, self.b, inverse(T_a_b), copies.in_a)
        expected_both = _Expected(*map(np.concatenate, zip(of_b, of_a, strict=True)))
        position_m = np.concatenate([b_in_a[of_b.rows], self.a.landmarks.position_m[of_a.rows]])
        region = squares.of(position_m[:, :2])
        n = int(region.max(initial=-1)) + 1
        n_found, n_expected = np.zeros((n, 2, 2), np.int64), np.zeros((n, 2, 2), np.int64)
        at = (
            region,
            expected_both.copied.astype(np.int64),
            np.where(expected_both.how == MUST, 0, 1),
        )
        np.add.at(n_expected, at, 1)
        np.add.at(n_found, at, expected_both.found)
        large = n_expected.sum(axis=(1, 2)) >= LEAST_EXPECTED
        return Regions(n_found[large], n_expected[large])

    def copies(self, side: str, T: Float) -> RepeatedLandmarks:
        """Return the landmarks of both maps that a motion maps onto matching structure."""
        pair = self._of[side]
        in_a, in_b = pair._repeated(pair.a, pair.b, inverse(T)), pair._repeated(pair.b, pair.a, T)
        if side == BETWEEN:
            return RepeatedLandmarks(in_a, in_b)
        no_copies = RepeatedLandmarks.none(len(self.a.landmarks), len(self.b.landmarks))
        return no_copies._replace(**{f"in_{side}": in_a | in_b})

    def _repeated(self, viewed_map: ViewedMap, other: ViewedMap, T: Float) -> np.ndarray:
        key = viewed_map is self.a, T.tobytes()
        if key not in self._found:
            p = viewed_map.transformed(T)
            is_matched = mark_matched(
                p, np.arange(len(p)), viewed_map.described, other.described, self._gates
            )
            self._found[key] = is_matched
        return mark_repeated(self._found[key], viewed_map.n_near, viewed_map.described.near)

    def _expected(
        self, viewed_map: ViewedMap, other: ViewedMap, T: Float, copied: np.ndarray
    ) -> tuple[_Expected, Float]:
        """Return the landmarks of `viewed_map` that `other` is expected to contain.

        Also return all own positions in the frame of `other`; T (3,) maps into this frame.
        """
        key = viewed_map is self.a, T.tobytes()
        if key in self._how:
            p = viewed_map.transformed(T)
        else:
            seen = viewed_map.observed_from(T)
            how, p = classify_visibility(seen, other.history), seen.p
            how[(how == MUST) & ~viewed_map.recognisable] = MAY
            self._how[key] = how
        how, cached = self._how[key], self._found.get(key)
        rows = np.flatnonzero(how != UNSEEN)
        described = viewed_map.described, other.described
        is_matched = (
            mark_matched(p, rows, *described, self._gates) if cached is None else cached[rows]
        )
        return _Expected(rows, how[rows], is_matched, copied[rows]), p
