"""Align two maps, or merge several, in one call; the results describe, draw and convert themselves.

A map is a `LandmarkMap`, the path of its file, or a pandas table with the columns of such a file.
"""

import html
import itertools
import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mapfusion.align.aligners import Aligner, make_aligner
from mapfusion.align.alignment import NOT_RUN, Alignment, Method, Pairs, Status
from mapfusion.align.correspondences import (
    Correspondences,
    MatchParameters,
    match,
)
from mapfusion.align.rigid_motion import residuals
from mapfusion.descriptors import DescriptorKind, require_one_kind
from mapfusion.errors import InputError, TellingWarning
from mapfusion.files import Write, write_all_atomically
from mapfusion.fusion.fusers import (
    USUAL,
    AlignedPair,
    FusedMap,
    Fuser,
    Fusion,
    MergeParameters,
    make_fuser,
    name_order,
)
from mapfusion.fusion.merge import merge
from mapfusion.fusion.team_graph import EdgeStatus
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import motion_sigma, rms_distance_m
from mapfusion.landmark_map import LandmarkMap, map_writes, read_map
from mapfusion.plotting import Plan, fused_plan, pair_plan, plot_plans
from mapfusion.tables import NO_LABEL
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.registration import (
    PairRegistration,
    Registered,
    Registration,
)
from mapfusion.verification.rivals import (
    DISTINCT_M,
    SupportedMotion,
    distinct_motions,
    is_mirrored,
    other_unit,
)
from mapfusion.verification.verdict import PairEvidence

if TYPE_CHECKING:  # results are printed and written without data frames and figures
    import pandas as pd
    from matplotlib.figure import Figure

    MapLike = LandmarkMap | str | os.PathLike[str] | pd.DataFrame

# Ratio of the sigmas at the origin and at the overlap from which on T_a_b alone misleads.
_LEVER = 30
_MOST_RIVALS = 3  # motions beside the estimate; pictures of more are not legible
# Of maps that are not plausible: span in degrees, distance from the origin over the span, median
# sigma over the span.
_LARGEST_DEGREES, _FAR, _LARGEST_SIGMA = 0.1, 50.0, 0.25
_FEWEST = 3  # landmarks that show the span of a map
_MAX_LABELS = 3  # in one message
_MOST_PAIRS = 6  # of maps in a picture, two rows of plans
# What a user can do about an alignment that is not accepted.
_REMEDIES = {
    Status.AMBIGUOUS: "Merge with a third map that overlaps both, or map more of the places that "
    "do not look alike",
    Status.TOO_UNCERTAIN: "Map more common landmarks, farther apart",
    Status.REFUSED: "If both maps show the same place, map more of it with both robots; if they do "
    "not, they cannot be aligned",
    Status.FAILED: "Correct the aligner, or choose another one",
    Status.ABSENT: "Choose another aligner",
}
# Reasons why the team does not use an accepted alignment.
_TEAM_REASONS = {
    EdgeStatus.UNCONFIRMED: "no other alignment confirms this one",
    EdgeStatus.CONTRADICTED: "other alignments contradict this one",
    EdgeStatus.AMBIGUOUS: "several motions fit, and other alignments do not tell which is right",
}


