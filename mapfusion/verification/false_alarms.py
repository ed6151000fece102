"""A-contrario test of an alignment: expected number of false alarms (NFA).

Desolneux, Moisan and Morel (2000); Moisan and Stival (2004). The test of unlabelled landmarks is
described in `Acceptance`. Of labelled landmarks no correspondence is false; chance can only bring k
of n namesakes together under a wrong motion, as of a distorted map. Each landmark then lies
anywhere on the area A of the landmarks, and within r of its namesake with p = pi r^2 / A. A motion
of two of them finds k - 2 supporters among the others with the binomial tail B(k - 2; n - 2, p).
The same motion follows from each pair of its supporters, so that of n (n - 1) / 2 pairs

    NFA = gates * n (n - 1) / (k (k - 1)) * B(k - 2; n - 2, p).

An additional gate of twice the widest one admits maps with bent paths.
"""

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from mapfusion.align.alignment import MIN_PAIRS, Alignment, Pairs, Status
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.nearest_neighbours import Grid, ranges_within
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import moved_point
from mapfusion.parameters import Range, require_in_range

if TYPE_CHECKING:
    from mapfusion.verification.geometric_false_alarms import RandomPlacement

# Number of best supporters whose pairs are candidates for the motion that is tested. One of these
# motions is close to the alignment.
_CANDIDATES = 20
# Smallest selection of pairs: p is not estimated from fewer, and 8 pairs are hardly ever accepted.
_SMALLEST_SELECTION = 16
_ROUNDING = 1e-12  # relative rounding error of a squared distance


class IndependentPairs(NamedTuple):
    """Independent pairs, best match first, as arrays for kernels.

    Attributes:
        p_a, p_b: positions in metres, each in its own frame, shape (N, 2).
        heights: z of a, z of b, and the contributions of a and of b to the largest squared
            difference of heights, shape (N, 4).
        possible: `possible_repairings`, shape (N,).
        near_a: grid over p_a.
    """

    p_a: Float
    p_b: Float
    heights: Float
    possible: np.ndarray
    near_a: Grid


def independent_pairs(p_a: Float, p_b: Float, heights: Float) -> IndependentPairs:
    """Return the pairs of positions (N, 2) and heights (N, 4), with their counts and grid."""
    return IndependentPairs(p_a, p_b, heights, possible_repairings(heights), Grid.of(p_a))


@kernel
def _mark_independent(p_a: Float, p_b: Float, patch_m: float, near_a: Grid) -> np.ndarray:
    """Mark the pairs (N,) of `independent_rows`; `near_a` is the grid over p_a."""
    is_independent = np.zeros(len(p_a), np.bool_)
    ranges = np.empty((near_a.shape[1], 2), np.int64)
    for i in range(len(p_a)):
        is_neighbour = False
        for r in range(ranges_within(p_a[i, 0], p_a[i, 1], patch_m, near_a, ranges)):
            for k in range(ranges[r, 0], ranges[r, 1]):
                j = near_a.row[k]
                if (
                    is_independent[j]
                    and is_closer(p_a, i, j, patch_m)
                    and is_closer(p_b, i, j, patch_m)
                ):
                    is_neighbour = True
                    break
            if is_neighbour:
                break
        is_independent[i] = not is_neighbour
    return is_independent


def independent_rows(p_a: Float, p_b: Float, patch_m: float) -> np.ndarray:
    """Return the rows (n,) of the pairs (N, 2 or 3) without neighbours among earlier kept pairs.

    Neighbours are closer than patch_m in both maps.
    """
    return np.flatnonzero(_mark_independent(p_a, p_b, patch_m, Grid.of(p_a)))


@kernel
def is_closer(p: Float, i: int, j: int, distance_m: float) -> bool:
    """Return True if points i and j of (N, D) are closer than a distance."""
    if abs(p[i, 0] - p[j, 0]) >= distance_m:  # excludes most points early
        return False
    square = 0.0
    for axis in range(p.shape[1]):
        square += (p[i, axis] - p[j, axis]) ** 2
    return square < distance_m * distance_m


