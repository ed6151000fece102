"""RANSAC: the motion of a random minimal set with the most support (section 5).

The gate is a distance (`Ransac`) or follows from the covariances (`RansacMahalanobis`).
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.alignment import Fit, Pairs, Undetermined
from mapfusion.align.consensus import Consensus, drift_needed, packed_rows, pair_spread
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.mahalanobis_gate import PlanarPairs, mark_supporters, refit_to_support
from mapfusion.align.rigid_motion import fit_rigid, fit_two
from mapfusion.geometry.numerics import Float, chi_square_bound, kernel
from mapfusion.geometry.se2 import residual
from mapfusion.parameters import Probability, Range, require_in_range

_LOCAL_ROUNDS = 10  # rounds of fit and support; two or three usually suffice


@dataclass(frozen=True)
class Ransac:
    """Motion with the largest support among those of random pairs of correspondences.

    Pairs with incompatible heights, and minimal sets with different distances in the two maps, are
    rejected before their support is counted.

    Attributes:
        gate_m: largest distance of a supporting pair under the motion (in 3-D; in the plane for
            planar maps): three times 0.1 m, the drift between two maps of one loop.
        min_baseline_m: smallest distance within a minimal set; at 1 m an error of 0.1 m turns the
            map by 6 degrees.
        confidence: probability that at least one set of two supporters of the result was drawn.
        max_draws: largest number of minimal sets.
        height: test of compatible heights.
    """

    randomised: ClassVar[bool] = True
    gate_m: Annotated[float, Range(1e-3, 1000, "m")] = 0.3
    min_baseline_m: Annotated[float, Range(1e-3, 1000, "m")] = 1.0
    confidence: Probability = 0.9999
    max_draws: Annotated[int, Range(1, 100_000_000, "draws")] = 100_000
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        require_in_range(self)

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Estimate T_a_b from the minimal set with the most support, and refit to the support."""
        seed = rng.integers(1, 2**64, dtype=np.uint64)
        log_miss = math.log1p(-self.confidence)
        _, T_a_b, support = most_supported(
            *pairs.points(), self.gate_m, self.min_baseline_m, log_miss, self.max_draws, seed
        )
        if not len(support):
            return Undetermined(
                f"no two of {len(pairs)} correspondences are {self.min_baseline_m:g} m or more and "
                "equally far apart in both maps"
            )
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[support] = True
        return Fit(T_a_b, inlier, gate_m=self.gate_m)


@kernel
def next_random(state: np.uint64) -> np.uint64:
    """Return the next state of a 64-bit xorshift generator (Marsaglia 2003); never 0."""
    state ^= state << np.uint64(13)
    state ^= state >> np.uint64(7)
    state ^= state << np.uint64(17)
    return state


@kernel
def draw_pair(state: np.uint64, n: int) -> tuple[np.uint64, int, int]:
    """Draw two different numbers below n; return the new state and the numbers."""
    # scaling the upper 32 bits has a bias of at most n / 2^32
    state = next_random(state)
    i = int(np.int64(((state >> np.uint64(32)) * np.uint64(n)) >> np.uint64(32)))
    state = next_random(state)
    j = int(np.int64(((state >> np.uint64(32)) * np.uint64(n - 1)) >> np.uint64(32)))
    return state, i, j + 1 if j >= i else j


@kernel
def draws_needed(count: int, n: int, log_miss: float) -> float:
    """Return the number of draws that hit two of `count` supporters among n pairs.

    `log_miss` is the logarithm of the accepted probability of no hit.
    """
    hit = count * (count - 1) / (n * (n - 1))
    return log_miss / math.log1p(-hit) if hit < 1 else 0.0