@dataclass(frozen=True, repr=False, eq=False)
class MapAlignment:
    """Alignment of two maps by one method, with refinement and verdict.

    Attributes:
        map_a: map in frame a.
        map_b: map in frame b.
        correspondences: N correspondences of the two maps.
        aligner: name of the method.
        registered: the estimate, its refinement and the verdict.
        registration: settings of refinement and verdict.
        matching: parameters of the matching.
        ready: registration prepared for these maps.
    """

    map_a: LandmarkMap
    map_b: LandmarkMap
    correspondences: Correspondences
    aligner: str
    registered: Registered
    registration: Registration
    matching: MatchParameters
    ready: PairRegistration

    @property
    def status(self) -> Status:
        """Outcome: accepted, refused, ambiguous, too uncertain, failed or absent."""
        if self.registered.estimated.status in NOT_RUN:
            return self.registered.estimated.status
        status = self.registered.verdict.status
        return Status.REFUSED if status is Status.DEGENERATE else status

    @property
    def accepted(self) -> bool:
        """True if the motion may be used."""
        return self.status is Status.ACCEPTED

    @property
    def reason(self) -> str:
        """Reason of a refusal, or a remark on an accepted alignment; empty if there is none."""
        estimated, refined, verdict = self.registered
        return estimated.reason or refined.reason or verdict.reason

    @property
    def T_a_b(self) -> Float:  # noqa: N802  # a motion, as everywhere
        """Refined motion (3,): tx_m, ty_m, theta_rad; NaN if there is none."""
        return self.registered.refined.T_a_b

    @property
    def covariance(self) -> Float:
        """Covariance (3, 3) of the refined motion."""
        return self.registered.refined.covariance

    @property
    def inlier(self) -> np.ndarray:
        """Correspondences that support the refined motion, bool (N,)."""
        return self.registered.refined.inlier

    @property
    def alignment(self) -> Alignment:
        """Refined alignment with the status of the verdict, for `fuse_maps`."""
        applied = self.registered.applied
        if applied.status in NOT_RUN:  # the reason does not name the aligner
            return replace(applied, reason=f"{self.aligner}: {applied.status}: {applied.reason}")
        if not applied.ok and self.cause:
            replaced = f"; {self._note}" if self.hint == self.cause else ""
            reason = applied.reason.removesuffix(replaced)
            return replace(applied, reason=f"{reason}; {self.cause}")
        return applied

    @cached_property
    def cause(self) -> str:
        """Say which property of the maps is the likely cause of a refusal; empty if none is."""
        if self.accepted:
            return ""
        if odd := self._degrees or too_large_sigma(self.map_a) or too_large_sigma(self.map_b):
            return odd
        a, b, refinement = self.map_a.name, self.map_b.name, self._refinement
        if is_mirrored(self.ready.pairs, self._acceptance, refinement, self.matching):
            image = "look like mirror images of each other: check the signs of y and "
            image += "theta, and the order of x and y"
            return f"{a} and {b} {image}"
        unit, in_unit = other_unit(self.ready.pairs, self._acceptance, refinement, self.matching)
        if unit and all(in_unit):
            return f"{a} and {b} fit each other as maps in {unit}: write both in metres"
        if unit:
            name, other = (a, b) if in_unit[0] else (b, a)
            return f"{name} fits {other} if it is in {unit}: write it in metres"
        return ""

    @property
    def _note(self) -> str:
        return self.ready.pairs.note(int(np.count_nonzero(self.inlier)))

    @property
    def hint(self) -> str:
        """Property of the maps that may explain a refusal; empty if none is found."""
        if self.accepted or self.status in NOT_RUN:
            return ""
        return self._degrees or self.ready.pairs.scale_note or self.cause or self._note

    @property
    def bare_reason(self) -> str:
        """`reason` without its note on the maps, which `hint` tells or replaces."""
        return self.reason.removesuffix(f"; {self._note}")

    @property
    def _degrees(self) -> str:
        return in_degrees(self.map_a) or in_degrees(self.map_b)

    @property
    def far_away(self) -> str:
        """Say what a motion of maps far from their origin means; empty if it is near."""
        overlap = self.registered.refined.overlap
        if overlap is None:
            return ""
        sigma_m, at_overlap_m = (motion_sigma(S)[0] for S in (self.covariance, overlap.covariance))
        if sigma_m < max(_LEVER * at_overlap_m, DISTINCT_M):
            return ""
        name, (dx, dy) = self.map_b.name, overlap.p_a - overlap.p_b
        away_km = np.linalg.norm(overlap.p_b) / 1e3
        return (
            f"The overlap lies {away_km:.1f} km from the origin of {name}, where T_a_b has a sigma "
            f"of {sigma_m:.0f} m; at the overlap it moves {name} by "
            f"({dx:.3f} m, {dy:.3f} m)."
        )

    @cached_property
    def other_motions(self) -> list[SupportedMotion]:
        """Other motions that many correspondences support, the best supported first."""
        pairs, p_b, T = self.ready.pairs, self.map_b.position_m[:, :2], self.T_a_b
        local = distinct_motions(pairs, _MOST_RIVALS + 1, self._acceptance, self._refinement)
        motions = [each._replace(T_a_b=pairs.given_motion(each.T_a_b)[0]) for each in local]
        rivals = [each for each in motions if not rms_distance_m(T, each.T_a_b, p_b) < DISTINCT_M]
        return sorted(rivals, key=lambda each: -np.count_nonzero(each.inlier))[:_MOST_RIVALS]

    @property
    def _acceptance(self) -> Acceptance:
        verifier = self.registration.verifier
        return Acceptance() if verifier is None else verifier.acceptance

    @property
    def _refinement(self) -> Any:
        return self.registration.refinement

    @property
    def refusal(self) -> str:
        """Reason why the motion is not accepted, and a remedy."""
        reason = self.bare_reason
        why = _sentence(f"{self.aligner}: {str(self.status).replace('_', ' ')}: {reason}")
        heights = self.registered.refined.heights
        asks = reason.endswith("?") and not self.hint  # for a likely cause, such as another unit
        described = [each.descriptor is not None for each in (self.map_a, self.map_b)]
        unlike = not len(self.correspondences) and described[0] != described[1]
        if asks or unlike or (heights is not None and heights.loses_pairs):
            return why  # the reason says what to do
        return f"{why} {_sentence(self.hint or _REMEDIES[self.status])}"

    @property
    def advice(self) -> str:
        """Sentences on the motion to use and its uncertainty, or on why there is none."""
        return advice([self])

    def to_pandas(self) -> "pd.DataFrame":
        """Return a row for each correspondence.

        Columns are the rows of both maps, the distance of the descriptors, whether the
        correspondence supports the motion, and the distance in the plane under the motion.
        """
        import pandas as pd

        pairs = Pairs(self.map_a, self.map_b, self.correspondences)
        residual = residuals(self.T_a_b, pairs.p_a, pairs.p_b)
        return pd.DataFrame(
            {
                "landmark_a": self.correspondences.index_a,
                "landmark_b": self.correspondences.index_b,
                "descriptor_distance": self.correspondences.distance,
                "inlier": self.inlier,
                "residual_m": np.hypot(*residual[:, :2].T),
            }
        )

    def plans(self) -> list[Plan]:
        """Return the plans of both maps under the motion, and under each of the other motions."""
        status = str(self.status).replace("_", " ")
        title = f"{status}: {self.map_b.name} in the frame of {self.map_a.name} by {self.aligner}"
        if np.isnan(self.T_a_b).any():
            title = f"{status}: {self.map_b.name} drawn beside {self.map_a.name}"
        motions = [(title, self.T_a_b, self.inlier)]
        for each in self.other_motions:
            title = f"another motion:\n{motion_text(each.T_a_b)},\n"
            title += f"{np.count_nonzero(each.inlier)} of {len(self.inlier)} correspondences"
            motions.append((title, each.T_a_b, each.inlier))
        return [self.plan(title, np.zeros(3), T, inlier) for title, T, inlier in motions]

    def plan(
        self,
        title: str,
        T_a: Float,
        T_b: Float,
        inlier: np.ndarray,
        places: tuple[int, int] = (0, 1),
    ) -> Plan:
        """Return the plan of both maps at two poses (3,), with some correspondences accepted."""
        index = self.correspondences.index_a, self.correspondences.index_b
        return pair_plan(title, (self.map_a, self.map_b), (T_a, T_b), index, inlier, places)

    def plot(self) -> "Figure":
        """Draw `plans` with `advice`; returns a figure of Matplotlib, for its `savefig`."""
        return plot_plans(self.plans(), self.advice)

    def __repr__(self) -> str:
        a, b = self.map_a.name, self.map_b.name
        n = f"{np.count_nonzero(self.inlier)} of {len(self.inlier)} correspondences"
        motion = f", T_a_b = {motion_text(self.T_a_b)}" if self.accepted else ""
        return f"<MapAlignment of {a} and {b} by {self.aligner}: {self.status}{motion}, {n}>"

    def _repr_html_(self) -> str:
        return _html(self.advice, self.to_pandas())