@kernel
def log10_tail(k: int, n: int, p: float) -> float:
    """Return log10 of the probability of k or more successes in n trials; 0 up to the mean.

    The first term is computed as a logarithm and the others relative to it, so that tails far below
    the smallest float are represented.
    """
    if k <= n * p:
        return 0.0
    if p >= 1.0:
        return 0.0 if k <= n else -math.inf
    first = math.lgamma(n + 1.0) - math.lgamma(k + 1.0) - math.lgamma(n - k + 1.0)
    first += k * math.log(p) + (n - k) * math.log1p(-p)
    total = term = 1.0
    for m in range(k, n):
        term *= (n - m) / (m + 1.0) * p / (1 - p)
        total += term
        if term < 1e-17 * total:
            break
    return min((first + math.log(total)) / math.log(10.0), 0.0)


@kernel
def moved_points(T_a_b: Float, p_b: Float) -> Float:
    """Return T p_b, shape (n, 2)."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    moved = np.empty((len(p_b), 2))
    for i in range(len(p_b)):
        moved[i, 0], moved[i, 1] = moved_point(T_a_b, cos, sin, p_b[i, 0], p_b[i, 1])
    return moved


@kernel
def residuals_m(T_a_b: Float, p_a: Float, p_b: Float) -> Float:
    """Return the distances in the plane between p_a and T p_b, shape (n,)."""
    moved = moved_points(T_a_b, p_b)
    distance = np.empty(len(p_a))
    for i in range(len(p_a)):
        distance[i] = math.hypot(p_a[i, 0] - moved[i, 0], p_a[i, 1] - moved[i, 1])
    return distance


@kernel
def minimal_motion(p_a: Float, p_b: Float, supporters: np.ndarray, T_a_b: Float) -> Float:
    """Return the motion (3,) of two supporters that is nearest to T_a_b.

    The distance is the RMS displacement of the supporters. Supporters (k,) are rows of the pairs
    (n, 2), ordered by their residual under T_a_b.
    """
    k = len(supporters)
    mean_x = mean_y = square = 0.0
    for i in range(k):
        row = supporters[i]
        mean_x += p_b[row, 0] / k
        mean_y += p_b[row, 1] / k
    for i in range(k):
        row = supporters[i]
        square += ((p_b[row, 0] - mean_x) ** 2 + (p_b[row, 1] - mean_y) ** 2) / k
    nearest, best_motion = math.inf, T_a_b.copy()
    two = np.empty(2, np.int64)
    candidates = min(k, _CANDIDATES)
    for m in range(1, candidates):
        for l in range(m):  # noqa: E741
            two[0], two[1] = supporters[l], supporters[m]
            tx, ty, theta = fit_rigid(p_a, p_b, two)
            turned = math.cos(theta) - math.cos(T_a_b[2]), math.sin(theta) - math.sin(T_a_b[2])
            dx = tx - T_a_b[0] + turned[0] * mean_x - turned[1] * mean_y
            dy = ty - T_a_b[1] + turned[1] * mean_x + turned[0] * mean_y
            moved = dx * dx + dy * dy + (turned[0] ** 2 + turned[1] ** 2) * square
            if moved < nearest:
                nearest = moved
                best_motion[0], best_motion[1], best_motion[2] = tx, ty, theta
    return best_motion


@kernel
def same_height(heights: Float, i: int, j: int) -> bool:
    """Return True if landmark a of pair i and landmark b of pair j may have the same height."""
    dz = heights[i, 0] - heights[j, 1]
    return dz * dz <= heights[i, 2] + heights[j, 3]


@kernel
def possible_repairings(heights: Float) -> np.ndarray:
    """Count the (i, j), i != j, of compatible height among the first m + 1 pairs, shape (N,)."""
    counts = np.zeros(len(heights), np.int64)
    # contiguous columns, so that the loop is vectorised
    z_a, z_b = heights[:, 0].copy(), heights[:, 1].copy()
    most_a, most_b = heights[:, 2].copy(), heights[:, 3].copy()
    total = 0
    for m in range(len(heights)):
        for i in range(m):
            z_difference_a, z_difference_b = z_a[i] - z_b[m], z_a[m] - z_b[i]
            total += z_difference_a * z_difference_a <= most_a[i] + most_b[m]
            total += z_difference_b * z_difference_b <= most_a[m] + most_b[i]
        counts[m] = total
    return counts


@kernel
def agreeing_repairings(
    T_a_b: Float, pairs: IndependentPairs, gates_m: Float, first: int
) -> np.ndarray:
    """Count the (i, j), i != j, of compatible height that agree under T_a_b within each gate.

    Gates ascend. Returns counts, shape (2, G): among the `first` pairs, and among all pairs.
    """
    _, p_b, heights, _, near_a = pairs
    moved = moved_points(T_a_b, p_b)
    agreeing = np.zeros((2, len(gates_m)), np.int64)
    runs = np.empty((near_a.shape[1], 2), np.int64)
    widest = gates_m[-1]
    beyond = widest * widest * (1 + _ROUNDING)
    for j in range(len(p_b)):
        x, y = moved[j, 0], moved[j, 1]
        for run in range(ranges_within(x, y, widest, near_a, runs)):
            for k in range(runs[run, 0], runs[run, 1]):
                dx, dy = near_a.p[k, 0] - x, near_a.p[k, 1] - y
                if dx * dx + dy * dy > beyond:  # excludes most points without a square root
                    continue
                i, distance = near_a.row[k], math.hypot(dx, dy)
                if distance > widest or i == j or not same_height(heights, i, j):
                    continue
                for g in range(len(gates_m)):
                    if distance <= gates_m[g]:
                        agreeing[1, g] += 1
                        if i < first and j < first:
                            agreeing[0, g] += 1
    return agreeing


@kernel
def chance_of_agreeing(agreeing: np.ndarray, g: int, possible: int, of_all: int) -> float:
    """Return the larger estimate of p, from the selection and from all pairs, at gate g.

    As in a permutation test, one is added to both counts, so that p is not 0 if no re-pairing
    agrees. `agreeing` (2, G) counts re-pairings that agree; `possible` and `of_all` count all.
    """
    return max((agreeing[0, g] + 1) / (possible + 1), (agreeing[1, g] + 1) / (of_all + 1))


@kernel
def fewest_false_alarms(
    pairs: IndependentPairs, T_a_b: Float, gates_m: Float
) -> tuple[float, float, int, int]:
    """Return the smallest NFA over gates and selections of the best-matching pairs.

    Gates (G,) ascend. Returns log10 of the NFA, the gate, the number of pairs and the number of
    supporters.
    """
    p_a, p_b, _, possible, _ = pairs
    total = len(p_a)
    selections = 1
    while total >> selections >= _SMALLEST_SELECTION:
        selections += 1
    distance = residuals_m(T_a_b, p_a, p_b)
    best, best_gate, best_n, best_k = math.inf, 0.0, total, 0
    for s in range(selections):
        n = total >> s
        # rows among the first n within the widest gate; the nearest ones, the candidates of
        # `minimal_motion`, come first in ascending distance (insertion, since Numba takes seconds
        # to compile a sort)
        gate_m = gates_m[-1]
        rows = np.empty(n, np.int64)
        k = 0
        for i in range(n):
            if distance[i] <= gate_m:
                position, rows[k] = k, i
                if k >= _CANDIDATES:
                    position = _CANDIDATES - 1
                    if distance[rows[position]] > distance[i]:
                        rows[k] = rows[position]
                    else:
                        position = -1
                k += 1
                while position > 0 and distance[rows[position - 1]] > distance[i]:
                    rows[position] = rows[position - 1]
                    position -= 1
                if position >= 0:
                    rows[position] = i
        supporters = rows[:k]
        if len(supporters) < MIN_PAIRS:
            continue
        T_two = minimal_motion(p_a, p_b, supporters, T_a_b)
        agreeing = agreeing_repairings(T_two, pairs, gates_m, n)
        under_two = residuals_m(T_two, p_a, p_b)
        tests = math.log10(selections * len(gates_m)) + math.log10(n * (n - 1) / 2)
        for g in range(len(gates_m)):
            k = 0
            for i in range(n):
                k += distance[i] <= gates_m[g] and under_two[i] <= gates_m[g]
            if k < MIN_PAIRS:
                continue
            p = chance_of_agreeing(agreeing, g, possible[n - 1], possible[total - 1])
            log10 = tests + log10_tail(k - 2, n - 2, p)
            if log10 < best:
                best, best_gate, best_n, best_k = log10, gates_m[g], n, k
    return best, best_gate, best_n, best_k


# Ratio of the additional gate of labelled landmarks to the widest gate: each of the two maps may be
# bent by the width of this gate. The additional gate is counted in the NFA.
_BENT = 2.0


def named_false_alarms(
    p_a: Float, p_b: Float, T_a_b: Float, gates_m: Float
) -> tuple[float, float, int, int]:
    """Return the smallest NFA of labelled landmarks over the gates.

    Args:
        p_a: positions in metres in frame a, shape (N, 2).
        p_b: positions of their namesakes in frame b, shape (N, 2).
        T_a_b: motion, shape (3,).
        gates_m: ascending gates, shape (G,).

    Returns:
        log10 of the NFA, the gate, N and the number of supporters; infinite with the widest gate if
        there are too few supporters.
    """
    gates_m = np.append(gates_m, _BENT * gates_m[-1])
    n, distance = len(p_a), residuals_m(T_a_b, p_a, p_b)
    best = math.inf, float(gates_m[-1]), n, int(np.sum(distance <= gates_m[-1]))
    for gate_m in gates_m:
        k = int(np.sum(distance <= gate_m))
        if k < MIN_PAIRS:
            continue
        width, depth = np.ptp(p_a, axis=0) + 2 * gate_m
        p = min(math.pi * gate_m**2 / (width * depth), 1.0)
        motions = n * (n - 1) / (k * (k - 1))
        log10 = math.log10(len(gates_m) * motions) + log10_tail(k - 2, n - 2, p)
        if log10 < best[0]:
            best = log10, float(gate_m), n, k
    return best


_MAX_GATES = 20  # each gate is a pass over all pairs


@dataclass(frozen=True)
class Verdict:
    """Decision on the use of an alignment.

    Attributes:
        status: accepted, or the kind of refusal; the status of the alignment if it failed before.
        log10_false_alarms: log10 of the NFA, the expected number of chance alignments of these maps
            with at least this support; NaN without an alignment.
        reason: reason of a refusal, or a remark on an accepted alignment; else empty.
        log10_evidence: log10 likelihood ratio of the regions that both robots must have seen; NaN
            without evidence.
        log10_ratio_passed: log10 of the largest `least_ratio` that these regions pass; infinite if
            they pass any; NaN without evidence.
        n_confirmed: number of these regions that are in both maps.
        n_contradicted: number of these regions that are missing from one map.
    """

    status: Status
    log10_false_alarms: float
    reason: str = ""
    log10_evidence: float = math.nan
    log10_ratio_passed: float = math.nan
    n_confirmed: int = 0
    n_contradicted: int = 0

    @property
    def accepted(self) -> bool:
        """True if the estimator and all tests accept the alignment."""
        return self.status is Status.ACCEPTED

    def applied_to(self, alignment: Alignment) -> Alignment:
        """Return the alignment with the status of the verdict; a failed one is unchanged."""
        if self.accepted or not alignment.ok:
            return alignment
        return replace(alignment, status=self.status, reason=self.reason)


@dataclass(frozen=True)
class Acceptance:
    """A-contrario test of an alignment, the same for every estimator (Moisan and Stival 2004).

    Null hypothesis: all correspondences are false, and each landmark of map a is paired with a
    random landmark of map b of the same height. Under a motion T such a pair agrees within a gate
    with a probability p(T), estimated as the share of all re-pairings of the given landmarks that
    agree. p(T) is larger where T maps walls onto walls. A motion of two of n correspondences then
    finds k - 2 or more supporters among the others with probability at most the binomial tail
    B(k - 2; n - 2, p) (unequal p make it smaller: Hoeffding 1956). The expected number of such
    motions among all n (n - 1) / 2 is at most

        NFA = tests * n (n - 1) / 2 * B(k - 2; n - 2, p(T)),

    where `tests` is the number of gates and selections. An alignment is tested by the motion of two
    of its supporters that is nearest to it, and only pairs that agree under both motions count. For
    any estimator and any number of repetitions, two maps without common ground therefore have an
    acceptable alignment with probability at most `false_alarms`.

    Neighbouring landmarks are not independent: corners of one patch share most of their descriptor
    windows, and one point may be in a map twice. Of correspondences that are neighbours in both
    maps only the best match is used. Many false correspondences can hide few true ones: the best
    half, quarter, and so on, are tested as well.

    Repeated texture passes this test, because it is not random; the other tests of
    `mapfusion.verification` detect it. Labelled landmarks have a test of their own, see
    `named_false_alarms`.

    Attributes:
        false_alarms: largest accepted expected number of chance alignments of a pair of maps.
        gates_m: distances in the plane up to which a pair supports a motion, from the noise of a
            landmark to the displacement by drift.
        patch_m: correspondences closer than this in both maps count as one. Without common ground
            such neighbours are much more frequent than under re-pairing.
        height: test of compatible heights (not for planar maps).
    """

    false_alarms: Annotated[float, Range(1e-100, 1, "1")] = 1e-3
    gates_m: tuple[Annotated[float, Range(1e-3, 100, "m")], ...] = (0.05, 0.1, 0.2, 0.4)
    patch_m: Annotated[float, Range(0, 100, "m")] = 0.2
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        require_in_range(self)
        if not 1 <= len(self.gates_m) <= _MAX_GATES:
            raise ValueError(f"gates_m: expected 1 to {_MAX_GATES} distances")

    def verify(self, pairs: Pairs, alignment: Alignment) -> Verdict:
        """Test an alignment of these correspondences against chance."""
        return self.on(pairs).verify(alignment)

    def on(self, pairs: Pairs) -> "ChanceTest":
        """Prepare the test of any number of alignments of these correspondences."""
        gates_m = np.array(sorted(self.gates_m))
        if pairs.by_name:
            in_plan = pairs.in_plan()
            return ChanceTest(self.false_alarms, gates_m, (in_plan.p_a, in_plan.p_b))
        if pairs.by_geometry:
            # a local import, because that module builds on this one
            from mapfusion.verification.geometric_false_alarms import RandomPlacement

            random_placement = RandomPlacement.of(pairs, self.height, self.patch_m)
            return ChanceTest(self.false_alarms, gates_m, random_placement)
        # independent pairs of compatible height, best match first
        rows = pairs.of_one_height(self.height)
        rows = rows[np.argsort(pairs.distance[rows], kind="stable")]
        pairs = pairs[rows[independent_rows(*pairs[rows].points(), self.patch_m)]]
        heights = np.zeros((len(pairs), 4))
        if not pairs.planar:
            bound = self.height.bound
            heights[:, 0], heights[:, 1] = pairs.p_a[:, 2], pairs.p_b[:, 2]
            heights[:, 2] = bound * pairs.covariance_a[:, 2, 2]
            heights[:, 3] = bound * (pairs.covariance_b[:, 2, 2] + self.height.floor_m**2)
        planar = pairs.in_plan()
        independent = independent_pairs(planar.p_a, planar.p_b, heights)
        return ChanceTest(self.false_alarms, gates_m, independent)


@dataclass(frozen=True)
class ChanceTest:
    """`Acceptance` prepared for the correspondences of two maps.

    Attributes:
        false_alarms: largest accepted expected number of chance alignments.
        gates_m: ascending gates, shape (G,).
        pairs: independent correspondences; the positions (N, 2) of labelled landmarks; or the null
            hypothesis of maps that are matched by geometry alone.
    """

    false_alarms: float
    gates_m: Float
    pairs: "IndependentPairs | tuple[Float, Float] | RandomPlacement"

    def verify(self, alignment: Alignment) -> Verdict:
        """Test one alignment of the correspondences against chance."""
        if not alignment.ok or not np.all(np.isfinite(alignment.T_a_b)):
            return Verdict(alignment.status, math.nan, alignment.reason)
        counted = "independent correspondences"
        if isinstance(self.pairs, IndependentPairs):
            result = fewest_false_alarms(self.pairs, alignment.T_a_b, self.gates_m)
        elif isinstance(self.pairs, tuple):
            result = named_false_alarms(*self.pairs, alignment.T_a_b, self.gates_m)
        else:
            result = self.pairs.fewest_false_alarms(alignment.T_a_b, self.gates_m)
            counted = "landmarks"
        log10, gate_m, n, k = result
        if log10 <= math.log10(self.false_alarms):
            return Verdict(Status.ACCEPTED, log10)
        if n < MIN_PAIRS:
            reason = f"{n} {counted} are too few to tell from chance"
        elif k < MIN_PAIRS:
            reason = f"fewer than {MIN_PAIRS} of {n} {counted} support it"
        else:
            if log10 < 1:
                times = f"{10**log10:.2g}"
            else:
                times = f"{10**log10:.0f}" if log10 < 4 else f"1e{log10:.0f}"
            reason = (
                f"{k} of {n} {counted} agree within {gate_m:g} m; chance alone "
                f"gives as much {times} times for these maps, {self.false_alarms:g} are allowed"
            )
        return Verdict(Status.REFUSED, log10, reason)
