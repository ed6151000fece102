"""RANSAC: of the motions of random minimal sets, the one with the most support (section 5)."""

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

_LOCAL_ROUNDS = 10  # of fit and support; two or three are the rule


@dataclass(frozen=True)
class Ransac:
    """Motion with the largest support among those of random pairs of correspondences.

    Two pairs whose landmarks are not equally far apart in both maps cannot both be true, and a
    pair whose heights disagree cannot be; neither costs a look at its support.

    Attributes:
        gate_m: a pair supports a motion that brings its landmarks this close (in 3-D; in the plane
            for planar maps). Three times 0.1 m, the drift between two maps of one loop.
        min_baseline_m: minimal sets closer together are passed over: at 1 m an error of 0.1 m
            turns the map by 6 degrees already.
        confidence: that at least one set of two supporters of the answer was drawn.
        max_draws: ends the search where there is next to no support.
        height: which pairs can be true by their heights.
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
        """T_a_b of the minimal set with the most support, fitted to it."""
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
    """Next state of a xorshift generator with 64 bits (Marsaglia 2003); state must not be 0."""
    state ^= state << np.uint64(13)
    state ^= state >> np.uint64(7)
    state ^= state << np.uint64(17)
    return state


@kernel
def draw_pair(state: np.uint64, n: int) -> tuple[np.uint64, int, int]:
    """The state after drawing two different numbers below n, and the numbers."""
    # the upper 32 bits, scaled, are uneven by n / 2^32 at most
    state = next_random(state)
    i = int(np.int64(((state >> np.uint64(32)) * np.uint64(n)) >> np.uint64(32)))
    state = next_random(state)
    j = int(np.int64(((state >> np.uint64(32)) * np.uint64(n - 1)) >> np.uint64(32)))
    return state, i, j + 1 if j >= i else j


@kernel
def _two_point_motion(
    p_a: Float, p_b: Float, i: int, j: int, gate_m: float, min_baseline_m: float, T_a_b: Float
) -> bool:
    """Fill T_a_b from pairs i and j, or return False when they cannot both support one motion."""
    ax, ay = p_a[j, 0] - p_a[i, 0], p_a[j, 1] - p_a[i, 1]
    bx, by = p_b[j, 0] - p_b[i, 0], p_b[j, 1] - p_b[i, 1]
    difference = math.sqrt(ax * ax + ay * ay) - math.sqrt(bx * bx + by * by)
    # the fit leaves half the difference at either end, so beyond 2 gates neither end is a supporter
    if abs(difference) > 2 * gate_m:
        return False
    return fit_two(p_a, p_b, i, j, T_a_b) >= min_baseline_m


@kernel
def list_supporters(
    T_a_b: Float, p_a: Float, p_b: Float, gate_m: float, to_beat: int, rows: np.ndarray
) -> tuple[int, float]:
    """Number of supporters, which go into `rows`, and their summed squared distance.

    Gives up, with the number so far, when `to_beat` is out of reach.
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
    """Fit to the support and take the support again until it repeats; T_a_b and rows are changed.

    Motions are compared only after this: a raw minimal set can gain a false supporter by leaning
    towards it, with its true ones at the gate's edge.
    """
    cost, none_to_beat = 0.0, np.int64(0)  # a plain 0 is a type of its own, and compiled for
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
    """Draw minimal sets until two supporters of the best motion would have come up by now.

    A motion with as much support as the best so far is settled on its support before it counts.
    Points are (N, 2 or 3), N at least 2, `seed` is not 0, `log_miss` the logarithm of the chance
    accepted of never drawing two supporters. Returns the number of draws, T_a_b (3,), rows of its
    supporters; none when no motion was found.
    """
    n = len(p_a)
    best_T, T_a_b = np.full(3, np.nan), np.empty(3)
    rows, best_rows = np.empty(n, np.int64), np.empty(n, np.int64)
    best_count, best_cost = np.int64(0), math.inf  # a plain 0 is of a type of its own at first
    needed = float(max_draws)
    draws = 0
    state = seed
    while draws < needed:
        draws += 1
        state, i, j = draw_pair(state, n)
        if not _two_point_motion(p_a, p_b, i, j, gate_m, min_baseline_m, T_a_b):
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
