"""Input and result of an aligner: corresponding landmarks side by side, and the alignment."""

import time
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np

from mapfusion.align.correspondences import FEW, Correspondences, HeightGate, scale_note
from mapfusion.align.mahalanobis_gate import PlanarPairs
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap


class Status(StrEnum):
    """Outcome of an alignment."""

    ACCEPTED = "accepted"
    REFUSED = "refused"  # a motion was found but failed a test
    AMBIGUOUS = "ambiguous"  # another motion may be the right one
    TOO_UNCERTAIN = "too_uncertain"  # the covariance is too large
    DEGENERATE = "degenerate"  # the data do not determine a motion
    FAILED = "failed"  # the method raised, hung, ended its process or returned an invalid answer
    ABSENT = "absent"  # the package of the method is not installed


NOT_RUN = frozenset({Status.FAILED, Status.ABSENT})  # statuses without a result for the maps


@dataclass(frozen=True)
class Alignment:
    """Estimate of T_a_b (frame b into frame a) from correspondences between two maps.

    Attributes:
        T_a_b: tx_m, ty_m, theta_rad (counter-clockwise), shape (3,); NaN if degenerate.
        covariance: covariance of T_a_b, shape (3, 3); NaN if degenerate. It includes independent
            residuals, s_drift and the errors of the camera calibration. It excludes drift that is
            common to a whole map and leaves no residual, so that actual errors are larger; the
            evaluation reports the NEES (normalised estimation error squared).
        inlier: supporting correspondences, bool, shape (N,).
        elapsed_s: time of the estimation.
        status: outcome. A method accepts, refuses or reports degenerate data; the verification sets
            ambiguous and too uncertain; the harness sets failed and absent.
        reason: explanation for a user; empty if accepted.
        drift_sigma_m: s_drift, the standard deviation per axis of the residuals beyond the
            landmarks' covariances (both maps together); NaN if degenerate.
    """

    T_a_b: Float
    covariance: Float
    inlier: np.ndarray
    elapsed_s: float
    status: Status
    reason: str = ""
    drift_sigma_m: float = float("nan")

    @property
    def ok(self) -> bool:
        """True if the estimate may be used."""
        return self.status is Status.ACCEPTED


def degenerate(reason: str, n_correspondences: int, elapsed_s: float = 0.0) -> Alignment:
    """Return the result for data that determine no motion."""
    return without_answer(Status.DEGENERATE, reason, n_correspondences, elapsed_s)


def without_answer(
    status: Status, reason: str, n_correspondences: int, elapsed_s: float = float("nan")
) -> Alignment:
    """Return a result without a motion."""
    return Alignment(
        np.full(3, np.nan),
        np.full((3, 3), np.nan),
        np.zeros(n_correspondences, dtype=bool),
        elapsed_s,
        status,
        reason,
    )


MIN_PAIRS = 3  # two pairs determine a motion; a third is needed to contradict it