@kernel
def list_supporters(
    T_a_b: Float, p_a: Float, p_b: Float, gate_m: float, to_beat: int, rows: np.ndarray
) -> tuple[int, float]:
    """Write the supporters to `rows`; return their number and the sum of squared distances.

    The count stops early if `to_beat` cannot be reached.
    """
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    n, dimensions = p_a.shape
    count = 0
    cost = 0.0
    for i in range(n):
        if count + n - i < to_beat:
            break
        dx, dy = residual(T_a_b, cos, sin, p_a, p_b, i)
        square = dx * dx + dy * dy
        if dimensions == 3:
            dz = p_a[i, 2] - p_b[i, 2]
            square += dz * dz
        if square <= gate_m * gate_m:
            rows[count] = i
            count += 1
            cost += square
    return count, cost


@kernel
def refit(
    p_a: Float, p_b: Float, gate_m: float, T_a_b: Float, rows: np.ndarray, count: int
) -> tuple[int, float]:
    """Alternate fit and support until the support repeats; T_a_b and rows are changed.

    Motions are compared after this local optimisation, since the motion of a minimal set is noisy
    and can gain false supporters near the gate.
    """
    cost, none_to_beat = 0.0, np.int64(0)  # a literal 0 would compile a second specialisation
    previous_rows = np.empty(len(rows), np.int64)
    for _ in range(_LOCAL_ROUNDS):
        T_a_b[0], T_a_b[1], T_a_b[2] = fit_rigid(p_a, p_b, rows[:count])
        before_count = count
        for i in range(count):
            previous_rows[i] = rows[i]
        count, cost = list_supporters(T_a_b, p_a, p_b, gate_m, none_to_beat, rows)
        same = count == before_count
        for i in range(count):
            same = same and rows[i] == previous_rows[i]
        if count < 2 or same:
            break
    return count, cost


@kernel
def most_supported(
    p_a: Float,
    p_b: Float,
    gate_m: float,
    min_baseline_m: float,
    log_miss: float,
    max_draws: int,
    seed: np.uint64,
) -> tuple[int, Float, np.ndarray]:
    """Draw minimal sets until two supporters of the best motion were drawn with the confidence.

    A motion with at least as much support as the best one is refitted to its support first.

    Args:
        p_a: points of frame a, shape (N, 2 or 3), N at least 2.
        p_b: points of frame b, shape (N, 2 or 3).
        gate_m: largest distance of a supporter.
        min_baseline_m: smallest distance within a minimal set.
        log_miss: logarithm of the accepted probability of drawing no two supporters.
        max_draws: largest number of draws.
        seed: state of the generator, not 0.

    Returns:
        Number of draws, T_a_b (3,) and the rows of its supporters, none without a motion.
    """
    n = len(p_a)
    best_T, T_a_b = np.full(3, np.nan), np.empty(3)
    rows, best_rows = np.empty(n, np.int64), np.empty(n, np.int64)
    best_count, best_cost = np.int64(0), math.inf
    needed = float(max_draws)
    draws = 0
    state = seed
    while draws < needed:
        draws += 1
        state, i, j = draw_pair(state, n)
        ax, ay = p_a[j, 0] - p_a[i, 0], p_a[j, 1] - p_a[i, 1]
        bx, by = p_b[j, 0] - p_b[i, 0], p_b[j, 1] - p_b[i, 1]
        difference = math.sqrt(ax * ax + ay * ay) - math.sqrt(bx * bx + by * by)
        # the fit leaves half the difference at either end: beyond 2 gates there is no supporter
        if abs(difference) > 2 * gate_m:
            continue
        if fit_two(p_a, p_b, i, j, T_a_b) < min_baseline_m:
            continue
        count, _ = list_supporters(T_a_b, p_a, p_b, gate_m, best_count, rows)
        if count < max(best_count, 2):
            continue
        count, cost = refit(p_a, p_b, gate_m, T_a_b, rows, count)
        if count < 2:  # the motion moved away from its own support
            continue
        if count > best_count or (count == best_count and cost < best_cost):
            for k in range(3):
                best_T[k] = T_a_b[k]
            best_count, best_cost = count, cost
            for k in range(count):
                best_rows[k] = rows[k]
            needed = min(needed, draws_needed(count, n, log_miss))
    return draws, best_T, best_rows[:best_count].copy()


