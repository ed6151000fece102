"""RANSAC: the motion of a random minimal set with the most support (section 5)."""

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.alignment import Pairs
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.method import Fit, Undetermined
from mapfusion.align.rigid_motion import fit_rigid, fit_two
from mapfusion.geometry.numerics import Float, kernel
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
    before = np.empty(len(rows), np.int64)
    for _ in range(_LOCAL_ROUNDS):
        T_a_b[0], T_a_b[1], T_a_b[2] = fit_rigid(p_a, p_b, rows[:count])
        before_count = count
        for i in range(count):
            before[i] = rows[i]
        count, cost = list_supporters(T_a_b, p_a, p_b, gate_m, none_to_beat, rows)
        same = count == before_count
        for i in range(count):
            same = same and rows[i] == before[i]
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
            hit = count * (count - 1) / (n * (n - 1))
            needed = min(needed, log_miss / math.log1p(-hit)) if hit < 1 else 0.0
    return draws, best_T, best_rows[:best_count].copy()