@dataclass(frozen=True)
class Pairs:
    """N pairs of corresponding landmarks with their positions and covariances.

    Raises:
        ValueError: an index lies outside its map.
    """

    map_a: LandmarkMap
    map_b: LandmarkMap
    correspondences: Correspondences

    def __post_init__(self) -> None:
        for name, index, landmarks in (
            ("index_a", self.index_a, self.map_a),
            ("index_b", self.index_b, self.map_b),
        ):
            if len(index) and not 0 <= index.min() <= index.max() < len(landmarks):
                raise ValueError(f"{name}: must lie in 0..{len(landmarks) - 1}")

    def __len__(self) -> int:
        return len(self.correspondences)

    def __getitem__(self, rows: np.ndarray) -> "Pairs":
        return Pairs(self.map_a, self.map_b, self.correspondences[rows])

    @cached_property
    def kept(self) -> dict[type, Any]:
        """Values that methods keep between calls with the same pairs, by type."""
        return {}

    @property
    def index_a(self) -> np.ndarray:
        """Rows of map a, shape (N,)."""
        return self.correspondences.index_a

    @property
    def index_b(self) -> np.ndarray:
        """Rows of map b, shape (N,)."""
        return self.correspondences.index_b

    @property
    def distance(self) -> Float:
        """Descriptor distances, shape (N,); 0 for pairs of labels."""
        return self.correspondences.distance

    @property
    def planar(self) -> bool:
        """True if heights carry no information."""
        return self.map_a.planar or self.map_b.planar

    @property
    def by_name(self) -> bool:
        """True if both maps carry labels, so that landmarks are paired by label."""
        return self.map_a.label is not None and self.map_b.label is not None

    @cached_property
    def p_a(self) -> Float:
        """Positions in metres in frame a, shape (N, 3)."""
        return self.map_a.position_m.take(self.index_a, axis=0)

    @cached_property
    def p_b(self) -> Float:
        """Positions in metres in frame b, shape (N, 3)."""
        return self.map_b.position_m.take(self.index_b, axis=0)

    @cached_property
    def covariance_a(self) -> Float:
        """Covariances in frame a, shape (N, 3, 3)."""
        return self.map_a.covariance_m2.take(self.index_a, axis=0)

    @cached_property
    def covariance_b(self) -> Float:
        """Covariances in frame b, shape (N, 3, 3)."""
        return self.map_b.covariance_m2.take(self.index_b, axis=0)

    @cached_property
    def scale_note(self) -> str:
        """Factor by which one map is larger than the other, in words; empty if there is none."""
        return scale_note(self.map_a, self.map_b, self.index_a, self.index_b) if len(self) else ""

    def note(self, n_support: int) -> str:
        """Return a property of the maps that may explain a refusal; empty if none is found.

        `n_support` is the number of pairs that support the motion.
        """
        if self.by_name and not self.scale_note and FEW <= len(self) > 2 * n_support:
            return f"{len(self)} labels are in both maps: do they name the same landmarks?"
        return self.scale_note

    def points(self) -> tuple[Float, Float]:
        """Return the positions in both frames, shape (N, 3), or (N, 2) for planar maps."""
        dimensions = 2 if self.planar else 3
        return (
            np.ascontiguousarray(self.p_a[:, :dimensions]),
            np.ascontiguousarray(self.p_b[:, :dimensions]),
        )

    def in_plan(self) -> PlanarPairs:
        """Return the pairs without heights, as arrays for kernels; do not change them."""
        if PlanarPairs in self.kept:
            return self.kept[PlanarPairs]
        n = len(self)
        plan = PlanarPairs(*np.empty((2, n, 2)), *np.empty((2, n, 2, 2)))
        for part, whole in zip(plan[:2], (self.p_a, self.p_b), strict=True):
            part[:, 0], part[:, 1] = whole[:, 0], whole[:, 1]
        for part, whole in zip(plan[2:], (self.covariance_a, self.covariance_b), strict=True):
            part[:, 0, 0], part[:, 0, 1] = whole[:, 0, 0], whole[:, 0, 1]
            part[:, 1, 0], part[:, 1, 1] = whole[:, 1, 0], whole[:, 1, 1]
        self.kept[PlanarPairs] = plan
        return plan

    def of_one_height(self, gate: HeightGate) -> np.ndarray:
        """Return the rows (n,) of the pairs with compatible heights; all rows of planar maps."""
        if self.planar:
            return np.arange(len(self))
        return np.flatnonzero(
            gate.agrees(
                self.p_a[:, 2],
                self.covariance_a[:, 2, 2],
                self.p_b[:, 2],
                self.covariance_b[:, 2, 2],
            )
        )


def why_too_few(
    map_a: LandmarkMap, map_b: LandmarkMap, n_pairs: int, needed: int, shortage: str = ""
) -> str:
    """Return why there are fewer than `needed` pairs; empty if there are enough.

    `shortage` is the explanation of the matcher (`Correspondences.shortage`).
    """
    if n_pairs >= needed:
        return ""
    for landmarks in (map_a, map_b):
        if len(landmarks) == 0:
            return f"map {landmarks.name} is empty"
    if n_pairs == 0 and not shortage:
        for landmarks in (map_a, map_b):
            if landmarks.descriptor is None and landmarks.label is None:
                return f"map {landmarks.name} has neither descriptors nor labels to match by"
    few = f"{n_pairs} correspondences, at least {needed} are needed"
    return f"{few}: {shortage}" if shortage else few


def undetermined(reason: str, n_pairs: int, started_s: float) -> Alignment:
    """Return a degenerate result; `started_s` is `time.perf_counter()` at the start."""
    return degenerate(reason, n_pairs, time.perf_counter() - started_s)


gather = Pairs  # former name, which plug-ins with an `align` method import