def in_degrees(landmarks: LandmarkMap) -> str:
    """Say that a map looks like longitudes and latitudes; empty if it does not.

    Their span is a small part of a metre, and they are far from the origin.
    """
    p_planar = landmarks.position_m[:, :2]
    if len(p_planar) < _FEWEST or np.abs(p_planar).max() > 180:
        return ""
    span, middle = float(np.ptp(p_planar, axis=0).max()), np.median(p_planar, axis=0)
    if span >= min(_LARGEST_DEGREES, float(np.abs(middle).max()) / _FAR):
        return ""
    extent_text = f"all within {span:.2g} of ({middle[0]:.4f}, {middle[1]:.4f})"
    degrees_text = "look like longitude and latitude in degrees"
    text = f"x_m and y_m of {landmarks.name} {degrees_text} ({extent_text})"
    return f"{text}: project them to metres, such as UTM"


def too_large_sigma(landmarks: LandmarkMap) -> str:
    """Say that the covariances of a map are too large for its span; empty if they are not."""
    p_planar = landmarks.position_m[:, :2]
    if len(p_planar) < _FEWEST:
        return ""
    variance = np.trace(landmarks.covariance_m2[:, :2, :2], axis1=1, axis2=2) / 2
    sigma_m, span_m = float(np.sqrt(np.median(variance))), float(np.ptp(p_planar, axis=0).max())
    if sigma_m <= _LARGEST_SIGMA * span_m:
        return ""
    sigma_text = f"a median sigma of {sigma_m:.3g} m in a map that spans {span_m:.3g} m"
    question = "is --sigma, or are the covariances, too large or in another unit?"
    return f"landmarks of {landmarks.name} have {sigma_text}: {question}"


