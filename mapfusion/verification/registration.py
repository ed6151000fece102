"""Registration of two maps: estimate with an aligner, refine by least squares, verify."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.align.aligners import Aligner, MethodAligner, alignment_of_fit, as_aligner
from mapfusion.align.alignment import (
    MIN_PAIRS,
    NOT_RUN,
    Alignment,
    Method,
    Pairs,
    Status,
    supported,
)
from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.frames import (
    HeightDifference,
    Overlap,
    height_difference,
    in_local_frame,
    moved_motion,
    origin_of,
)
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import fit_rigid, residual_covariances, residuals
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Verdict
from mapfusion.verification.verdict import PairEvidence, PairVerifier, Verifier


class VerifiedRefinement:
    """Refinement and verdict for estimates on one pair of maps.

    Equal estimates are refined once, and equal refined alignments are verified once.

    Args:
        pairs: correspondences of the two maps.
        refinement: least squares after the estimate.
        verifier: gives the verdict; None accepts what the refinement accepts.
        evidence: evidence found earlier for these maps; None to compute it when needed.
    """

    def __init__(
        self,
        pairs: Pairs,
        refinement: Refinement,
        verifier: Verifier | None,
        evidence: PairEvidence | None = None,
    ) -> None:
        self.pairs, self._refinement = pairs, refinement
        self.verifier: PairVerifier | None = verifier and verifier.on(pairs, evidence)
        self._refined: dict[tuple, Alignment] = {}
        self._verdicts: dict[tuple, Verdict] = {}

    @property
    def gate_m(self) -> float:
        """Largest distance in the plane of a pair under the estimate."""
        return self._refinement.gate_m

    def verify(self, estimated: Alignment) -> tuple[Alignment, Verdict]:
        """Return the refined alignment of an estimate, and the verdict on it."""
        refined = estimated
        if estimated.status not in NOT_RUN:
            known = (estimated.T_a_b.tobytes(), estimated.status, estimated.reason)
            if known not in self._refined:
                found = self._refinement.refine(self.pairs, estimated.T_a_b)
                if np.isnan(estimated.T_a_b).any():  # only the estimator knows the reason
                    found = replace(found, reason=estimated.reason)
                self._refined[known] = found
            refined = self._refined[known]
        arrays = (array.tobytes() for array in (refined.T_a_b, refined.covariance, refined.inlier))
        known = (
            *arrays,
            refined.drift_sigma_m,
            refined.lower_bound,
            refined.status,
            refined.reason,
        )
        if known not in self._verdicts:
            self._verdicts[known] = (
                Verdict(refined.status, np.nan, refined.reason)
                if self.verifier is None
                else self.verifier.verify(refined)
            )
        return refined, self._verdicts[known]


class Registered(NamedTuple):
    """Result of one registration of two maps.

    Attributes:
        estimated: alignment of the method.
        refined: alignment after least squares; equals `estimated` if the method did not run.
        verdict: verdict on the refined alignment.
    """

    estimated: Alignment
    refined: Alignment
    verdict: Verdict

    @property
    def applied(self) -> Alignment:
        """Refined alignment with the status of the verdict, for merging."""
        return self.verdict.applied_to(self.refined)

    def with_note(self, note: str) -> "Registered":
        """Append a note on the maps to each reason for a rejection."""
        if not note or self.verdict.accepted or self.estimated.status in NOT_RUN:
            return self
        estimated, refined, verdict = (
            {"reason": f"{each.reason}; {note}"}
            if each.reason and each.status is not Status.ACCEPTED
            else {}
            for each in self
        )
        return Registered(
            replace(self.estimated, **estimated),
            replace(self.refined, **refined),
            replace(self.verdict, **verdict),
        )


@dataclass(frozen=True)
class Registration:
    """Registration of two maps: estimate, refine, verify.

    Maps far from their origins are registered in local frames, with map b lowered by the height
    offset of the correspondences. Results are in the frames of the given maps.

    Attributes:
        method: estimates the motion.
        refinement: least squares after the estimate.
        verifier: gives the verdict; None accepts what the refinement accepts.
    """

    method: Method | Aligner
    refinement: Refinement = field(default_factory=Refinement)
    verifier: Verifier | None = field(default_factory=Verifier)

    @property
    def randomised(self) -> bool:
        """True if the result depends on the random generator."""
        return self.method.randomised

    def on(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        evidence: PairEvidence | None = None,
    ) -> "PairRegistration":
        """Return the registration of two maps, which can run any number of times.

        Args:
            map_a: map in frame a.
            map_b: map in frame b.
            correspondences: correspondences of the two maps.
            evidence: evidence of an earlier registration of these maps
                (`PairRegistration.verifier.evidence`); None to compute it when needed.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        origins = origin_of(map_a), origin_of(map_b)
        local = (
            in_local_frame(map_a, origins[0]),
            in_local_frame(map_b, origins[1], correspondences.height_offset_m),
        )
        pairs = Pairs(*local, correspondences, origins)
        return PairRegistration(
            self.method, VerifiedRefinement(pairs, self.refinement, self.verifier, evidence)
        )

    def register(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Registered:
        """Register two maps once.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        return self.on(map_a, map_b, correspondences).register(rng)


class PairRegistration:
    """Registration of one pair of maps with one method.

    Several methods on the same pair may share the refinement.
    """

    def __init__(self, method: Method | Aligner, refinement: VerifiedRefinement) -> None:
        self._aligner, self._refinement = as_aligner(method), refinement
        self._described: dict[int, tuple[Alignment, Alignment, Verdict, str]] = {}

    @property
    def pairs(self) -> Pairs:
        """Correspondences in the local frames of the maps."""
        return self._refinement.pairs

    @property
    def verifier(self) -> PairVerifier | None:
        """Verifier of the pair; None accepts what the refinement accepts."""
        return self._refinement.verifier

    def register(self, rng: np.random.Generator) -> Registered:
        """Estimate, refine and verify once."""
        pairs = self._refinement.pairs
        if isinstance(self._aligner, MethodAligner):
            estimated = self._aligner.align_pairs(pairs, rng)
        else:
            estimated = self._aligner.align(pairs.map_a, pairs.map_b, pairs.correspondences, rng)
        registered = Registered(estimated, *self._refinement.verify(estimated))
        if pairs.origins is not None:
            registered = self._in_given_frames(registered)
        if registered.verdict.accepted:
            return registered
        n_support = int(np.count_nonzero(registered.refined.inlier))
        return registered.with_note(pairs.note(n_support))

    def rivals_of(self, refined: Alignment) -> list[Alignment]:
        """Return the other motions that the maps support; see `PairVerifier.rivals_of`."""
        if self.verifier is None:
            return []
        if (origins := self._refinement.pairs.origins) is None:
            return self.verifier.rivals_of(refined)
        motion_in_maps = moved_motion(
            refined.T_a_b, refined.covariance, *(-origin for origin in origins)
        )
        local = replace(refined, T_a_b=motion_in_maps[0], covariance=motion_in_maps[1])
        return [self._moved(each) for each in self.verifier.rivals_of(local)]

    def _in_given_frames(self, local: Registered) -> Registered:
        """Return a result in the given frames, with overlap and heights, and what these tell."""
        estimated, refined = self._moved(local.estimated), local.refined
        if not refined.inlier.any() or not np.isfinite(refined.T_a_b).all():
            return Registered(estimated, self._moved(refined), local.verdict)
        if id(refined) not in self._described:  # equal estimates share one refined alignment
            self._described[id(refined)] = (refined, *self._with_heights(refined, local.verdict))
        _, moved, verdict, tilt = self._described[id(refined)]
        return Registered(estimated, moved, verdict).with_note(tilt)

    def _with_heights(self, refined: Alignment, verdict: Verdict) -> tuple[Alignment, Verdict, str]:
        """Return an alignment in the given frames, its verdict, and a note for a rejection."""
        pairs = self._refinement.pairs
        heights = heights_of(pairs, refined, self._refinement.gate_m)
        moved = replace(self._moved(refined), heights=heights)
        notes = [pairs.correspondences.set_aside, shared_observations(pairs, refined)]
        tilt, names = "", (pairs.map_a.name, pairs.map_b.name)
        if heights is not None:
            tilt = heights.tilt_note(*names)
            notes.insert(0, heights.offset_note(*names))
        if not verdict.accepted:
            return moved, verdict, tilt
        if heights is not None and heights.loses_pairs:
            return moved, replace(verdict, status=Status.REFUSED, reason=tilt), ""
        reason = "; ".join(filter(None, (verdict.reason, tilt, *notes)))
        return moved, replace(verdict, reason=reason), ""

    def _moved(self, local: Alignment) -> Alignment:
        """Return an alignment in the given frames."""
        pairs = self._refinement.pairs
        assert pairs.origins is not None
        if not np.isfinite(local.T_a_b).all():
            return local
        overlap, p_b = None, pairs.p_b[local.inlier]
        if len(p_b):
            overlap = Overlap.of(local.T_a_b, local.covariance, p_b).moved(*pairs.origins)
        T_a_b, covariance = pairs.given_motion(local.T_a_b, local.covariance)
        return replace(local, T_a_b=T_a_b, covariance=covariance, overlap=overlap)


def heights_of(pairs: Pairs, alignment: Alignment, gate_m: float) -> HeightDifference | None:
    """Compare the heights of two maps at the pairs within `gate_m` of an alignment in plan.

    The pairs include those that fail the test of heights: of maps matched by geometry, the
    landmarks that are nearest to each other in plan. Returns None for planar maps.
    """
    if pairs.planar:
        return None
    offered = pairs.correspondences.at_any_height
    if pairs.by_geometry:
        a, b = pairs.map_a.position_m[:, :2], pairs.map_b.position_m[:, :2]
        moved = transform_points(alignment.T_a_b, b)
        to_a, to_b = (
            scipy.spatial.KDTree(a).query(moved)[1],
            scipy.spatial.KDTree(moved).query(a)[1],
        )
        rows = np.flatnonzero(to_b[to_a] == np.arange(len(b)))
        offered = Correspondences(to_a[rows], rows, np.zeros(len(rows)))
    free = pairs if offered is None else Pairs(pairs.map_a, pairs.map_b, offered)
    is_near = np.linalg.norm(residuals(alignment.T_a_b, free.p_a, free.p_b), axis=1) <= gate_m
    supports = np.isin(free.index_a, pairs.index_a[alignment.inlier])
    gate = HeightGate()
    variance = free.covariance_a[:, 2, 2] + free.covariance_b[:, 2, 2] + gate.floor_m**2
    removed_m = pairs.correspondences.height_offset_m
    parts = (free.p_a[is_near], free.p_b[is_near], variance[is_near], gate.bound, supports[is_near])
    return height_difference(*parts, removed_m)


# Probability that independent observations of a landmark agree as closely as copies do.
_COPY_CHANCE = 1e-6
_MOST_COPIES = 500  # pairs whose distances are compared


def _coincident(pairs: Pairs, T_a_b: Float) -> np.ndarray:
    """Mark the pairs, bool (N,), whose residuals are far below their standard deviation."""
    e = residuals(T_a_b, pairs.p_a, pairs.p_b)
    S = residual_covariances(T_a_b, pairs.covariance_a, pairs.covariance_b)
    square = np.vecdot(e, np.linalg.solve(S + 1e-18 * np.eye(2), e[..., None])[..., 0])
    return square <= chi_square_bound(_COPY_CHANCE, 2)


def _motion_of_copies(pairs: Pairs, T_a_b: Float) -> Float:
    """Return the motion (3,) of the pairs that may be copies; `T_a_b` if fewer than three may be.

    A fused map keeps the landmarks of one map that no other map has. Their distances to each other
    are equal in both maps. The other pairs displace the motion of all pairs by more than that.
    """
    some = pairs[np.arange(0, len(pairs), -(-len(pairs) // _MOST_COPIES))]
    residual_covariance = residual_covariances(T_a_b, some.covariance_a, some.covariance_b)
    variance = np.trace(residual_covariance, axis1=1, axis2=2) / 2
    apart_a, apart_b = (
        np.linalg.norm(p[:, None, :2] - p[None, :, :2], axis=2) for p in (some.p_a, some.p_b)
    )
    square = (apart_a - apart_b) ** 2 / (variance[:, None] + variance + 1e-18)
    equal = square <= chi_square_bound(_COPY_CHANCE, 1)
    group = np.flatnonzero(equal[np.argmax(np.sum(equal, axis=1))])
    if len(group) < MIN_PAIRS:
        return T_a_b
    return np.array(fit_rigid(some.p_a, some.p_b, group))


def shared_observations(pairs: Pairs, alignment: Alignment) -> str:
    """Say that supporting pairs are copies of the same observations; empty if fewer than three are.

    Independent observations have neither equal descriptors nor residuals far below their standard
    deviation.
    """
    used = pairs[alignment.inlier]
    if not len(used):
        return ""
    coincide = _coincident(used, alignment.T_a_b)
    coincide |= _coincident(used, _motion_of_copies(used, alignment.T_a_b))
    copied = coincide.copy()
    a, b, kind = pairs.map_a.descriptor, pairs.map_b.descriptor, pairs.map_a.descriptor_kind
    # bits that do not differ may be those of another observation
    if a is not None and b is not None and kind is not None and kind.metric != "hamming":
        copied |= np.all(a[used.index_a] == b[used.index_b], axis=1)
    n, n_all = int(np.count_nonzero(copied)), len(used)
    if n < MIN_PAIRS:
        return ""
    names = f"{pairs.map_a.name} and {pairs.map_b.name}"
    if coincide.all() and n_all == len(pairs.map_a) == len(pairs.map_b):
        return f"{names} are the same map: a fusion adds nothing, and its covariances are too small"
    return (
        f"{n} of {n_all} pairs are the same observations in {names}: the maps are not independent, "
        "and fused covariances are too small"
    )


def supported_by(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, started_s: float, refusal: str = ""
) -> Alignment:
    """Return the alignment of a motion fitted to some pairs by least squares with equal weights.

    Args:
        pairs: all N pairs.
        inlier: (N,) bool, True for the fitted pairs.
        T_a_b: (3,) the motion.
        started_s: `time.perf_counter()` at the start.
        refusal: reason to reject the estimate; empty for none.
    """
    motion = supported(pairs, inlier, T_a_b, refusal)
    return alignment_of_fit(motion, pairs, np.arange(len(pairs)), started_s)
