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
    REFUSED = "refused"  # an answer was found and is not to be trusted
    AMBIGUOUS = "ambiguous"  # it fits, and so may another: the maps do not tell which
    TOO_UNCERTAIN = "too_uncertain"  # right by its pairs, useless by its covariance
    DEGENERATE = "degenerate"  # the data do not determine an answer
    FAILED = "failed"  # the method raised, hung, ended its process or answered nonsense
    ABSENT = "absent"  # the package behind the method is not installed


NOT_RUN = frozenset({Status.FAILED, Status.ABSENT})  # nothing can be said about the maps


@dataclass(frozen=True)
class Alignment:
    """An estimate of T_a_b (frame b into frame a) from correspondences between two maps.

    Attributes:
        T_a_b: (3,) tx_m, ty_m, theta_rad (counter-clockwise); NaN when degenerate.
        covariance: (3, 3) of T_a_b for residuals that are independent, s_drift included, and for
            what the cameras' calibration leaves open; NaN when degenerate. What drift has in common
            over a whole map leaves no residual and is not in it, so that real errors are larger:
            the evaluation reports the NEES.
        inlier: (N,) bool over the correspondences given.
        elapsed_s: time of the estimation.
        status: accepted, refused or degenerate by its method, ambiguous and too uncertain by the
            verdict; failed and absent come from the harness alone.
        reason: empty when accepted, else what a person can act on.
        drift_sigma_m: s_drift, the standard deviation per axis of the residuals of pairs beyond
            what the landmarks' covariances explain (both maps together); NaN when degenerate.
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
        """Whether the estimate may be used."""
        return self.status is Status.ACCEPTED


def degenerate(reason: str, n_correspondences: int, elapsed_s: float = 0.0) -> Alignment:
    """The result for data that determine no alignment."""
    return without_answer(Status.DEGENERATE, reason, n_correspondences, elapsed_s)


def without_answer(
    status: Status, reason: str, n_correspondences: int, elapsed_s: float = float("nan")
) -> Alignment:
    """A result that holds no motion."""
    return Alignment(
        np.full(3, np.nan),
        np.full((3, 3), np.nan),
        np.zeros(n_correspondences, dtype=bool),
        elapsed_s,
        status,
        reason,
    )


MIN_PAIRS = 3  # two determine a motion, the third is the first that can contradict it


@dataclass(frozen=True)
class Pairs:
    """N pairs of landmarks, looked up in their maps.

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
        """What methods keep of the maps between their calls with these pairs, each by its type."""
        return {}

    @property
    def index_a(self) -> np.ndarray:
        """(N,) rows of map a."""
        return self.correspondences.index_a

    @property
    def index_b(self) -> np.ndarray:
        """(N,) rows of map b."""
        return self.correspondences.index_b

    @property
    def distance(self) -> Float:
        """(N,) of the descriptors, 0 for pairs made by label."""
        return self.correspondences.distance

    @property
    def planar(self) -> bool:
        """Whether heights carry no information."""
        return self.map_a.planar or self.map_b.planar

    @property
    def by_name(self) -> bool:
        """Whether both maps carry labels, by which landmarks are then paired."""
        return self.map_a.label is not None and self.map_b.label is not None

    @cached_property
    def p_a(self) -> Float:
        """(N, 3) positions in metres, in frame a."""
        return self.map_a.position_m.take(self.index_a, axis=0)

    @cached_property
    def p_b(self) -> Float:
        """(N, 3) positions in metres, in frame b."""
        return self.map_b.position_m.take(self.index_b, axis=0)

    @cached_property
    def covariance_a(self) -> Float:
        """(N, 3, 3) in frame a."""
        return self.map_a.covariance_m2.take(self.index_a, axis=0)

    @cached_property
    def covariance_b(self) -> Float:
        """(N, 3, 3) in frame b."""
        return self.map_b.covariance_m2.take(self.index_b, axis=0)

    @cached_property
    def scale_note(self) -> str:
        """By what factor one map is larger than the other, in words; empty if by none."""
        return scale_note(self.map_a, self.map_b, self.index_a, self.index_b) if len(self) else ""

    def note(self, n_support: int) -> str:
        """Return what about the maps explains that no motion is accepted; empty for nothing.

        `n_support` is how many pairs support the motion found.
        """
        if self.by_name and not self.scale_note and FEW <= len(self) > 2 * n_support:
            return f"{len(self)} labels are in both maps: do they name the same landmarks?"
        return self.scale_note

    def points(self) -> tuple[Float, Float]:
        """Positions (N, 3) in both frames, (N, 2) where heights carry no information."""
        dimensions = 2 if self.planar else 3
        return (
            np.ascontiguousarray(self.p_a[:, :dimensions]),
            np.ascontiguousarray(self.p_b[:, :dimensions]),
        )

    def in_plan(self) -> PlanarPairs:
        """The pairs without their heights, for the kernels, which do not change them."""
        return self._plan

    @cached_property
    def _plan(self) -> PlanarPairs:
        n = len(self)
        plan = PlanarPairs(*np.empty((2, n, 2)), *np.empty((2, n, 2, 2)))
        for part, whole in zip(plan[:2], (self.p_a, self.p_b), strict=True):
            part[:, 0], part[:, 1] = whole[:, 0], whole[:, 1]
        for part, whole in zip(plan[2:], (self.covariance_a, self.covariance_b), strict=True):
            part[:, 0, 0], part[:, 0, 1] = whole[:, 0, 0], whole[:, 0, 1]
            part[:, 1, 0], part[:, 1, 1] = whole[:, 1, 0], whole[:, 1, 1]
        return plan

    def of_one_height(self, gate: HeightGate) -> np.ndarray:
        """Rows (n,) of the pairs whose heights agree; of planar maps all."""
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
    """Return why there are fewer than `needed` pairs; empty when there are enough.

    `shortage` is that of the correspondences, which names the test that left so few.
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
    """A degenerate result with its elapsed time since `time.perf_counter()` was started_s."""
    return degenerate(reason, n_pairs, time.perf_counter() - started_s)


gather = Pairs  # by this name packages with the interface `align` import it
