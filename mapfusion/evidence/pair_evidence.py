"""What is found once for two maps, whatever alignment is to be judged: rivals, and twins."""

import math
from dataclasses import dataclass

import numpy as np

from mapfusion.align.acceptance import Acceptance
from mapfusion.align.pairs import Pairs
from mapfusion.align.refine import Refinement
from mapfusion.evidence.copies import BETWEEN, Copies, of_others
from mapfusion.evidence.likelihood import COPIED, OWN, TwinShares
from mapfusion.evidence.parameters import EvidenceParameters
from mapfusion.evidence.regions import Regions, Squares, Witness, Witnesses
from mapfusion.evidence.rivals import Supported, distinct_motions, self_motions
from mapfusion.evidence.twins import largest_patch_m
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

N_RIVALS, N_SELF_MOTIONS = 4, 3  # the best tell how much alike the others are
_PATCH_REACH_M = 0.7  # between neighbouring corners of one picture
_LEAST_OF_PATCH = 5
# What is known of the shares of twins before any region is seen, as twins of so many regions: the
# likeliest beta distributions of both under wrong motions in worlds that fool (posters and alias,
# seeds 0 to 4), the region that led to a motion left out.
_TWINS_BEFORE = 0.44, 3.85
_COPIES_BEFORE = 1.14, 6.1


@dataclass(frozen=True)
class RivalMotion:
    """A motion that correspondences support.

    Attributes:
        of: BETWEEN, or the map ("a" or "b") that it lays onto itself.
        T_a_b: (3,).
        log10_false_alarms: of the test against chance.
        n_support: correspondences within its widest gate.
        n_confirmed: regions that are seen again.
        n_contradicted: regions that are not.
        n_regions: that must be seen.
        log10_evidence: of the regions, of a motion between the maps; NaN of one onto itself.
        copies: what it lays on its like.
    """

    of: str
    T_a_b: Float
    log10_false_alarms: float
    n_support: int
    n_confirmed: int
    n_contradicted: int
    n_regions: int
    log10_evidence: float
    copies: Copies


@dataclass(frozen=True)
class PairEvidence:
    """What two maps say about motions between them.

    Attributes:
        motions: the best of each kind, best first.
        shares: of what a wrong motion lays on its like.
        region_m: side of a region: at least as large as what repeats.
    """

    motions: tuple[RivalMotion, ...]
    shares: TwinShares
    region_m: float

    @classmethod
    def of_nothing(cls, parameters: EvidenceParameters) -> "PairEvidence":
        """Of two maps that no motion fits."""
        return cls((), _twin_shares([], []), parameters.region_m)

    @property
    def rivals(self) -> tuple[RivalMotion, ...]:
        """Those between the two maps."""
        return tuple(each for each in self.motions if each.of == BETWEEN)

    def n_motions(self, log10_false_alarms: float) -> int:
        """Motions between the maps by more than so many false alarms; at least one."""
        return max(1, sum(each.log10_false_alarms <= log10_false_alarms for each in self.rivals))

    def repeats(self, log10_false_alarms: float) -> bool:
        """Whether either map holds something twice, by more than so many false alarms."""
        onto_self = (each for each in self.motions if each.of != BETWEEN)
        return any(each.log10_false_alarms <= log10_false_alarms for each in onto_self)


def why_not_sought(map_a: LandmarkMap, map_b: LandmarkMap) -> str:
    """Why two maps hold no evidence to be sought; empty where they do."""
    for landmarks in (map_a, map_b):
        for what, held in (
            ("viewing evidence", landmarks.viewing),
            ("descriptors", landmarks.descriptor),
        ):
            if held is None:
                return f"map {landmarks.name} has no {what}"
    return ""


def find_evidence(
    pairs: Pairs,
    witnesses: Witnesses,
    acceptance: Acceptance,
    refinement: Refinement,
    parameters: EvidenceParameters,
) -> PairEvidence:
    """All of it, of two maps with viewing evidence and descriptors."""
    between = distinct_motions(pairs, N_RIVALS, acceptance, refinement)
    region_m, onto_self = parameters.region_m, []
    supporters = [pairs.p_a[each.inlier] for each in between]
    for side, own in zip("ab", (witnesses.a, witnesses.b), strict=True):
        alike, motions = _onto_itself(own, acceptance, refinement)
        onto_self += [(side, motion) for motion in motions]
        supporters += [alike.p_a[each.inlier] for each in motions]
        region_m = max(region_m, _largest_twin_m(alike, motions, acceptance))
    kinds = [*((BETWEEN, each) for each in between), *onto_self]
    laid = [witnesses.copies(of, each.T_a_b) for of, each in kinds]
    regions = [
        witnesses.regions(
            of, motion.T_a_b, Squares.about(supporters[k], region_m), of_others(laid, k)
        )
        for k, (of, motion) in enumerate(kinds)
    ]
    shares = _twin_shares(regions[: len(between)], regions[len(between) :])
    found = [
        _rival(of, each, r, r.log10_evidence(shares) if of == BETWEEN else math.nan, copies)
        for (of, each), r, copies in zip(kinds, regions, laid, strict=True)
    ]
    return PairEvidence(tuple(found), shares, region_m)


def _onto_itself(
    own: Witness, acceptance: Acceptance, refinement: Refinement
) -> tuple[Pairs, list[Supported]]:
    """The twins of a map and its motions onto itself, found once."""
    key = self_motions, acceptance, refinement
    if key not in own.kept:
        own.kept[key] = self_motions(own.landmarks, N_SELF_MOTIONS, acceptance, refinement)
    return own.kept[key]


def _largest_twin_m(alike: Pairs, motions: list[Supported], acceptance: Acceptance) -> float:
    """The largest thing that a map holds twice."""
    longest = 0.0
    for motion in motions:
        if motion.log10_false_alarms <= math.log10(acceptance.false_alarms):
            p = np.ascontiguousarray(alike.p_a[motion.inlier, :2])
            longest = max(longest, largest_patch_m(p, _PATCH_REACH_M, _LEAST_OF_PATCH))
    return longest


def _twin_shares(rivals: list[Regions], selves: list[Regions]) -> TwinShares:
    """Compute the shares of regions that wrong motions confirm, without the regions they came from.

    One of the motions between the maps may be right. The motion with the most confirmed minus
    contradicted regions is therefore left out. A motion of a map onto itself was searched for where
    the map holds a structure twice, and says nothing of other regions.
    """
    wrong = sorted(rivals, key=lambda r: r.n_contradicted - r.n_confirmed)[1:]
    own = [_TWINS_BEFORE, *(regions.seen_again(OWN) for regions in wrong)]
    copied = [_COPIES_BEFORE, *(regions.seen_again(COPIED) for regions in [*wrong, *selves])]
    shares = (np.sum(counts, axis=0) for counts in (own, copied))
    return TwinShares(*(float(confirmed / n) for confirmed, n in shares))


def _rival(
    of: str, motion: Supported, regions: Regions, log10_evidence: float, copies: Copies
) -> RivalMotion:
    counts = (regions.n_confirmed, regions.n_contradicted, len(regions))
    n_support = int(np.count_nonzero(motion.inlier))
    sure = motion.log10_false_alarms
    return RivalMotion(of, motion.T_a_b, sure, n_support, *counts, log10_evidence, copies)