def motion_text(T: Float) -> str:
    """Write a motion (3,) with its units."""
    x, y, theta = (0.0 if abs(each) < 5e-5 else float(each) for each in T)  # no "-0.000"
    return f"({x:.3f} m, {y:.3f} m, {theta:.4f} rad)"


def sigma_text(covariance: Float, lower_bound: bool) -> str:
    """Write the standard deviations of the distance and the angle of a motion."""
    m, rad = map(float, motion_sigma(covariance))
    bound = "≥ " if lower_bound else ""
    return f"sigma {bound}{sigma_number(m, 3)} m, {bound}{sigma_number(rad, 4)} rad"


def sigma_number(sigma: float, digits: int) -> str:
    """Write a standard deviation with some decimals; a small one with two significant digits."""
    return f"{sigma:.{digits}f}" if sigma >= 10 ** (1 - digits) else f"{sigma:.2g}"


def _html(text: str, table: "pd.DataFrame") -> str:
    return f"<p>{html.escape(text)}</p>{table.to_html(max_rows=6, float_format='{:.3f}'.format)}"


def best_alignment(alignments: Sequence[MapAlignment]) -> MapAlignment:
    """Return the accepted alignment that chance explains least; else the nearest to acceptance."""
    return min(alignments, key=lambda each: (_RANKS.index(each.status), _log10_chance(each)))


def _log10_chance(alignment: MapAlignment) -> float:
    log10 = alignment.registered.verdict.log10_false_alarms
    return math.inf if math.isnan(log10) else log10


def advice(alignments: Sequence[MapAlignment]) -> str:
    """Say in a few sentences which motion to use, how sure it is, or why not and what to do.

    Args:
        alignments: alignments of the same two maps by different methods, at least one.
    """
    best, several = best_alignment(alignments), len(alignments) > 1
    if not best.accepted:
        tried = f"None of {len(alignments)} methods has an accepted motion. " if several else ""
        return f"Use no T_a_b. {tried}{best.refusal}"
    p_b = best.map_b.position_m[:, :2]
    accepted = [each for each in alignments if each.accepted]
    others = [e for e in accepted if rms_distance_m(best.T_a_b, e.T_a_b, p_b) >= DISTINCT_M]
    if others:
        listed = ", ".join(f"{motion_text(e.T_a_b)} of {e.aligner}" for e in [best, *others])
        return (
            f"Use no T_a_b without a check: accepted motions contradict each other: {listed}. "
            "Merge with a third map that overlaps both, which can decide."
        )
    refined = best.registered.refined
    text = f"Use T_a_b = {motion_text(best.T_a_b)} of {best.aligner}"
    at_overlap = refined.covariance if refined.overlap is None else refined.overlap.covariance
    text += f", {sigma_text(at_overlap, refined.lower_bound)} where the maps overlap. It is "
    text += "accepted"
    text += f": {np.count_nonzero(best.inlier)} of {len(best.inlier)} correspondences support it, "
    log10_pairs = -_log10_chance(best)
    n_pairs = f"1e{log10_pairs:.0f}" if math.isfinite(log10_pairs) else "an unknown number of"
    text += f"chance gives as much once in {n_pairs} pairs of maps"
    if several:
        agree = "all" if len(accepted) == len(alignments) else f"{len(accepted)} of"
        text += f", and {agree} {len(alignments)} methods agree"
    text += "."
    if best.far_away:
        text += f" {best.far_away}"
    return f"{text} Note: {_sentence(best.reason)}" if best.reason else text


