"""Verdict on an alignment: accepted, refused, ambiguous or uncertain, with the reason."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mapfusion.align.alignment import Alignment, Pairs, Status
from mapfusion.align.drift import whole_map_covariance
from mapfusion.align.refinement import Refinement
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Acceptance, Verdict
from mapfusion.verification.likelihood import (
    COPIED,
    OWN,
    EvidenceFeatures,
    TwinShares,
    probability_correct,
)
from mapfusion.verification.parameters import EvidenceParameters
from mapfusion.verification.regions import RegionGrid, Regions, ViewedMap, ViewedMapPair
from mapfusion.verification.rivals import (
    BETWEEN,
    DISTINCT_M,
    RepeatedLandmarks,
    SupportedMotion,
    distinct_motions,
    longest_patch_side_m,
    repeated_under_others,
    rms_distance_m,
    self_motions,
)


def landmark_sigma_m(T_a_b: Float, covariance: Float, p_b: Float) -> float:
    """By how far the landmarks of map b lie off for the alignment's sake, RMS, in metres.

    To first order: the mean over the landmarks of tr(J S J') with J = d(T p_b)/dT. What supports an
    alignment lies in one part of the map; what the angle leaves open there grows with the distance.

    Args:
        T_a_b: (3,).
        covariance: (3, 3) of it.
        p_b: (N, 2) positions in metres.
    """
    x, y = (transform_points(T_a_b, p_b) - T_a_b[:2]).T
    moved_by_angle = x**2 + y**2
    with_shift = x * covariance[1, 2] - y * covariance[0, 2]
    squares = covariance[0, 0] + covariance[1, 1] + 2 * with_shift
    return float(np.sqrt(np.mean(squares + moved_by_angle * covariance[2, 2])))


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
    copies: RepeatedLandmarks


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
    witnesses: ViewedMapPair,
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
            of,
            motion.T_a_b,
            RegionGrid.about(supporters[k], region_m),
            repeated_under_others(laid, k),
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
    own: ViewedMap, acceptance: Acceptance, refinement: Refinement
) -> tuple[Pairs, list[SupportedMotion]]:
    """The twins of a map and its motions onto itself, found once."""
    key = self_motions, acceptance, refinement
    if key not in own.kept:
        own.kept[key] = self_motions(own.landmarks, N_SELF_MOTIONS, acceptance, refinement)
    return own.kept[key]


def _largest_twin_m(alike: Pairs, motions: list[SupportedMotion], acceptance: Acceptance) -> float:
    """The largest thing that a map holds twice."""
    longest = 0.0
    for motion in motions:
        if motion.log10_false_alarms <= math.log10(acceptance.false_alarms):
            p = np.ascontiguousarray(alike.p_a[motion.inlier, :2])
            longest = max(longest, longest_patch_side_m(p, _PATCH_REACH_M, _LEAST_OF_PATCH))
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
    of: str,
    motion: SupportedMotion,
    regions: Regions,
    log10_evidence: float,
    copies: RepeatedLandmarks,
) -> RivalMotion:
    counts = (regions.n_confirmed, regions.n_contradicted, len(regions))
    n_support = int(np.count_nonzero(motion.inlier))
    sure = motion.log10_false_alarms
    return RivalMotion(of, motion.T_a_b, sure, n_support, *counts, log10_evidence, copies)


@dataclass(frozen=True)
class Judge:
    """All that is asked before an alignment may be used, the same for every estimator.

    First chance (`Acceptance`). Then what both robots looked at: regions of one map that the other
    must have seen and has not contradict an alignment, those that it has confirm it. Maps that hold
    things twice, or that fit in several ways, need evidence; others need only not be contradicted.
    Then how sure it is. Of maps with labels identities say all of that.

    Attributes:
        acceptance: the test against chance.
        evidence: how much evidence is needed, and how sure an alignment has to be.
        refinement: what rivals are refined by, as alignments are.
    """

    acceptance: Acceptance = field(default_factory=Acceptance)
    evidence: EvidenceParameters = field(default_factory=EvidenceParameters)
    refinement: Refinement = field(default_factory=Refinement)

    def on(
        self,
        pairs: Pairs,
        known: PairEvidence | None = None,
        witnesses: tuple[ViewedMap, ViewedMap] | None = None,
    ) -> "PairJudge":
        """Made ready for any number of alignments of two maps.

        Args:
            pairs: their correspondences.
            known: what was found for them before; sought where it is needed if None.
            witnesses: both maps made ready, and perhaps asked about other pairs before; they are
                made ready where it is needed if None.
        """
        return PairJudge(self, pairs, known, witnesses)


class PairJudge:
    """A `Judge` on two maps."""

    def __init__(
        self,
        judge: Judge,
        pairs: Pairs,
        known: PairEvidence | None,
        witnesses: tuple[ViewedMap, ViewedMap] | None,
    ) -> None:
        self._judge, self._pairs, self._known, self._ready = judge, pairs, known, witnesses
        self._chance = judge.acceptance.on(pairs)
        self._bound = math.log10(judge.acceptance.false_alarms)

    @cached_property
    def _witnesses(self) -> ViewedMapPair:
        a, b = self._ready or (ViewedMap(self._pairs.map_a), ViewedMap(self._pairs.map_b))
        return ViewedMapPair(a, b, self._judge.evidence)

    @cached_property
    def evidence(self) -> PairEvidence | None:
        """What the maps say about motions between them; None where it cannot be sought."""
        if self._pairs.by_name or why_not_sought(self._pairs.map_a, self._pairs.map_b):
            return None
        if self._known is not None:
            return self._known
        judge = self._judge
        settings = (judge.acceptance, judge.refinement, judge.evidence)
        return find_evidence(self._pairs, self._witnesses, *settings)

    def judge(self, alignment: Alignment) -> Verdict:
        """The verdict on one alignment of the correspondences."""
        by_chance = self._chance.judge(alignment)
        if not by_chance.accepted:
            return by_chance
        status, reason, told = Status.ACCEPTED, "", {}
        evidence = self.evidence
        if evidence is not None:
            regions = self.regions(alignment, evidence)
            found = regions.log10_evidence(evidence.shares)
            told = {"log10_evidence": found, "n_confirmed": regions.n_confirmed}
            signs = self._signs(alignment, regions, evidence, by_chance.log10_false_alarms)
            p = probability_correct(signs)
            told |= {"n_contradicted": regions.n_contradicted, "probability": p}
            status, reason = self._weighed(alignment, regions, evidence)
            if status is Status.ACCEPTED and p < self._judge.evidence.least_probability:
                status = Status.AMBIGUOUS
                reason = f"right with probability {p:.2g} alone, by all that speaks for and against"
        elif not self._pairs.by_name:
            why = why_not_sought(self._pairs.map_a, self._pairs.map_b)
            reason = f"no evidence to the contrary could be sought: {why}"
        if status is Status.ACCEPTED and (unsure := self._why_unsure(alignment)):
            status, reason = Status.TOO_UNCERTAIN, unsure
        return Verdict(status, by_chance.log10_false_alarms, reason, **told)

    def rivals_of(self, alignment: Alignment) -> list[Alignment]:
        """The other motions that the maps support, refined and ambiguous; none without evidence."""
        if self.evidence is None:
            return []
        others = self._others(alignment.T_a_b, self.evidence)
        refined = (self._judge.refinement.refine(self._pairs, each.T_a_b) for each in others)
        return [replace(each, status=Status.AMBIGUOUS) for each in refined if each.ok]

    def signs(self, alignment: Alignment) -> EvidenceFeatures | None:
        """What speaks for and against an alignment; None where no evidence can be sought."""
        if self.evidence is None:
            return None
        by_chance = self._chance.judge(alignment).log10_false_alarms
        regions = self.regions(alignment, self.evidence)
        return self._signs(alignment, regions, self.evidence, by_chance)

    def regions(self, alignment: Alignment, evidence: PairEvidence) -> Regions:
        """What becomes of what both robots must have seen under an alignment."""
        T_a_b, p_b = alignment.T_a_b, self._pairs.map_b.position_m[:, :2]
        squares = RegionGrid.about(self._pairs.p_a[alignment.inlier], evidence.region_m)
        others = (
            each.copies
            for each in evidence.motions
            if each.of != BETWEEN or rms_distance_m(T_a_b, each.T_a_b, p_b) >= DISTINCT_M
        )
        none = RepeatedLandmarks.none(len(self._pairs.map_a), len(self._pairs.map_b))
        return self._witnesses.regions(BETWEEN, T_a_b, squares, none.joined(others))

    def _signs(
        self,
        alignment: Alignment,
        regions: Regions,
        evidence: PairEvidence,
        log10_false_alarms: float,
    ) -> EvidenceFeatures:
        told = log10_false_alarms, regions.log10_evidence(evidence.shares)
        counts = (regions.n_confirmed, regions.n_contradicted, int(alignment.inlier.sum()))
        extent_m = self._extent_m(alignment)
        one_place = self._is_one_place(alignment, extent_m)
        repeats = evidence.repeats(self._bound)
        return EvidenceFeatures(*told, *counts, extent_m, repeats, one_place)

    def _weighed(
        self, alignment: Alignment, regions: Regions, evidence: PairEvidence
    ) -> tuple[Status, str]:
        """What the evidence makes of an alignment that is more than chance.

        It speaks against one where it does so though the region by which it was found counts.
        """
        against, n = regions.n_contradicted, len(regions)
        told = f"{regions.n_confirmed} of {n} regions that both must have seen are in both maps"
        least = -math.log10(self._judge.evidence.most_against)
        if regions.log10_ratio(evidence.shares) < least:
            return Status.REFUSED, f"contradicted: {told}, {against} are missing from one"
        doubt = self._doubt(alignment, regions, evidence)
        if not doubt:
            return Status.ACCEPTED, ""
        return Status.AMBIGUOUS, doubt.format(told=told)

    def _doubt(self, alignment: Alignment, regions: Regions, evidence: PairEvidence) -> str:
        """Why another place may be the right one, with `{told}` of the regions; else empty."""
        settings, extent_m = self._judge.evidence, self._extent_m(alignment)
        ratio = regions.log10_evidence(evidence.shares)
        rivals = self._rivals(alignment.T_a_b, evidence)
        rival = max(rivals, key=lambda each: each.log10_evidence, default=None)
        if rival is not None and rival.log10_evidence > ratio - math.log10(settings.most_against):
            return f"{{told}}; so do {_named(rival)}"
        if self._is_one_place(alignment, extent_m):
            what = f"the maps show little else than this place of {extent_m:.2g} m"
            return f"{what}; what lies around it tells whether it is another's like"
        # the best of n wrong motions gets there n times as often
        n_motions = evidence.n_motions(self._bound)
        if ratio >= math.log10(settings.least_ratio * n_motions):
            return ""
        if rival is not None:
            return f"{{told}}, too few beside {_named(rival)}"
        if evidence.repeats(self._bound):
            return "{told}, too few for maps that hold things twice"
        # Nothing repeats and no other motion fits: a region that contradicts is enough to doubt
        # what is not likelier right by all but the one that led to it; else that one counts, too.
        if ratio < 0 and regions.n_contradicted:
            return "{told}; beside the one that led to it they speak against it"
        few = regions.log10_ratio(evidence.shares) < math.log10(settings.least_ratio)
        if few and regions.n_confirmed <= 1 and extent_m < evidence.region_m:
            what = f"all that agrees lies within {evidence.region_m:.2g} m"
            return f"{what} and could hang elsewhere too; no other region confirms it"
        return ""

    def _rivals(self, T_a_b: Float, evidence: PairEvidence) -> list[RivalMotion]:
        """Of the other motions those that are more than chance.

        What both robots saw of them counts, too, as of two copies of a picture each gets half the
        correspondences: under a wrong motion regions beside the one that it was found by are 10^r
        times likelier than not in at most one of so many cases (Markov), so that chance gives as
        much that much more seldom.
        """
        return [
            each
            for each in self._others(T_a_b, evidence)
            if each.log10_false_alarms - max(each.log10_evidence, 0.0) <= self._bound
        ]

    def _others(self, T_a_b: Float, evidence: PairEvidence) -> list[RivalMotion]:
        """The rivals that are another motion."""
        p_b = self._pairs.map_b.position_m[:, :2]
        return [
            each for each in evidence.rivals if rms_distance_m(T_a_b, each.T_a_b, p_b) >= DISTINCT_M
        ]

    def _extent_m(self, alignment: Alignment) -> float:
        """The longer side of where the supporters lie."""
        return float(np.ptp(self._pairs.p_b[alignment.inlier, :2], axis=0).max(initial=0.0))

    def _is_one_place(self, alignment: Alignment, extent_m: float) -> bool:
        """Whether most of a map is one place that agrees, and no larger than a room."""
        smaller = min(len(self._pairs.map_a), len(self._pairs.map_b))
        most = np.count_nonzero(alignment.inlier) > smaller / 2
        return bool(most) and extent_m < self._judge.evidence.place_m

    def _why_unsure(self, alignment: Alignment) -> str:
        """Why an alignment is not sure enough to be used; empty when it is."""
        settings, p_a = self._judge.evidence, self._pairs.p_a[alignment.inlier, :2]
        # Landmarks known by name are few and far apart: where paths bend each is off by itself.
        drift_m = 0.0 if self._pairs.by_name else alignment.drift_sigma_m
        stated = whole_map_covariance(alignment.T_a_b, alignment.covariance, drift_m, p_a)
        p_b = self._pairs.map_b.position_m[:, :2]
        sigma_m, sigma_rad = landmark_sigma_m(alignment.T_a_b, stated, p_b), math.sqrt(stated[2, 2])
        if sigma_m <= settings.max_sigma_m and sigma_rad <= settings.max_sigma_rad:
            return ""
        found = f"sigma {sigma_m:.2g} m, {sigma_rad:.2g} rad"
        return f"{found}; {settings.max_sigma_m:g} m, {settings.max_sigma_rad:g} rad are allowed"


def _named(rival: RivalMotion) -> str:
    """A rival as a person can try it."""
    x_m, y_m, theta_rad = rival.T_a_b
    T = f"T_a_b = ({x_m:.2f} m, {y_m:.2f} m, {theta_rad:.2f} rad)"
    return f"{rival.n_confirmed} of {rival.n_regions} under {T} with {rival.n_support} pairs"
