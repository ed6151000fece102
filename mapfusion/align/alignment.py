"""Interface of aligners: corresponding landmarks, the fit of a method, and the alignment.

A method finds a motion from `Pairs` and returns a `Fit`. The extent of the pairs is tested, since
pairs on one point or on one line do not determine every motion.
"""

import math
import time
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np

from mapfusion.align.correspondences import FEW, Correspondences, HeightGate, scale_note
from mapfusion.align.frames import HeightDifference, Overlap, moved_motion
from mapfusion.align.mahalanobis_gate import PlanarPairs
from mapfusion.geometry.numerics import Float, chi_square_bound
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
        covariance: covariance of T_a_b, shape (3, 3); NaN if degenerate (`align.covariance`).
        inlier: supporting correspondences, bool, shape (N,).
        elapsed_s: time of the estimation.
        status: outcome. A method accepts, refuses or reports degenerate data; the verification sets
            ambiguous and too uncertain; the harness sets failed and absent.
        reason: explanation for a user; empty if accepted.
        drift_sigma_m: s_drift, the standard deviation per axis of the residuals beyond the
            landmarks' covariances (both maps together); NaN if degenerate.
        lower_bound: True if the covariance is a lower bound, because a map does not state the
            errors that its landmarks share.
        overlap: the same motion about the middle of its supporters; None if unknown.
        heights: heights of map b against those of map a; None if unknown, or without heights.
    """

    T_a_b: Float
    covariance: Float
    inlier: np.ndarray
    elapsed_s: float
    status: Status
    reason: str = ""
    drift_sigma_m: float = float("nan")
    lower_bound: bool = True
    overlap: Overlap | None = None
    heights: HeightDifference | None = None

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

    Attributes:
        map_a: map in frame a.
        map_b: map in frame b.
        correspondences: rows of both maps.
        origins: origins (2,) of the maps' local frames in the frames of the given maps; None if the
            maps are in their own frames.

    Raises:
        ValueError: an index lies outside its map.
    """

    map_a: LandmarkMap
    map_b: LandmarkMap
    correspondences: Correspondences
    origins: tuple[Float, Float] | None = None

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
        return Pairs(self.map_a, self.map_b, self.correspondences[rows], self.origins)

    def given_motion(self, T_a_b: Float, covariance: Float | None = None) -> tuple[Float, Float]:
        """Return a motion of the local frames and its covariance in the frames of the given maps.

        Without origins and without a covariance both are unchanged and zero.
        """
        motion_covariance = np.zeros((3, 3)) if covariance is None else covariance
        if self.origins is None or not any(origin.any() for origin in self.origins):
            return T_a_b, motion_covariance
        return moved_motion(T_a_b, motion_covariance, *self.origins)

    @cached_property
    def cache(self) -> dict[Any, Any]:
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

    @property
    def by_geometry(self) -> bool:
        """True if landmarks were matched by geometry alone."""
        return self.correspondences.by_geometry

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
        if PlanarPairs in self.cache:
            return self.cache[PlanarPairs]
        n = len(self)
        planar = PlanarPairs(*np.empty((2, n, 2)), *np.empty((2, n, 2, 2)))
        for part, spatial in zip(planar[:2], (self.p_a, self.p_b), strict=True):
            part[:, 0], part[:, 1] = spatial[:, 0], spatial[:, 1]
        for part, spatial in zip(planar[2:], (self.covariance_a, self.covariance_b), strict=True):
            part[:, 0, 0], part[:, 0, 1] = spatial[:, 0, 0], spatial[:, 0, 1]
            part[:, 1, 0], part[:, 1, 1] = spatial[:, 1, 0], spatial[:, 1, 1]
        self.cache[PlanarPairs] = planar
        return planar

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
            return f"{landmarks.called} is empty"
    message = f"{n_pairs} correspondences"
    if n_pairs:  # else no method has enough, and all say the same
        message += f", at least {needed} are needed"
    return f"{message}: {shortage}" if shortage else message


def undetermined(reason: str, n_pairs: int, started_s: float) -> Alignment:
    """Return a degenerate result; `started_s` is `time.perf_counter()` at the start."""
    return degenerate(reason, n_pairs, time.perf_counter() - started_s)


gather = Pairs  # former name, which plug-ins with an `align` method import


# probability that points without extent seem to have one because of noise
SHAPE_FALSE_ALARM = 1e-3