_RANKS = [Status.ACCEPTED, Status.AMBIGUOUS, Status.TOO_UNCERTAIN, Status.REFUSED]
_RANKS += [Status.DEGENERATE, Status.FAILED, Status.ABSENT]


def _sentence(text: str) -> str:
    return text if text.endswith((".", "?")) else f"{text}."


@dataclass(frozen=True, repr=False, eq=False)
class MergedMaps:
    """Maps that were aligned and merged.

    Attributes:
        maps: the M maps.
        alignments: alignment of each pair of maps, by their numbers.
        pairs: the same in the order of `fusion.edge_status`, with the alternatives of ambiguous
            alignments.
        fusion: fused maps.
        aligner: name of the aligner.
    """

    maps: tuple[LandmarkMap, ...]
    alignments: Mapping[tuple[int, int], MapAlignment]
    pairs: Sequence[AlignedPair]
    fusion: Fusion
    aligner: str

    @property
    def any_merged(self) -> bool:
        """True if two or more maps were merged."""
        return len(self.fused.members) > 1

    @property
    def fused(self) -> FusedMap:
        """Fused map of most maps; of the first map only if no two maps were merged."""
        return self.fusion.fused[0]

    @property
    def landmarks(self) -> LandmarkMap:
        """Landmarks of the fused map.

        Raises:
            InputError: no two maps were merged.
        """
        if not self.any_merged:
            raise InputError(self.advice)
        return self.fused.landmarks

    def reasons(self) -> dict[tuple[int, int], str]:
        """Return by pair of maps the reason why their alignment is not used; empty if it is."""
        reasons: dict[tuple[int, int], str] = {}
        for pair, edge_status in zip(self.pairs, self.fusion.edge_status, strict=True):
            reason = pair.alignment.reason or _TEAM_REASONS.get(edge_status, "")
            if edge_status in (EdgeStatus.CONFIRMED, EdgeStatus.BRIDGE):
                reasons[pair.a, pair.b] = ""
            else:
                reasons.setdefault((pair.a, pair.b), reason)
        return reasons

    @property
    def notes(self) -> dict[tuple[int, int], str]:
        """Remarks on accepted alignments, by pair of maps."""
        return {
            pair: alignment.registered.verdict.reason
            for pair, alignment in self.alignments.items()
            if alignment.registered.verdict.accepted and alignment.registered.verdict.reason
        }

    @property
    def note(self) -> str:
        """Notes on the alignments that are used, in one line; empty if there is none."""
        used, notes = [pair for pair, reason in self.reasons().items() if not reason], self.notes
        note_texts = [notes[pair] for pair in used if pair in notes]
        if not note_texts:
            return ""
        others = (
            f" (and for {len(note_texts) - 1} more pairs of maps)" if len(note_texts) > 1 else ""
        )
        return f"{note_texts[0]}{others}"

    def is_lower_bound(self, fused: FusedMap) -> bool:
        """Return True if the covariances of a fused map's motions are lower bounds.

        They are if a used alignment is of a map that does not state all errors that its landmarks
        share.
        """
        used = {pair for pair, reason in self.reasons().items() if not reason}
        members = set(fused.members.tolist())
        of_fused = (p for p in self.pairs if (p.a, p.b) in used and {p.a, p.b} <= members)
        return any(pair.alignment.lower_bound for pair in of_fused)

    @property
    def advice(self) -> str:
        """Sentences on the merged maps, their uncertainty, and the maps that were left out."""
        if not self.any_merged:
            (a, b), first = min(
                self.alignments.items(), key=lambda each: _RANKS.index(each[1].status)
            )
            why = _sentence(self.reasons()[a, b]) if first.accepted else first.refusal
            return f"No two maps were merged. {self.maps[a].name} and {self.maps[b].name}: {why}"
        fused, names = self.fused, [self.maps[k].name for k in self.fused.members]
        several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
        largest = max(fused.stated_covariance[fused.members], key=lambda S: S[0, 0] + S[1, 1])
        text = (
            f"Merged {len(names)} of {len(self.maps)} maps ({', '.join(names)}): "
            f"{len(fused.landmarks)} landmarks in the frame of {names[0]}, {several} of several "
            f"maps. Largest {sigma_text(largest, self.is_lower_bound(fused))}."
        )
        if self.note:
            text += f" Note: {_sentence(self.note)}"
        elsewhere = set[str]()
        for other in self.fusion.fused[1:]:
            own = [self.maps[k].name for k in other.members]
            text += f" {', '.join(own[:-1])} and {own[-1]} make a map of their own."
            elsewhere |= set(own)
        left = [
            f"{name} is left out: {_sentence(reason)}"
            for name, reason in fused.left_out
            if name not in elsewhere
        ]
        return " ".join([text, *left])

    def write(self, path: str | os.PathLike[str]) -> list[Path]:
        """Write all fused maps or none, as `write_map` does, and return the paths.

        The map of most robots is written to `path`, others beside it (see `numbered_path`).

        Raises:
            InputError: no two maps were merged.
            OSError: a file cannot be written; existing files are then unchanged.
        """
        if not self.any_merged:
            raise InputError(self.advice)
        fused = self.fusion.fused
        paths = [numbered_path(Path(path), k) for k in range(1, len(fused) + 1)]
        writes: dict[Path, Write] = {}
        for fused_path, each in zip(paths, fused, strict=True):
            writes |= map_writes(fused_path, each.landmarks)
        write_all_atomically(writes)
        return paths

    def to_pandas(self) -> "pd.DataFrame":
        """Return the fused landmarks, and for each of the M maps the row of its landmark or -1.

        Raises:
            InputError: no two maps were merged.
        """
        table = self.landmarks.to_pandas()
        for k in range(len(self.maps)):
            table[f"row_in_map_{k + 1}"] = self.fused.parents[:, k]
        return table

    def plans(self) -> list[Plan]:
        """Return the plans of the fused map and of the first pairs of maps.

        Without a fused map they are those of the first pair, with its other motions.
        """
        if not self.any_merged:
            return next(iter(self.alignments.values())).plans()
        fused = self.fused
        title = f"fused map, in the frame of {self.maps[fused.members[0]].name}"
        plans = [fused_plan(title, fused.landmarks, fused.parents, self.maps)]
        for (a, b), alignment in itertools.islice(self.alignments.items(), _MOST_PAIRS):
            pair_name = f"{alignment.map_a.name} and {alignment.map_b.name}"
            T_a, T_b = fused.T_first_map[a], fused.T_first_map[b]
            title = f"{pair_name}:\n{str(alignment.status).replace('_', ' ')}"
            if np.isnan(T_a).any() or np.isnan(T_b).any():
                T_a, T_b = np.zeros(3), alignment.T_a_b
                title = f"{title}, not merged"
            inlier = alignment.inlier
            title += f",\n{np.count_nonzero(inlier)} of {len(inlier)} correspondences"
            plans.append(alignment.plan(title, T_a, T_b, inlier, (a, b)))
        return plans

    def plot(self) -> "Figure":
        """Draw `plans` with `advice`; returns a figure of Matplotlib, for its `savefig`."""
        return plot_plans(self.plans(), self.advice)

    def __repr__(self) -> str:
        if not self.any_merged:
            return f"<MergedMaps: no two of {len(self.maps)} maps were merged>"
        n, n_maps = len(self.fused.landmarks), len(self.fused.members)
        return f"<MergedMaps: {n} landmarks of {n_maps} of {len(self.maps)} maps, {self.aligner}>"

    def _repr_html_(self) -> str:
        if not self.any_merged:
            return f"<p>{html.escape(self.advice)}</p>"
        return _html(self.advice, self.to_pandas())


