"""The landmarks of corresponding pairs side by side, and whether they can determine a motion."""

import math
import time
from dataclasses import dataclass

import numpy as np

from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.drift import estimate_drift_m
from mapfusion.align.result import Alignment, Status, degenerate
from mapfusion.align.rigid import motion_covariance, residual_covariances, residuals
from mapfusion.chi_square import chi_square_bound
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

MIN_PAIRS = 3  # two determine a motion, the third is the first that can contradict it
# probability that points without extent pass for a shape by their noise alone
SHAPE_FALSE_ALARM = 1e-3


@dataclass(frozen=True)
class Pairs:
    """N pairs of landmarks.

    Attributes:
        p_a, p_b: (N, 3) positions in metres, each in its own frame.
        covariance_a, covariance_b: (N, 3, 3).
        planar: heights carry no information.
    """

    p_a: Float
    p_b: Float
    covariance_a: Float
    covariance_b: Float
    planar: bool

    def __len__(self) -> int:
        return len(self.p_a)

    def __getitem__(self, rows: np.ndarray) -> "Pairs":
        return Pairs(
            self.p_a[rows],
            self.p_b[rows],
            self.covariance_a[rows],
            self.covariance_b[rows],
            self.planar,
        )

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


def gather(map_a: LandmarkMap, map_b: LandmarkMap, correspondences: Correspondences) -> Pairs:
    """Look the pairs up in their maps.

    Raises:
        ValueError: an index lies outside its map.
    """
    for name, index, landmarks in (
        ("index_a", correspondences.index_a, map_a),
        ("index_b", correspondences.index_b, map_b),
    ):
        if len(index) and not 0 <= index.min() <= index.max() < len(landmarks):
            raise ValueError(f"{name}: must lie in 0..{len(landmarks) - 1}")
    return Pairs(
        map_a.position_m[correspondences.index_a],
        map_b.position_m[correspondences.index_b],
        map_a.covariance_m2[correspondences.index_a],
        map_b.covariance_m2[correspondences.index_b],
        map_a.planar or map_b.planar,
    )


def why_too_few(map_a: LandmarkMap, map_b: LandmarkMap, n_pairs: int, needed: int) -> str:
    """Why there are fewer than `needed` pairs; empty when there are enough."""
    if n_pairs >= needed:
        return ""
    for landmarks in (map_a, map_b):
        if len(landmarks) == 0:
            return f"map {landmarks.name} is empty"
    if n_pairs == 0:
        for landmarks in (map_a, map_b):
            if landmarks.descriptor is None and landmarks.label is None:
                return f"map {landmarks.name} has neither descriptors nor labels to match by"
    return f"{n_pairs} correspondences, at least {needed} are needed"


def lacks_extent(p: Float, covariance_m2: Float, dimensions: int) -> bool:
    """Whether points (N, 2) may lie on one point (dimensions 1) or on one line (dimensions 2).

    Exact zeros never occur: the spread along the weakest of the strongest `dimensions` principal
    axes is compared with what the landmarks' own noise (N, 2, 2) along it would give (chi-square).
    """
    centred = p - p.mean(axis=0)
    spread, axes = np.linalg.eigh(centred.T @ centred)  # ascending
    axis = axes[:, 2 - dimensions]
    noise = axis @ covariance_m2.mean(axis=0) @ axis
    # rounding alone leaves this much, as in numpy.linalg.matrix_rank
    rounding = (len(p) * np.finfo(np.float64).eps * np.abs(p).max()) ** 2
    freedom = max(len(p) - dimensions, 1)
    most = noise * chi_square_bound(1 - SHAPE_FALSE_ALARM, freedom) + rounding
    return spread[2 - dimensions] <= most


def why_one_place(pairs: Pairs, drift_m2: float = 0.0) -> str:
    """Why the angle between the maps is open: all pairs (1 or more) lie on one point of either."""
    drift = drift_m2 * np.eye(2)
    for name, p, covariance in (
        ("a", pairs.p_a, pairs.covariance_a),
        ("b", pairs.p_b, pairs.covariance_b),
    ):
        if lacks_extent(p[:, :2], covariance[:, :2, :2] + drift, 1):
            return f"in plan map {name}'s landmarks lie on one point, as far as noise can tell"
    return ""


def finish(
    fitted: Pairs,
    gain: Float,
    T_a_b: Float,
    inlier: np.ndarray,
    started_s: float,
    refusal: str = "",
    gate_m: float = math.inf,
) -> Alignment:
    """An estimator's result: its motion, with drift and covariance judged from what it fitted.

    Args:
        fitted: the pairs whose residuals made the estimate.
        gain: how much each moved it (len(fitted), 3, 2), as from `rigid.least_squares_gain`.
        T_a_b: (3,).
        inlier: (N,) bool over the correspondences given.
        started_s: `time.perf_counter()` at the start.
        refusal: why the estimate is not to be trusted, if so.
        gate_m: radius beyond which residuals were not fitted.
    """
    n_inliers = int(np.count_nonzero(inlier))
    if n_inliers < MIN_PAIRS and not refusal:
        refusal = f"{n_inliers} correspondences agree, at least {MIN_PAIRS} are needed"
    own = residual_covariances(T_a_b, fitted.covariance_a, fitted.covariance_b)
    drift = estimate_drift_m(residuals(T_a_b, fitted.p_a, fitted.p_b), own, gate_m)
    return Alignment(
        T_a_b,
        motion_covariance(gain, own + drift**2 * np.eye(2)),
        inlier,
        time.perf_counter() - started_s,
        Status.REFUSED if refusal else Status.ACCEPTED,
        refusal,
        drift,
    )


def undetermined(reason: str, n_pairs: int, started_s: float) -> Alignment:
    """A degenerate result with its elapsed time."""
    return degenerate(reason, n_pairs, time.perf_counter() - started_s)
