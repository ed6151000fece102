"""The verdict on an alignment: chance, evidence against it, rivals, and how sure it is."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mapfusion.align.acceptance import Acceptance, Verdict
from mapfusion.align.pairs import Pairs
from mapfusion.align.refine import Refinement
from mapfusion.align.result import Alignment, Status
from mapfusion.evidence.copies import BETWEEN, Copies
from mapfusion.evidence.pair_evidence import (
    PairEvidence,
    RivalMotion,
    find_evidence,
    why_not_sought,
)
from mapfusion.evidence.parameters import EvidenceParameters
from mapfusion.evidence.precision import laid_sigma_m
from mapfusion.evidence.probability import Signs, probability
from mapfusion.evidence.regions import Regions, Squares, Witness, Witnesses
from mapfusion.evidence.rivals import DISTINCT_M, apart_m
from mapfusion.se2 import Float
from mapfusion.team.relations import whole_map_covariance


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
        witnesses: tuple[Witness, Witness] | None = None,
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
        witnesses: tuple[Witness, Witness] | None,
    ) -> None:
        self._judge, self._pairs, self._known, self._ready = judge, pairs, known, witnesses
        self._chance = judge.acceptance.on(pairs)
        self._bound = math.log10(judge.acceptance.false_alarms)

    @cached_property
    def _witnesses(self) -> Witnesses:
        a, b = self._ready or (Witness(self._pairs.map_a), Witness(self._pairs.map_b))
        return Witnesses(a, b, self._judge.evidence)

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
            p = probability(signs)
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

    def signs(self, alignment: Alignment) -> Signs | None:
        """What speaks for and against an alignment; None where no evidence can be sought."""
        if self.evidence is None:
            return None
        by_chance = self._chance.judge(alignment).log10_false_alarms
        regions = self.regions(alignment, self.evidence)
        return self._signs(alignment, regions, self.evidence, by_chance)

    def regions(self, alignment: Alignment, evidence: PairEvidence) -> Regions:
        """What becomes of what both robots must have seen under an alignment."""
        T_a_b, p_b = alignment.T_a_b, self._pairs.map_b.position_m[:, :2]
        squares = Squares.about(self._pairs.p_a[alignment.inlier], evidence.region_m)
        others = (
            each.copies
            for each in evidence.motions
            if each.of != BETWEEN or apart_m(T_a_b, each.T_a_b, p_b) >= DISTINCT_M
        )
        none = Copies.none(len(self._pairs.map_a), len(self._pairs.map_b))
        return self._witnesses.regions(BETWEEN, T_a_b, squares, none.joined(others))

    def _signs(
        self,
        alignment: Alignment,
        regions: Regions,
        evidence: PairEvidence,
        log10_false_alarms: float,
    ) -> Signs:
        told = log10_false_alarms, regions.log10_evidence(evidence.shares)
        counts = (regions.n_confirmed, regions.n_contradicted, int(alignment.inlier.sum()))
        extent_m = self._extent_m(alignment)
        one_place = self._is_one_place(alignment, extent_m)
        repeats = evidence.repeats(self._bound)
        return Signs(*told, *counts, extent_m, repeats, one_place)

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
        return [each for each in evidence.rivals if apart_m(T_a_b, each.T_a_b, p_b) >= DISTINCT_M]

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
        sigma_m, sigma_rad = laid_sigma_m(alignment.T_a_b, stated, p_b), math.sqrt(stated[2, 2])
        if sigma_m <= settings.max_sigma_m and sigma_rad <= settings.max_sigma_rad:
            return ""
        found = f"sigma {sigma_m:.2g} m, {sigma_rad:.2g} rad"
        return f"{found}; {settings.max_sigma_m:g} m, {settings.max_sigma_rad:g} rad are allowed"


def _named(rival: RivalMotion) -> str:
    """A rival as a person can try it."""
    x_m, y_m, theta_rad = rival.T_a_b
    T = f"T_a_b = ({x_m:.2f} m, {y_m:.2f} m, {theta_rad:.2f} rad)"
    return f"{rival.n_confirmed} of {rival.n_regions} under {T} with {rival.n_support} pairs"