def numbered_path(path: Path, k: int) -> Path:
    """Return the path of the k-th fused map: `path` for k = 1, then `.2` and so on."""
    return path if k == 1 else path.with_stem(f"{path.stem}.{k}")


def load_maps(
    maps_by_name: Mapping[str, "MapLike"], sigma_m: float | None = None, descriptor_metric: str = ""
) -> list[LandmarkMap]:
    """Load maps from map objects, file paths or tables.

    Args:
        maps_by_name: maps, paths or tables, by the name that a table's map gets.
        sigma_m: standard deviation per axis of landmarks without covariances.
        descriptor_metric: metric of descriptors that state none.

    Raises:
        InputError: a file or a table is not as documented, or descriptors are of different kinds.
        TypeError: a map is none of these.
    """
    if sigma_m is not None and not 0 < sigma_m < math.inf:
        raise InputError(f"sigma_m: is {sigma_m:g}, expected a positive number of metres")
    loaded, kinds = list[LandmarkMap](), list[tuple[str, DescriptorKind | None]]()
    opened = list[tuple[str, LandmarkMap]]()
    for name, each in maps_by_name.items():
        if isinstance(each, LandmarkMap):
            landmarks, place = each, each.called
        elif isinstance(each, str | os.PathLike):
            landmarks, place = read_map(Path(each), False, sigma_m, descriptor_metric), str(each)
        elif hasattr(each, "columns"):
            own = LandmarkMap.from_pandas(each, name, sigma_m, descriptor_metric)
            landmarks, place = own, name
        else:
            kinds_of_map = "a LandmarkMap, the path of a file or a pandas DataFrame"
            raise TypeError(f"{name}: is {type(each).__name__}, expected {kinds_of_map}")
        loaded.append(landmarks)
        kinds.append((place, landmarks.descriptor_kind))
        if not isinstance(each, LandmarkMap):  # loaded before
            opened.append((place, landmarks))
    require_one_kind(kinds)
    if sum(each.label is not None for each in loaded) > 1:
        for place, landmarks in opened:
            if warning := _repeated_labels(landmarks):
                warnings.warn(f"{place}: {warning}", TellingWarning, stacklevel=3)
    return loaded


