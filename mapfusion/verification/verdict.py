"""Verdict on an alignment: accepted, refused, ambiguous or uncertain, with the reason."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from mapfusion.align.alignment import Alignment, Pairs, Status
from mapfusion.align.correspondences import MatchParameters
from mapfusion.align.covariance import residual_scale, with_common_motion
from mapfusion.align.geometric_matching import DISTINCT_M
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import (
    least_squares_gain,
    motion_covariance,
    residual_covariances,
)
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, rms_distance_m, transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Acceptance, Verdict
from mapfusion.verification.likelihood import COPIED, DECISIVE, OWN, TwinShares
from mapfusion.verification.regions import (
    EvidenceParameters,
    RegionGrid,
    Regions,
    ViewedMap,
    ViewedMapPair,
)
from mapfusion.verification.rivals import (
    BETWEEN,
    RepeatedLandmarks,
    SupportedMotion,
    distinct_motions,
    explained_landmarks,
    longest_patch_side_m,
    mirror_image_motion,
    repeated_under_others,
    self_motions,
)


def landmark_sigma_m(T_a_b: Float, covariance: Float, p_b: Float) -> float:
    """Return the standard deviation in metres of map b's landmarks due to the alignment, RMS.

    To first order this is the root of the mean of tr(J S J') over the landmarks, J = d(T p_b)/dT.
    The supporters of an alignment may lie in one part of the map; the effect of the angle grows
    with the distance from them.

    Args:
        T_a_b: motion, shape (3,).
        covariance: covariance S of T_a_b, shape (3, 3).
        p_b: positions in metres, shape (N, 2).
    """
    x, y = (transform_points(T_a_b, p_b) - T_a_b[:2]).T
    moved_by_angle = x**2 + y**2
    with_shift = x * covariance[1, 2] - y * covariance[0, 2]
    squares = covariance[0, 0] + covariance[1, 1] + 2 * with_shift
    return float(np.sqrt(np.mean(squares + moved_by_angle * covariance[2, 2])))


N_RIVALS, N_SELF_MOTIONS = 4, 3  # motions searched between two maps, and of each map onto itself
# Significance of the test that an alignment has more supporters of its own than a rival.
_EQUAL = 0.01
# Regions of the grid that a copy of the size of one region may touch along an axis.
_TOUCHED = 2
# Share of the supporters that may be one copy if the others agree by chance.
_BULK = 0.9
# Size of the residuals in stated sigmas from which on a verdict says it. Chance does not reach it
# with the fewest pairs that pass the test against chance.
_OVERCONFIDENT = 3.0
# The same for covariances that are too large. A fused map that holds one of two equally good maps
# differs from it by 1/sqrt(3) of the stated sigmas, and maps whose landmarks share errors by 0.6 or
# more. Standard deviations written as variances give far less.
_UNDERCONFIDENT = 0.5
_EQUAL = 1e-3  # residuals, in stated sigmas, up to which landmarks are copies of each other
_ENOUGH_PAIRS = 20  # pairs that chance makes agree so closely in fewer than one of 1000 maps
_PATCH_REACH_M = 0.7  # largest distance between neighbouring corners of one texture
_LEAST_OF_PATCH = 5  # landmarks
# Beta priors of the shares of regions that a wrong motion confirms, as (confirmed, all) regions:
# maximum likelihood over wrong motions in simulated worlds with repeated structure, without the
# region that led to each motion.
_TWINS_BEFORE = 0.44, 3.85
_COPIES_BEFORE = 1.14, 6.1


@dataclass(frozen=True)
class RivalMotion:
    """Motion that correspondences support.

    Attributes:
        of: domain: BETWEEN, or the map ("a" or "b") that the motion maps onto itself.
        T_a_b: motion, shape (3,).
        log10_false_alarms: log10 of the number of false alarms in the test against chance.
        n_support: number of correspondences within the widest gate of this test.
        n_confirmed: number of regions that support the motion.
        n_contradicted: number of regions that contradict it.
        n_regions: number of regions that both robots must have seen.
        log10_evidence: log10 likelihood ratio of the regions; NaN for a motion of one map.
        copies: landmarks that the motion maps onto matching structure.
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
    """Motions that two maps support, and the amount of repeated structure in them.

    Attributes:
        motions: best motions between the maps and of each map onto itself, best first.
        shares: shares of regions that a wrong motion confirms.
        region_m: side of a region, at least that of the largest repeated structure.
    """

    motions: tuple[RivalMotion, ...]
    shares: TwinShares
    region_m: float

    @classmethod
    def of_nothing(cls, parameters: EvidenceParameters) -> "PairEvidence":
        """Return the evidence of two maps without any supported motion."""
        return cls((), _twin_shares([], []), parameters.region_m)

    @property
    def rivals(self) -> tuple[RivalMotion, ...]:
        """Motions between the two maps."""
        return tuple(each for each in self.motions if each.of == BETWEEN)

    def repeats(self, log10_false_alarms: float) -> bool:
        """Return True if a motion of either map onto itself is below a bound of the NFA."""
        onto_self = (each for each in self.motions if each.of != BETWEEN)
        return any(each.log10_false_alarms <= log10_false_alarms for each in onto_self)


def why_not_sought(map_a: LandmarkMap, map_b: LandmarkMap) -> str:
    """Return the data that two maps lack for a search of evidence; empty if they lack none."""
    for landmarks in (map_a, map_b):
        for what, held in (
            ("viewing evidence", landmarks.viewing),
            ("descriptors", landmarks.descriptor),
        ):
            if held is None:
                return f"{landmarks.called} has no {what}"
    return ""


def find_evidence(
    pairs: Pairs,
    viewed_maps: ViewedMapPair,
    acceptance: Acceptance,
    refinement: Refinement,
    parameters: EvidenceParameters,
) -> PairEvidence:
    """Find the motions that two maps with viewing evidence and descriptors support.

    Args:
        pairs: correspondences of the maps.
        viewed_maps: the maps, prepared for queries.
        acceptance: test of each motion against chance.
        refinement: least squares of each motion.
        parameters: size of a region.
    """
    # motions between the maps, and of each map onto itself
    motions = [(BETWEEN, m) for m in distinct_motions(pairs, N_RIVALS, acceptance, refinement)]
    n_between, region_m = len(motions), parameters.region_m
    supporters = [pairs.p_a[motion.inlier] for _, motion in motions]
    for side, viewed_map in zip("ab", (viewed_maps.a, viewed_maps.b), strict=True):
        key = self_motions, acceptance, refinement
        if key not in viewed_map.cache:
            viewed_map.cache[key] = self_motions(
                viewed_map.landmarks, N_SELF_MOTIONS, acceptance, refinement
            )
        similar, onto_itself = viewed_map.cache[key]
        for motion in onto_itself:
            motions.append((side, motion))
            supporters.append(similar.p_a[motion.inlier])
            # a region is at least as large as the largest repeated structure
            if motion.log10_false_alarms <= math.log10(acceptance.false_alarms):
                p = np.ascontiguousarray(similar.p_a[motion.inlier, :2])
                side_m = longest_patch_side_m(p, _PATCH_REACH_M, _LEAST_OF_PATCH)
                region_m = max(region_m, side_m)
    # regions under each motion, with the structure that other motions explain counted apart
    copies = [viewed_maps.copies(mapped_side, motion.T_a_b) for mapped_side, motion in motions]
    regions = [
        viewed_maps.regions(
            mapped_side,
            motion.T_a_b,
            RegionGrid.about(supporters[k], region_m),
            repeated_under_others(copies, k),
        )
        for k, (mapped_side, motion) in enumerate(motions)
    ]
    shares = _twin_shares(regions[:n_between], regions[n_between:])
    found = tuple(
        RivalMotion(
            mapped_side,
            motion.T_a_b,
            motion.log10_false_alarms,
            int(np.count_nonzero(motion.inlier)),
            viewed_map.n_confirmed,
            viewed_map.n_contradicted,
            len(viewed_map),
            viewed_map.log10_evidence(shares) if mapped_side == BETWEEN else math.nan,
            repeated,
        )
        for (mapped_side, motion), viewed_map, repeated in zip(
            motions, regions, copies, strict=True
        )
    )
    return PairEvidence(found, shares, region_m)


def _twin_shares(rivals: list[Regions], selves: list[Regions]) -> TwinShares:
    """Compute the shares of regions that wrong motions confirm, without the regions they came from.

    One of the motions between the maps may be right. The motion with the most confirmed minus
    contradicted regions is therefore left out. A motion of a map onto itself was searched for where
    the map holds a structure twice, and says nothing of other regions.
    """
    other_rivals = sorted(rivals, key=lambda r: r.n_contradicted - r.n_confirmed)[1:]
    n_confirmed = [_TWINS_BEFORE, *(regions.count_confirmed(OWN) for regions in other_rivals)]
    copied = [
        _COPIES_BEFORE,
        *(regions.count_confirmed(COPIED) for regions in [*other_rivals, *selves]),
    ]
    shares = (np.sum(counts, axis=0) for counts in (n_confirmed, copied))
    return TwinShares(*(float(confirmed / n) for confirmed, n in shares))


@dataclass(frozen=True)
class Verifier:
    """Verification of an alignment before use, the same for every estimator.

    The first test is against chance (`Acceptance`). The second test compares the regions that both
    robots must have seen: a region in both maps confirms an alignment, a region missing from one
    map contradicts it. Maps with repeated structure or with several supported motions need
    confirmation; other maps only need the absence of contradiction. The third test bounds the
    covariance. The second test is omitted for maps with labels.

    Attributes:
        acceptance: test against chance.
        evidence: thresholds of the evidence and of the covariance.
        refinement: least squares of rival motions.
    """

    acceptance: Acceptance = field(default_factory=Acceptance)
    evidence: EvidenceParameters = field(default_factory=EvidenceParameters)
    refinement: Refinement = field(default_factory=Refinement)

    def on(
        self,
        pairs: Pairs,
        known: PairEvidence | None = None,
        viewed_maps: tuple[ViewedMap, ViewedMap] | None = None,
    ) -> "PairVerifier":
        """Prepare the verification of any number of alignments of two maps.

        Args:
            pairs: correspondences of the maps.
            known: evidence found earlier; by default it is found at first use.
            viewed_maps: both maps prepared for queries; by default they are prepared at first use.
        """
        return PairVerifier(self, pairs, known, viewed_maps)


class PairVerifier:
    """`Verifier` prepared for two maps."""

    def __init__(
        self,
        settings: Verifier,
        pairs: Pairs,
        known: PairEvidence | None,
        viewed_maps: tuple[ViewedMap, ViewedMap] | None,
    ) -> None:
        self._settings, self._pairs, self._known, self._ready = settings, pairs, known, viewed_maps
        self._chance = settings.acceptance.on(pairs)
        self._bound = math.log10(settings.acceptance.false_alarms)

    @cached_property
    def _viewed_maps(self) -> ViewedMapPair:
        a, b = self._ready or (ViewedMap(self._pairs.map_a), ViewedMap(self._pairs.map_b))
        return ViewedMapPair(a, b, self._settings.evidence)

    @cached_property
    def evidence(self) -> PairEvidence | None:
        """Evidence of the maps, found at first use; None if they carry none."""
        if self._pairs.by_name or why_not_sought(self._pairs.map_a, self._pairs.map_b):
            return None
        if self._known is not None:
            return self._known
        settings = self._settings
        parts = (settings.acceptance, settings.refinement, settings.evidence)
        return find_evidence(self._pairs, self._viewed_maps, *parts)

    def verify(self, alignment: Alignment) -> Verdict:
        """Return the verdict on one alignment of the correspondences."""
        by_chance = self._chance.verify(alignment)
        if not by_chance.accepted:
            return by_chance
        status, reason, evidence_values = Status.ACCEPTED, "", {}
        evidence = self.evidence
        if evidence is not None:
            regions = self.regions(alignment, evidence, evidence.region_m)
            log10_evidence = regions.log10_evidence(evidence.shares)
            evidence_values = {"log10_evidence": log10_evidence, "n_confirmed": regions.n_confirmed}
            # The regions count as evidence for the best other motion beyond chance, since two
            # copies of a texture share the correspondences. Under a wrong motion the likelihood
            # ratio of the regions exceeds 10^r with probability at most 10^-r (Markov), which
            # lowers the NFA by r decades.
            rivals = [
                each
                for each in self._others(alignment.T_a_b, evidence)
                if each.log10_false_alarms - max(each.log10_evidence, 0.0) <= self._bound
            ]
            rival = max(rivals, key=lambda each: each.log10_evidence, default=None)
            passed = self._log10_ratio_passed(alignment, regions, evidence, rival)
            evidence_values |= {
                "n_contradicted": regions.n_contradicted,
                "log10_ratio_passed": passed,
            }
            # a contradiction counts even together with the region that led to the alignment
            settings = self._settings.evidence
            counts = f"{regions.n_confirmed} of {len(regions)} regions that both must have seen"
            counts = f"{counts} are in both maps"
            if regions.log10_ratio(evidence.shares) < -math.log10(settings.most_against):
                status = Status.REFUSED
                missing = regions.n_contradicted
                reason = f"contradicted: {counts}, {missing} are missing from one"
            elif doubt := self._doubt(alignment, regions, evidence, rival, passed):
                status, reason = Status.AMBIGUOUS, doubt.format(told=counts)
        elif not self._pairs.by_name:
            why = why_not_sought(self._pairs.map_a, self._pairs.map_b)
            if image := self._equal_mirror_image(alignment, by_chance.log10_false_alarms):
                status, reason = Status.AMBIGUOUS, image
            elif rival := self._equal_rival(alignment):
                status, reason = Status.AMBIGUOUS, f"{rival}; nothing tells which is right: {why}"
            elif self._pairs.by_geometry:
                reason = "matched by geometry alone"
            else:
                untested = "another place that looks alike could not be ruled out"
                reason = f"{untested}: {why} (see `mapfusion docs refusal`)"
        if status is Status.ACCEPTED and (unsure := self._why_unsure(alignment)):
            status, reason = Status.TOO_UNCERTAIN, unsure
        if status is Status.ACCEPTED and (note := self._residual_note(alignment)):
            reason = "; ".join(filter(None, (reason, note)))
        return Verdict(status, by_chance.log10_false_alarms, reason, **evidence_values)

    def rivals_of(self, alignment: Alignment) -> list[Alignment]:
        """Return the other motions that the maps support, refined, with the status ambiguous.

        The list is empty for maps with labels.
        """
        if self.evidence is not None:
            others = [each.T_a_b for each in self._others(alignment.T_a_b, self.evidence)]
        else:
            others = self._other_motions(alignment.T_a_b)
        refined = (self._settings.refinement.refine(self._pairs, each) for each in others)
        return [replace(each, status=Status.AMBIGUOUS) for each in refined if each.ok]

    @cached_property
    def _motions_beyond_chance(self) -> tuple[list[Float], list[Float], list[Float]]:
        """Motions beyond chance between the maps, of a onto itself and of b onto itself."""
        settings, pairs = self._settings, self._pairs
        if pairs.by_name:
            return [], [], []
        between = distinct_motions(pairs, N_RIVALS, settings.acceptance, settings.refinement)
        motions_by_kind = [between]
        for landmarks in (pairs.map_a, pairs.map_b):
            parts = (N_SELF_MOTIONS, settings.acceptance, settings.refinement)
            motions_by_kind.append(self_motions(landmarks, *parts)[1])
        significant_motions = [
            [m.T_a_b for m in of if m.log10_false_alarms <= self._bound] for of in motions_by_kind
        ]
        return significant_motions[0], significant_motions[1], significant_motions[2]

    def _other_motions(self, T_a_b: Float) -> list[Float]:
        """Return the motions of maps without evidence that may be right in place of a motion.

        A motion that maps a part of one map onto a similar part gives another motion between the
        maps, even if too few correspondences follow it: each landmark has one correspondence only.
        """
        between, of_a, of_b = self._motions_beyond_chance
        p_b = self._pairs.map_b.position_m[:, :2]
        by_symmetry = [compose(T, T_a_b) for T in of_a] + [compose(T_a_b, T) for T in of_b]
        others: list[Float] = []
        for T in [*between, *by_symmetry]:
            if all(rms_distance_m(T, each, p_b) >= DISTINCT_M for each in [T_a_b, *others]):
                others.append(T)
        return others

    def _equal_rival(self, alignment: Alignment) -> str:
        """Return in words a motion that the alignment does not outdo; empty without one.

        Landmarks of map b that both motions lay on similar landmarks of map a tell nothing. If
        only the structure that repeats is common to the maps, each motion explains as many of the
        others (sign test).
        """
        maps = self._pairs.map_a, self._pairs.map_b
        gates_m = self._settings.acceptance.gates_m
        # without descriptors many landmarks lie within a wide gate of another one
        gate_m = min(gates_m) if self._pairs.by_geometry else max(gates_m)
        by_own = explained_landmarks(*maps, alignment.T_a_b, gate_m)
        for T_a_b in self._other_motions(alignment.T_a_b):
            by_rival = explained_landmarks(*maps, T_a_b, gate_m)
            wins, losses = (
                int(np.count_nonzero(m)) for m in (by_own & ~by_rival, by_rival & ~by_own)
            )
            if scipy.special.bdtrc(wins - 1, wins + losses, 0.5) > _EQUAL:  # P(X >= wins)
                n_own, n_rival = (int(np.count_nonzero(m)) for m in (by_own, by_rival))
                return (
                    f"{self._motion_text(alignment.T_a_b)} explains {n_own} landmarks of map "
                    f"{maps[1].name}, {self._motion_text(T_a_b)} explains {n_rival}"
                )
        return ""

    @cached_property
    def _mirror_image_motion(self) -> tuple[SupportedMotion, Float] | None:
        """Best motion of the mirror image of map b and its supporters, found at first use."""
        settings, tolerance = self._settings, self._pairs.correspondences.size_tolerance
        usual = MatchParameters()
        matching = usual if tolerance is None else replace(usual, size_tolerance=tolerance)
        return mirror_image_motion(self._pairs, settings.acceptance, settings.refinement, matching)

    def _equal_mirror_image(self, alignment: Alignment, log10_false_alarms: float) -> str:
        """Say that the mirror image of map b fits as well as an alignment; empty if it does not.

        Landmarks near a line agree with their mirror images about it. That is no chance, and passes
        the test against chance. The mirror image of a right map has the support of such landmarks
        alone. The alignment outdoes it if the ratio of both NFAs is at most `false_alarms`. If all
        landmarks lie on one line, the image has the same landmarks in the same places, and is no
        rival.

        Args:
            alignment: the alignment.
            log10_false_alarms: log10 of its NFA.
        """
        if self._mirror_image_motion is None:
            return ""
        image, p_b = self._mirror_image_motion
        beyond_chance = image.log10_false_alarms <= self._bound
        if not beyond_chance or log10_false_alarms - image.log10_false_alarms <= self._bound:
            return ""
        by_image = transform_points(image.T_a_b, p_b * [1, -1])
        apart_m = np.linalg.norm(transform_points(alignment.T_a_b, p_b) - by_image, axis=1)
        if np.sqrt(np.mean(apart_m**2)) <= max(self._settings.acceptance.gates_m):
            return ""
        a, b = self._pairs.map_a.name, self._pairs.map_b.name
        fits = f"the mirror image of map {b} fits map {a} with {len(p_b)} pairs"
        return f"{fits}, no worse than map {b} itself: check the sign of y and theta of both maps"

    def regions(self, alignment: Alignment, evidence: PairEvidence, side_m: float) -> Regions:
        """Return the regions of a side that both robots must have seen under an alignment."""
        T_a_b, p_b = alignment.T_a_b, self._pairs.map_b.position_m[:, :2]
        squares = RegionGrid.about(self._pairs.p_a[alignment.inlier], side_m)
        others = (
            each.copies
            for each in evidence.motions
            if each.of != BETWEEN or rms_distance_m(T_a_b, each.T_a_b, p_b) >= DISTINCT_M
        )
        none = RepeatedLandmarks.none(len(self._pairs.map_a), len(self._pairs.map_b))
        return self._viewed_maps.regions(BETWEEN, T_a_b, squares, none.joined(others))

    def _log10_ratio_passed(
        self,
        alignment: Alignment,
        regions: Regions,
        evidence: PairEvidence,
        rival: RivalMotion | None,
    ) -> float:
        """Return log10 of the largest `least_ratio` that the regions pass; infinite without limit.

        Maps without repeated structure and without another motion need little evidence if the
        supporters extend over two regions or more and over several walls: the regions beside that
        which led to the motion, if there are any, must confirm it, and none may contradict it. All
        that agrees on one wall may be a large picture, and few supporters elsewhere may be chance.
        Less than two regions may be a copy that led to the motion as a whole. It is then one
        region, which is no evidence.
        """
        ratio = regions.log10_evidence(evidence.shares)
        # the best of n motions beyond chance reaches the threshold n times as often (Boole)
        n_motions = sum(each.log10_false_alarms <= self._bound for each in evidence.rivals)
        passed = ratio - math.log10(max(1, n_motions))
        if rival is not None or evidence.repeats(self._bound) or regions.n_contradicted:
            return passed
        least_m = _TOUCHED * evidence.region_m
        if (extent_m := self._extent_m(alignment)) < least_m:
            around = self.regions(alignment, evidence, max(extent_m, evidence.region_m))
            return around.log10_evidence(evidence.shares)
        unconfirmed = len(regions) > 1 and ratio < DECISIVE
        is_small = np.ptp(self._bulk(alignment)[1], axis=0).max() < least_m
        return passed if unconfirmed or is_small or self._is_one_wall(alignment) else math.inf

    def _doubt(
        self,
        alignment: Alignment,
        regions: Regions,
        evidence: PairEvidence,
        rival: RivalMotion | None,
        log10_ratio_passed: float,
    ) -> str:
        """Return why another motion may be the right one; empty if none may.

        The text contains the placeholder `{told}` for the counts of regions.
        """
        settings, extent_m = self._settings.evidence, self._extent_m(alignment)
        ratio = regions.log10_evidence(evidence.shares)
        if rival is not None and rival.log10_evidence > ratio - math.log10(settings.most_against):
            return f"{{told}}; so do {self._named(rival)}"
        smaller = min(len(self._pairs.map_a), len(self._pairs.map_b))
        is_majority = np.count_nonzero(alignment.inlier) > smaller / 2
        if is_majority and extent_m < settings.place_m:
            doubt_text = f"the maps show little else than this place of {extent_m:.2g} m"
            return f"{doubt_text}; what lies around it tells whether it is another's like"
        if math.log10(settings.least_ratio) <= log10_ratio_passed:
            return ""
        if rival is not None:
            return f"{{told}}, too few beside {self._named(rival)}"
        if evidence.repeats(self._bound):
            return "{told}, too few for maps that hold things twice"
        # No structure repeats and no other motion fits: a contradicting region is reason for doubt.
        if regions.n_contradicted:
            return f"{{told}}, too few beside {regions.n_contradicted} that are missing from one"
        least_m = _TOUCHED * evidence.region_m
        if extent_m < least_m:
            doubt_text = f"all that agrees lies within {least_m:.2g} m"
            return f"{doubt_text} and could be a copy; too few regions around confirm it"
        if np.ptp(self._bulk(alignment)[1], axis=0).max() < least_m:
            doubt_text = f"nearly all that agrees lies within {least_m:.2g} m"
            return f"{{told}}, too few if {doubt_text} and could be a copy"
        if self._is_one_wall(alignment):
            return "{told}, too few if all that agrees lies on one wall and could be a picture"
        return "{told}, too few to confirm it"

    def _others(self, T_a_b: Float, evidence: PairEvidence) -> list[RivalMotion]:
        """Return the rivals that differ from a motion."""
        p_b = self._pairs.map_b.position_m[:, :2]
        return [
            each for each in evidence.rivals if rms_distance_m(T_a_b, each.T_a_b, p_b) >= DISTINCT_M
        ]

    def _extent_m(self, alignment: Alignment) -> float:
        """Return the longer side of the bounding box of the supporters."""
        return float(np.ptp(self._pairs.p_b[alignment.inlier, :2], axis=0).max(initial=0.0))

    def _bulk(self, alignment: Alignment) -> tuple[Float, Float]:
        """Return the supporters in each map, without those farthest from their median.

        Few of them may agree by chance.

        Returns:
            Positions in map a and in map b, the same supporters in both.
        """
        used = self._pairs[alignment.inlier]
        p_a, p_b = used.p_a[:, :2], used.p_b[:, :2]
        away_m = np.linalg.norm(p_b - np.median(p_b, axis=0), axis=1)
        is_in_bulk = away_m <= np.quantile(away_m, _BULK)
        return p_a[is_in_bulk], p_b[is_in_bulk]

    def _is_one_wall(self, alignment: Alignment) -> bool:
        """Return True if most supporters lie on one line, as those of a picture on a wall do.

        The line is their principal axis. Two standard deviations across it are at most `gate_m`.
        One map suffices: drift bends a wall.
        """
        for p in self._bulk(alignment):
            centred = p - p.mean(axis=0)
            across_m2 = np.linalg.eigvalsh(centred.T @ centred / len(p))[0]
            if 2 * np.sqrt(max(across_m2, 0.0)) <= self._settings.evidence.gate_m:
                return True
        return False

    def _residual_note(self, alignment: Alignment) -> str:
        """Say that the residuals contradict the covariances of the maps; empty if they do not.

        Maps with joint covariances are left out: errors that their landmarks share are stated.
        Residuals that are too large are a lower bound, since matching drops pairs whose heights
        differ too much.
        """
        maps = self._pairs.map_a, self._pairs.map_b
        if not alignment.inlier.any() or all(each.joint is not None for each in maps):
            return ""
        scale = residual_scale(alignment.T_a_b, self._pairs[alignment.inlier])
        if scale >= _OVERCONFIDENT:
            times = f"the residuals are at least {scale:.2g} times as large as"
            return f"{times} the maps' covariances state"
        # `shared_observations` tells maps whose landmarks are equal
        if (
            not _EQUAL < scale <= _UNDERCONFIDENT
            or np.count_nonzero(alignment.inlier) < _ENOUGH_PAIRS
        ):
            return ""
        return (
            f"the residuals are {scale:.2g} times as large as the maps' covariances state: these "
            "may be standard deviations in place of variances, or the maps share observations"
        )

    def _why_unsure(self, alignment: Alignment) -> str:
        """Return why the covariance of an alignment is too large; empty if it is not."""
        settings, used = self._settings.evidence, self._pairs[alignment.inlier]
        stated = with_common_motion(alignment, used.p_a[:, :2])
        if self._pairs.by_name:
            # Landmarks with labels fall on each other however far the starts of both maps are off.
            # They are few and far apart, so that their drift is independent.
            T_a_b, drift_m2 = alignment.T_a_b, alignment.drift_sigma_m**2 * np.eye(2)
            residual_covariance = residual_covariances(T_a_b, used.covariance_a, used.covariance_b)
            stated = motion_covariance(
                least_squares_gain(T_a_b, used.p_b), residual_covariance + drift_m2
            )
        p_b = self._pairs.map_b.position_m[:, :2]
        sigma_m, sigma_rad = landmark_sigma_m(alignment.T_a_b, stated, p_b), math.sqrt(stated[2, 2])
        if sigma_m <= settings.max_sigma_m and sigma_rad <= settings.max_sigma_rad:
            return ""
        sigma_text = f"sigma {sigma_m:.2g} m, {sigma_rad:.2g} rad"
        return (
            f"{sigma_text}; {settings.max_sigma_m:g} m, {settings.max_sigma_rad:g} rad are allowed"
        )

    def _motion_text(self, T_a_b: Float) -> str:
        (x_m, y_m, theta_rad), _ = self._pairs.given_motion(T_a_b)
        return f"T_a_b = ({x_m:.2f} m, {y_m:.2f} m, {theta_rad:.2f} rad)"

    def _named(self, rival: RivalMotion) -> str:
        """Return a rival motion in words, with its transform."""
        T = self._motion_text(rival.T_a_b)
        return f"{rival.n_confirmed} of {rival.n_regions} under {T} with {rival.n_support} pairs"
