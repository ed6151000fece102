"""Rival motions, mirror images and other units, and structure that occurs more than once."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.align.alignment import MIN_PAIRS, Pairs, Undetermined
from mapfusion.align.clique import Clique
from mapfusion.align.correspondences import (
    UNITS_PER_M,
    Correspondences,
    HeightGate,
    MatchParameters,
    match,
    nearest_descriptors,
)
from mapfusion.align.geometric_matching import DISTINCT_M
from mapfusion.align.nearest_neighbours import Grid, ranges_within
from mapfusion.align.refinement import Refinement
from mapfusion.descriptors import euclidean_distance_at, relative_distance
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import rms_distance_m, transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Acceptance

# Radius of a landmark's neighbourhood: the width of a small poster, whose corners are repeated
# together.
_PLACE_M = 0.5
# A neighbourhood is repeated structure if at least this number and share of its landmarks have a
# match elsewhere. At this share a copy is about ten times likelier than chance (rates of
# `fitted_rates.py` for landmarks that may be seen: 7 of 20, 17 of 60).
_LEAST, _LEAST_SHARE = 5, 0.3


BETWEEN = "a b"  # domain of a motion between two maps; "a" or "b": of a map onto itself


class RepeatedLandmarks(NamedTuple):
    """Landmarks of two maps in structure that occurs more than once, bool (N_a,) and (N_b,)."""

    in_a: np.ndarray
    in_b: np.ndarray

    @classmethod
    def none(cls, n_a: int, n_b: int) -> "RepeatedLandmarks":
        """Return the value of maps without repeated structure."""
        return cls(np.zeros(n_a, np.bool_), np.zeros(n_b, np.bool_))

    def joined(self, others: Iterable["RepeatedLandmarks"]) -> "RepeatedLandmarks":
        """Return the union over several motions."""
        in_a, in_b = self.in_a.copy(), self.in_b.copy()
        for other in others:
            in_a |= other.in_a
            in_b |= other.in_b
        return RepeatedLandmarks(in_a, in_b)


def repeated_under_others(copies: Sequence[RepeatedLandmarks], index: int) -> RepeatedLandmarks:
    """Return the repeated landmarks under all motions except the motion `index`."""
    first = RepeatedLandmarks.none(len(copies[index].in_a), len(copies[index].in_b))
    return first.joined(each for k, each in enumerate(copies) if k != index)


@kernel
def count_neighbours(counted: np.ndarray, grid: Grid) -> np.ndarray:
    """Count the `counted` (N,) landmarks near each counted one, including itself; shape (N,)."""
    p, row_of = grid.p, grid.row
    n = np.zeros(len(counted), np.int64)
    runs = np.empty((grid.shape[1], 2), np.int64)
    for k in range(len(p)):
        if not counted[row_of[k]]:
            continue
        for run in range(ranges_within(p[k, 0], p[k, 1], _PLACE_M, grid, runs)):
            for m in range(runs[run, 0], runs[run, 1]):
                dx, dy = p[m, 0] - p[k, 0], p[m, 1] - p[k, 1]
                n[row_of[m]] += dx * dx + dy * dy <= _PLACE_M * _PLACE_M
    return n


def mark_repeated(is_matched: np.ndarray, n_near: np.ndarray, grid: Grid) -> np.ndarray:
    """Mark landmarks (N,) in neighbourhoods with enough landmarks that match elsewhere.

    `n_near` (N,) is the number of landmarks near each.
    """
    hits = count_neighbours(is_matched, grid)
    return (hits >= _LEAST) & (hits >= _LEAST_SHARE * n_near)


# Smallest distance of two similar landmarks: neighbouring corners share most of their descriptor
# windows, and one point may be in a map twice.
_ELSEWHERE_M = 1.0
_UNLIKE = 0.6  # largest descriptor distance, as for the correspondences of two maps


def similar_landmarks(landmarks: LandmarkMap) -> Correspondences:
    """Return pairs of landmarks of one map that are mutually nearest in descriptor, both ways.

    Landmarks closer than 1 m are not paired. A motion that many pairs support maps one part of the
    map onto a similar part. A map without descriptors has no pairs.
    """
    n = len(landmarks)
    if landmarks.descriptor is None or n < 2:
        return Correspondences(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    height = HeightGate()
    bound = math.inf if landmarks.planar else height.bound
    gates = bound, height.floor_m**2, _ELSEWHERE_M
    nearest, distance2, _ = nearest_descriptors(landmarks, landmarks, *gates)
    rows = np.arange(n)
    unlike = relative_distance(np.sqrt(np.maximum(distance2, 0.0)), landmarks.descriptor_kind)
    is_similar = (nearest >= 0) & (nearest[nearest] == rows) & (unlike <= _UNLIKE)
    return Correspondences(rows[is_similar], nearest[is_similar], unlike[is_similar])


@kernel
def longest_patch_side_m(p: Float, reach_m: float, min_landmarks: int) -> float:
    """Return the longest side of the bounding boxes of patches of points (n, 2), 0 without any.

    A patch is a connected component of at least `min_landmarks` points closer than `reach_m`.
    """
    n = len(p)
    patch, queue, longest = np.full(n, -1), np.empty(n, np.int64), 0.0
    for start in range(n):
        if patch[start] >= 0:
            continue
        head, tail = 0, 1
        queue[0], patch[start] = start, start
        low, high = p[start].copy(), p[start].copy()
        while head < tail:
            i = queue[head]
            head += 1
            for axis in range(2):
                low[axis], high[axis] = min(low[axis], p[i, axis]), max(high[axis], p[i, axis])
            for j in range(n):
                dx, dy = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1]
                if patch[j] < 0 and dx * dx + dy * dy < reach_m * reach_m:
                    patch[j] = start
                    queue[tail] = j
                    tail += 1
        if tail >= min_landmarks:
            longest = max(longest, high[0] - low[0], high[1] - low[1])
    return longest


_LEAST_PAIRS = 6  # no motion among fewer pairs passes the test against chance


class SupportedMotion(NamedTuple):
    """Motion and the correspondences that support it.

    Attributes:
        T_a_b: motion, shape (3,).
        log10_false_alarms: log10 of the number of false alarms; infinite if it is not defined.
        inlier: pairs within the widest gate of the test against chance, bool (N,).
    """

    T_a_b: Float
    log10_false_alarms: float
    inlier: np.ndarray


def distinct_motions(
    pairs: Pairs, max_motions: int, acceptance: Acceptance, refinement: Refinement
) -> list[SupportedMotion]:
    """Find up to `max_motions` motions, each by a clique among the pairs that remain.

    Each motion is refined on all pairs and tested against chance.
    """
    motions: list[SupportedMotion] = []
    chance, method = acceptance.on(pairs), Clique()
    p_a, p_b = pairs.p_a[:, :2], pairs.p_b[:, :2]
    rows, widest_m = np.arange(len(pairs)), max(acceptance.gates_m)
    tries = 2 * max_motions  # refinement may move a motion onto an earlier one
    while len(rows) >= _LEAST_PAIRS and len(motions) < max_motions and tries > 0:
        tries -= 1
        fit = method.find(pairs[rows], np.random.default_rng(0))  # the method is deterministic
        if isinstance(fit, Undetermined) or np.count_nonzero(fit.inlier) < MIN_PAIRS:
            break
        refined = refinement.refine(pairs, fit.T_a_b)
        T = refined.T_a_b if np.isfinite(refined.T_a_b).all() else fit.T_a_b
        if not any(rms_distance_m(T, each.T_a_b, p_b) < DISTINCT_M for each in motions):
            log10 = chance.verify(refined).log10_false_alarms
            motions.append(SupportedMotion(T, log10, _within(T, p_a, p_b, widest_m)))
        rows = rows[~(fit.inlier | _within(fit.T_a_b, p_a[rows], p_b[rows], widest_m))]
    return motions


def mirror_image_motion(
    pairs: Pairs, acceptance: Acceptance, refinement: Refinement, matching: MatchParameters
) -> tuple[SupportedMotion, Float] | None:
    """Return the best motion of the mirror image of map b onto map a, and its supporters.

    Pairs by geometry alone belong to a motion, so that the mirror image is matched again. The
    supporters are places in the plane of map b, shape (K, 2). Returns None if there is no motion.
    """
    flip = np.array([1.0, -1.0, 1.0])
    map_b = pairs.map_b
    image = LandmarkMap(
        map_b.position_m * flip,
        map_b.covariance_m2 * np.outer(flip, flip),
        map_b.count,
        map_b.source_observation,
        map_b.descriptor,
        map_b.label,
        map_b.planar,
        map_b.name,
        size_m=map_b.size_m,
        category=map_b.category,
        descriptor_kind=map_b.descriptor_kind,
    )
    correspondences = (
        match(pairs.map_a, image, matching) if pairs.by_geometry else pairs.correspondences
    )
    of_image = Pairs(pairs.map_a, image, correspondences)
    motions = distinct_motions(of_image, 1, acceptance, refinement)
    if not motions:
        return None
    return motions[0], (of_image.p_b[motions[0].inlier] * flip)[:, :2]


def fits_beyond_chance(
    pairs: Pairs, acceptance: Acceptance, refinement: Refinement, n_trials: int = 1
) -> bool:
    """Return True if a motion has more support than chance gives in any of `n_trials`."""
    bound = math.log10(acceptance.false_alarms / n_trials)
    motions = distinct_motions(pairs, 1, acceptance, refinement)
    return any(each.log10_false_alarms <= bound for each in motions)


def is_mirrored(
    pairs: Pairs, acceptance: Acceptance, refinement: Refinement, matching: MatchParameters
) -> bool:
    """Return True if the mirror image of map b fits map a beyond chance, and map b does not.

    Maps are mirror images of each other if one of them has y to the right.
    """
    bound = math.log10(acceptance.false_alarms)
    motion = mirror_image_motion(pairs, acceptance, refinement, matching)
    if motion is None or not motion[0].log10_false_alarms <= bound:
        return False
    return not fits_beyond_chance(pairs, acceptance, refinement)


# Ratio of the extents of two maps in one unit that partial overlap may explain.
_SIMILAR_EXTENT = 10.0


def other_unit(
    pairs: Pairs, acceptance: Acceptance, refinement: Refinement, matching: MatchParameters
) -> tuple[str, tuple[bool, bool]]:
    """Return the unit in which two maps fit each other, and which of both maps are in it.

    Two maps in millimetres differ by many times the gates of metres, and one map in millimetres has
    no distances of the other. With the right units they fit beyond chance. The unit is empty if
    there is none.
    """
    maps = pairs.map_a, pairs.map_b
    if not all(map(len, maps)):
        return "", (False, False)
    extents_m = [float(np.ptp(each.position_m[:, :2], axis=0).max()) for each in maps]
    trials = []
    for unit, per_m in UNITS_PER_M.items():
        size_m = 1 / per_m
        for in_unit in ((True, True), (True, False), (False, True)):
            own_m = np.where(in_unit, size_m, 1.0) * extents_m
            if own_m.min() > 1 and own_m.max() < _SIMILAR_EXTENT * own_m.min():
                trials.append((unit, size_m, in_unit))
    if fits_beyond_chance(pairs, acceptance, refinement):
        return "", (False, False)
    for unit, size_m, in_unit in trials:
        a, b = (
            replace(
                each,
                position_m=each.position_m * size_m,
                covariance_m2=each.covariance_m2 * size_m**2,
                joint=None,
                viewing=None,
            )
            if scaled
            else each
            for each, scaled in zip(maps, in_unit, strict=True)
        )
        in_metres = Pairs(a, b, match(a, b, matching))
        if fits_beyond_chance(in_metres, acceptance, refinement, len(trials)):
            return unit, in_unit
    return "", (False, False)


def self_motions(
    landmarks: LandmarkMap, max_motions: int, acceptance: Acceptance, refinement: Refinement
) -> tuple[Pairs, list[SupportedMotion]]:
    """Return the similar landmarks of a map and the motions that map parts onto similar parts."""
    pairs = Pairs(landmarks, landmarks, similar_landmarks(landmarks))
    reverse_row = np.searchsorted(
        pairs.index_a, pairs.index_b
    )  # rows ascend, and each pair is both ways
    motions = []
    for each in distinct_motions(pairs, max_motions, acceptance, refinement):
        # under a motion that is its own inverse both orders of a pair agree: count one of them
        is_second = each.inlier & each.inlier[reverse_row] & (pairs.index_a > pairs.index_b)
        remaining_pairs = pairs[~is_second]
        log10 = each.log10_false_alarms
        if is_second.any():
            refined = refinement.refine(remaining_pairs, each.T_a_b)
            log10 = acceptance.verify(remaining_pairs, refined).log10_false_alarms
        motions.append(each._replace(log10_false_alarms=log10))
    return pairs, motions


def explained_landmarks(
    map_a: LandmarkMap, map_b: LandmarkMap, T_a_b: Float, gate_m: float
) -> np.ndarray:
    """Return, shape (N_b,), True for landmarks of map b that a motion lays on similar ones of a.

    Landmarks are similar if their descriptors are. Without descriptors all landmarks are similar.

    Args:
        map_a: the reference map, without labels.
        map_b: the other map.
        T_a_b: motion, shape (3,).
        gate_m: largest distance in the plane.
    """
    moved = transform_points(T_a_b, map_b.position_m[:, :2])
    close_pairs = scipy.spatial.KDTree(map_a.position_m[:, :2]).sparse_distance_matrix(
        scipy.spatial.KDTree(moved), gate_m, output_type="ndarray"
    )
    row_a, row_b = close_pairs["i"], close_pairs["j"]
    if map_a.descriptor is not None and map_b.descriptor is not None:
        descriptor_difference = map_a.descriptor[row_a] - map_b.descriptor[row_b]
        unlike = euclidean_distance_at(_UNLIKE, map_a.descriptor_kind, map_b.descriptor_kind)
        row_b = row_b[np.linalg.norm(descriptor_difference, axis=1) <= unlike]
    explained = np.zeros(len(map_b), np.bool_)
    explained[row_b] = True
    return explained


def _within(T_a_b: Float, p_a: Float, p_b: Float, gate_m: float) -> np.ndarray:
    return np.hypot(*(p_a - transform_points(T_a_b, p_b)).T) <= gate_m