def _repeated_labels(landmarks: LandmarkMap) -> str:
    """Say which labels of a map are on several landmarks; empty if none is."""
    if landmarks.label is None:
        return ""
    labels, n = np.unique(landmarks.label[landmarks.label != NO_LABEL], return_counts=True)
    rows = np.flatnonzero(n > 1)
    if not len(rows):
        return ""
    texts = [f"label {labels[k]} is on {n[k]} landmarks" for k in rows[:_MAX_LABELS]]
    texts += [f"{len(rows) - len(texts)} more are on several"] if len(rows) > len(texts) else []
    rule = "of each only the landmark with the largest count is matched (the first, if equal)"
    return f"{', '.join(texts)}, of {len(labels)} labels: {rule}; give each landmark its own label"


def _registration(aligner: "str | Method | Aligner | Registration") -> Registration:
    if isinstance(aligner, Registration):
        return aligner
    return Registration(make_aligner(aligner) if isinstance(aligner, str) else aligner)


def _name_of(aligner: Any) -> str:
    return aligner if isinstance(aligner, str) else type(_registration(aligner).method).__name__


def align_maps(
    map_a: "MapLike",
    map_b: "MapLike",
    *,
    aligner: "str | Method | Aligner | Registration" = "ransac",
    name: str = "",
    matching: MatchParameters = MatchParameters(),  # noqa: B008  # frozen
    correspondences: Correspondences | None = None,
    evidence: PairEvidence | None = None,
    sigma_m: float | None = None,
    descriptor_metric: str = "",
    rng: np.random.Generator | int = 0,
) -> MapAlignment:
    """Align two maps: match their landmarks, estimate T_a_b, refine and verify it.

    Args:
        map_a: map in frame a.
        map_b: map in frame b.
        aligner: name of a built-in method, a method, or a `Registration` with settings of the
            refinement and the verdict.
        name: name of the aligner in the result; empty: that of its class.
        matching: parameters of the matching.
        correspondences: correspondences found earlier for these maps; None to match them.
        evidence: evidence found earlier for these maps; None to compute it.
        sigma_m: standard deviation per axis of landmarks without covariances.
        descriptor_metric: metric of descriptors that state none: `euclidean`, `cosine` or
            `hamming`; empty: that of their type and length.
        rng: generator, or its seed.

    Raises:
        InputError: a map cannot be read, or the descriptors are of different kinds.
        TypeError: a map is no `LandmarkMap`, path or data frame.
        ValueError: the aligner is unknown.
    """
    a, b = load_maps({"a": map_a, "b": map_b}, sigma_m, descriptor_metric)
    registration = _registration(aligner)
    pairs = match(a, b, matching) if correspondences is None else correspondences
    ready = registration.on(a, b, pairs, evidence)
    done = ready.register(np.random.default_rng(rng))
    used = name or _name_of(aligner)
    return MapAlignment(a, b, pairs, used, done, registration, matching, ready)