def lacks_extent(p: Float, covariance_m2: Float, drift_m2: float, dimensions: int) -> bool:
    """Return True if points may lie on one point of the plane (dimensions 1) or on one line (2).

    The squared deviations along the weakest of the strongest `dimensions` principal axes, each over
    its own variance, are compared with their chi-square distribution under noise alone (Cochran
    1954, Q statistic). An uncertain landmark therefore counts little and does not hide the extent
    of the others.

    Args:
        p: positions, shape (N, 2 or more), N at least 1.
        covariance_m2: covariances, shape (N, 2 or more, 2 or more).
        drift_m2: s_drift^2, added to each covariance.
        dimensions: 1 or 2.
    """
    in_plan = np.ascontiguousarray(p.T[:2])
    centred = in_plan - in_plan[:, :1]  # avoids cancellation far from the origin
    # rounding error, as in numpy.linalg.matrix_rank
    rounding = len(p) * np.finfo(np.float64).eps * np.abs(in_plan).max()
    floor_m2 = drift_m2 + rounding**2 + np.finfo(np.float64).tiny
    xx, xy, yy = (covariance_m2[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    weight = 1 / ((xx + yy) / 2 + floor_m2)
    centred -= (centred @ weight / weight.sum())[:, None]
    # eigenvalues ascend
    x, y = np.linalg.eigh((centred * weight) @ centred.T)[1][:, 2 - dimensions]
    weight = 1 / (x * x * xx + 2 * x * y * xy + y * y * yy + floor_m2)
    along = x * centred[0] + y * centred[1]
    along -= along @ weight / weight.sum()
    freedom = max(len(p) - dimensions, 1)
    return bool(weight @ along**2 <= chi_square_bound(1 - SHAPE_FALSE_ALARM, freedom))


def why_angle_is_open(pairs: Pairs, drift_m2: float = 0.0, qualifier: str = " that agree") -> str:
    """Return why the angle between the maps is open; empty if the pairs (1 or more) determine it.

    The angle is open if all pairs lie on one point of either map. `qualifier` describes the
    pairs in the text.
    """
    for name, p, covariance in (
        ("a", pairs.p_a, pairs.covariance_a),
        ("b", pairs.p_b, pairs.covariance_b),
    ):
        if lacks_extent(p, covariance, drift_m2, 1):
            n = len(pairs)
            if n > 1 and drift_m2 > 0 and not lacks_extent(p, covariance, 0.0, 1):
                drift_text = f"under the best one they are {math.sqrt(drift_m2):.2g} m off"
                excess = f"{drift_text}, too much for the extent of map {name}"
                return f"no motion fits the {n} pairs: {excess}"
            lie = (
                f"pairs{qualifier} lie"
                if n > 1
                else f"pair{qualifier.replace('agree', 'agrees')} lies"
            )
            sigma_m = math.sqrt(np.median(covariance[:, [0, 1], [0, 1]]) + drift_m2)
            noise = f"noise of {sigma_m:.2g} m can tell"
            return f"the {n} {lie} on one point of map {name} in plan, as far as {noise}"
    return ""


@dataclass(frozen=True)
class Needs:
    """Requirements of a method on the pairs; a method is not called without them.

    Attributes:
        pairs: smallest number of pairs.
        dimensions: 1 if the pairs must not lie on one point of either map, 2 if the landmarks of
            map b must not lie on one line, 0 if the method tests the extent itself.
    """

    pairs: int = 2
    dimensions: int = 0

    def why_without_extent(self, pairs: Pairs) -> str:
        """Return why the extent of the pairs is too small; empty if it is large enough."""
        if self.dimensions == 0:
            return ""
        if self.dimensions == 1:
            return why_angle_is_open(pairs, qualifier="")
        if lacks_extent(pairs.p_b, pairs.covariance_b, 0.0, 2):
            n = len(pairs)
            return f"the {n} pairs lie on one line of map b in plan, as far as noise can tell"
        return ""


@dataclass(frozen=True)
class Fit:
    """Motion that a method found, with the pairs that it was fitted to.

    Attributes:
        T_a_b: motion, shape (3,), finite.
        inlier: given pairs that support the motion, bool, shape (N,).
        weight: weights of the fitted pairs in the least squares, shape (n,); equal by default.
        gain: derivative of the motion by each fitted residual, shape (n, 3, 2); by default that of
            the least squares with `weight`.
        fitted: the n fitted pairs; the inliers by default.
        gate_m: largest residual of a fitted pair.
        refusal: why the motion must not be used; empty if it may.
    """

    T_a_b: Float
    inlier: np.ndarray
    weight: Float | None = None
    gain: Float | None = None
    fitted: Pairs | None = None
    gate_m: float = math.inf
    refusal: str = ""


@dataclass(frozen=True)
class Undetermined:
    """Result of a method if the pairs determine no motion, with the reason for a user."""

    reason: str


class Method(Protocol):
    """Alignment method.

    Optional attributes: `needs`, a `Needs`; `height`, a `HeightGate`, restricts the pairs that the
    method receives to those with compatible heights.

    Attributes:
        randomised: True if the result depends on the generator.
    """

    randomised: ClassVar[bool]

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Estimate T_a_b and mark the pairs that support it."""
        ...


def supported(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, refusal: str = ""
) -> Fit | Undetermined:
    """Return the fit of a motion that is the unweighted least squares of the pairs marked (N,).

    A motion with fewer than two pairs is refused. The angle is undetermined if all lie on one
    point.
    """
    n = int(np.count_nonzero(inlier))
    if n < 2:
        return Fit(T_a_b, inlier, refusal=refusal or f"{n} correspondences support the motion")
    support = pairs[inlier]
    reason = why_angle_is_open(support)
    return Undetermined(reason) if reason else Fit(T_a_b, inlier, fitted=support, refusal=refusal)
