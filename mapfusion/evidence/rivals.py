"""The best distinct motions that correspondences support, one after the other."""

from typing import NamedTuple

import numpy as np

from mapfusion.align.acceptance import Acceptance
from mapfusion.align.clique import Clique
from mapfusion.align.method import Undetermined
from mapfusion.align.pairs import MIN_PAIRS, Pairs
from mapfusion.align.refine import Refinement
from mapfusion.evidence.twins import twins
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float, transform_points

# Motions that move the landmarks less far apart, RMS, are one: twice what a right one may be off.
DISTINCT_M = 1.0
_LEAST_PAIRS = 6  # among fewer no motion is more than chance


class Supported(NamedTuple):
    """A motion, and what of the correspondences supports it.

    Attributes:
        T_a_b: (3,).
        log10_false_alarms: as the test against chance has it; infinite where it has no answer.
        inlier: (N,) bool, the pairs within the widest gate of the test.
    """

    T_a_b: Float
    log10_false_alarms: float
    inlier: np.ndarray


def apart_m(T_a_b: Float, other: Float, p_b: Float) -> float:
    """How far apart two motions (3,) move points (n, 2), RMS."""
    apart = transform_points(T_a_b, p_b) - transform_points(other, p_b)
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def distinct_motions(
    pairs: Pairs, most: int, acceptance: Acceptance, refinement: Refinement
) -> list[Supported]:
    """Up to `most` motions, that of the largest clique first, then that of what it leaves, ...

    Each is refined on all pairs, and held against chance with them.
    """
    found: list[Supported] = []
    chance, method = acceptance.on(pairs), Clique()
    p_a, p_b = pairs.p_a[:, :2], pairs.p_b[:, :2]
    rows, widest_m = np.arange(len(pairs)), max(acceptance.gates_m)
    tries = 2 * most  # what the refinement moves onto one found before is none
    while len(rows) >= _LEAST_PAIRS and len(found) < most and tries > 0:
        tries -= 1
        fit = method.find(pairs[rows], np.random.default_rng(0))  # which draws nothing
        if isinstance(fit, Undetermined) or np.count_nonzero(fit.inlier) < MIN_PAIRS:
            break
        refined = refinement.refine(pairs, fit.T_a_b)
        T = refined.T_a_b if np.isfinite(refined.T_a_b).all() else fit.T_a_b
        if not any(apart_m(T, each.T_a_b, p_b) < DISTINCT_M for each in found):
            log10 = chance.judge(refined).log10_false_alarms
            found.append(Supported(T, log10, _within(T, p_a, p_b, widest_m)))
        rows = rows[~(fit.inlier | _within(fit.T_a_b, p_a[rows], p_b[rows], widest_m))]
    return found


def self_motions(
    landmarks: LandmarkMap, most: int, acceptance: Acceptance, refinement: Refinement
) -> tuple[Pairs, list[Supported]]:
    """The twins of a map, and motions that lay parts of it on their like."""
    pairs = Pairs(landmarks, landmarks, twins(landmarks))
    back = np.searchsorted(pairs.index_a, pairs.index_b)  # rows ascend, and each pair is both ways
    found = []
    for each in distinct_motions(pairs, most, acceptance, refinement):
        # a motion that undoes itself brings both orders of a pair together: they are one
        again = each.inlier & each.inlier[back] & (pairs.index_a > pairs.index_b)
        once = pairs[~again]
        log10 = each.log10_false_alarms
        if again.any():
            refined = refinement.refine(once, each.T_a_b)
            log10 = acceptance.judge(once, refined).log10_false_alarms
        found.append(each._replace(log10_false_alarms=log10))
    return pairs, found


def _within(T_a_b: Float, p_a: Float, p_b: Float, gate_m: float) -> np.ndarray:
    return np.hypot(*(p_a - transform_points(T_a_b, p_b)).T) <= gate_m