def merge_maps(
    maps: "Iterable[MapLike]",
    *,
    aligner: "str | Method | Aligner | Registration" = "ransac",
    name: str = "",
    matching: MatchParameters = MatchParameters(),  # noqa: B008  # frozen
    fuser: str | Fuser = USUAL,
    parameters: MergeParameters = MergeParameters(),  # noqa: B008  # frozen
    sigma_m: float | None = None,
    descriptor_metric: str = "",
    rng: "int | Callable[[LandmarkMap, LandmarkMap], np.random.Generator]" = 0,
) -> MergedMaps:
    """Align all pairs of maps, and fuse the maps that accepted alignments connect.

    The maps of a pair are in the order of their names. Other arguments are those of `align_maps`.

    Args:
        maps: M maps, at least two.
        aligner: method that aligns each pair.
        name: name of the aligner in the result.
        matching: parameters of the matching.
        fuser: name of a fuser, or a fuser.
        parameters: parameters of the merge.
        sigma_m: standard deviation per axis of landmarks without covariances.
        descriptor_metric: metric of descriptors that state none.
        rng: seed of the generator of each pair, or a function that returns this generator.

    Raises:
        InputError: there are fewer than two maps, a map cannot be read, or the descriptors are of
            different kinds.
        ValueError: the aligner or the fuser is unknown.
    """
    if isinstance(maps, str | os.PathLike | LandmarkMap | Mapping) or hasattr(maps, "columns"):
        raise TypeError(f"maps: is {type(maps).__name__}, expected a list of maps")
    maps = list(maps)
    if len(maps) < 2:
        raise InputError("merge: give two maps or more")
    named = {f"map {k}": each for k, each in enumerate(maps, start=1)}
    loaded = tuple(load_maps(named, sigma_m, descriptor_metric))
    places = [os.fspath(each) if isinstance(each, str | os.PathLike) else "" for each in maps]
    order = sorted(range(len(maps)), key=lambda k: (name_order(loaded[k].name), places[k]))
    alignments, pairs = dict[tuple[int, int], MapAlignment](), list[AlignedPair]()
    for a, b in itertools.combinations(order, 2):
        found = align_maps(
            loaded[a],
            loaded[b],
            aligner=_registration(aligner),
            name=name or _name_of(aligner),
            matching=matching,
            rng=rng(loaded[a], loaded[b]) if callable(rng) else rng,
        )
        alignments[a, b] = found
        offered, chance = found.correspondences, found.registered.verdict.log10_false_alarms
        pairs.append(AlignedPair(a, b, found.alignment, offered, chance))
        if found.status is Status.AMBIGUOUS:
            rivals = found.ready.rivals_of(found.registered.refined)
            pairs += [AlignedPair(a, b, rival, offered, chance) for rival in rivals]
    by = make_fuser(fuser) if isinstance(fuser, str) else fuser
    fusion = merge(loaded, pairs, parameters, by)
    return MergedMaps(loaded, alignments, pairs, fusion, name or _name_of(aligner))