@dataclass(frozen=True)
class RansacMahalanobis(Consensus):
    """Motion of a random minimal set with the smallest sum of truncated squared residuals.

    A pair supports a motion if e^T (S_a + R S_b R^T + s_drift^2 I)^-1 e is below a chi-square
    quantile, so that the gate is narrow for precise landmarks. Motions are compared by the
    truncated cost (MSAC: Torr and Zisserman 2000), since a count would prefer many loose supporters
    to fewer exact ones.

    Attributes:
        min_baseline_m: smallest distance within a minimal set; at 1 m an error of 0.1 m turns the
            map by 6 degrees.
        confidence: probability that at least one set of two supporters of the result was drawn.
        max_draws: largest number of minimal sets.
    """

    randomised: ClassVar[bool] = True
    min_baseline_m: Annotated[float, Range(1e-3, 1000, "m")] = 1.0
    confidence: Probability = 0.9999
    max_draws: Annotated[int, Range(1, 100_000_000, "draws")] = 100_000

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Estimate T_a_b with the largest s_drift, and refit to the support."""
        planar = pairs.in_plan()
        if RansacMahalanobis not in pairs.cache:
            pairs.cache[RansacMahalanobis] = packed_rows(planar)
        _, T_a_b = least_truncated_squares(
            planar,
            pair_spread(pairs).own_m2,
            pairs.cache[RansacMahalanobis],
            self.variances_m2[-1],
            self.bound,
            chi_square_bound(self.probability, 1),
            self.min_baseline_m,
            math.log1p(-self.confidence),
            self.max_draws,
            rng.integers(1, 2**64, dtype=np.uint64),
        )
        return self.refitted(T_a_b, pairs, planar)


@kernel
def least_truncated_squares(
    pairs: PlanarPairs,
    own_m2: Float,
    rows: Float,
    variance_m2: float,
    bound: float,
    agreement: float,
    min_baseline_m: float,
    log_miss: float,
    max_draws: int,
    seed: np.uint64,
) -> tuple[int, Float]:
    """Draw minimal sets until two supporters of the best motion were drawn with the confidence.

    Args:
        pairs: N correspondences.
        own_m2: `mean_variances` without s_drift, shape (N,).
        rows: the pairs as `packed_rows`.
        variance_m2: s_drift^2.
        bound: largest e^T C^-1 e of a supporter.
        agreement: largest squared difference of the two lengths of a set over its variance.
        min_baseline_m: smallest distance within a minimal set.
        log_miss: logarithm of the accepted probability of drawing no two supporters.
        max_draws: largest number of draws.
        seed: state of the generator, not 0.

    Returns:
        Number of draws and T_a_b (3,), NaN without a motion.
    """
    p_a, p_b = pairs.p_a, pairs.p_b
    n = len(p_a)
    best_T, T_a_b, inside = np.full(3, np.nan), np.empty(3), np.empty(n, np.bool_)
    best_score, best_raw = 0.0, 0.0
    needed, draws, state = float(max_draws), 0, seed
    while draws < needed:
        draws += 1
        state, i, j = draw_pair(state, n)
        if drift_needed(rows, i, j, agreement) > variance_m2:
            continue
        if fit_two(p_a, p_b, i, j, T_a_b) < min_baseline_m:
            continue
        count, score = mark_supporters(T_a_b, pairs, own_m2, variance_m2, bound, inside)
        if count < 2 or score <= best_raw:
            continue
        best_raw = score
        count = refit_to_support(T_a_b, pairs, own_m2, variance_m2, bound, inside)
        count, score = mark_supporters(T_a_b, pairs, own_m2, variance_m2, bound, inside)
        if count >= 2 and score > best_score:
            for k in range(3):
                best_T[k] = T_a_b[k]
            best_score = score
            needed = min(needed, draws_needed(count, n, log_miss))
    return draws, best_T
