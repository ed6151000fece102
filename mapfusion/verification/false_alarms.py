"""Number of false alarms (NFA): would chance give an alignment as much support?

Pairs are independent of each other and ordered by how well they match, best first.

No correspondence can be false then. What chance could do is lay k of n named landmarks on their
namesakes by geometry alone: under a motion that is wrong, as of a map that is distorted, each of
them lies anywhere on the ground that the landmarks span, and so within r of its namesake with the
probability p = pi r^2 / A. A motion that two of them determine finds k - 2 supporters among the
others with the binomial's tail B(k - 2; n - 2, p); it is one motion however many pairs of its
supporters determine it, so that of all n (n - 1) / 2 pairs

    NFA = gates * n (n - 1) / (k (k - 1)) * B(k - 2; n - 2, p).

Three of three that agree to a decimetre on 100 m^2 are evidence. So are nine of nine that agree to
0.7 m, as in maps whose paths bend: a gate twice the widest for unnamed landmarks is tried as well.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple

import numpy as np

from mapfusion.align.alignment import MIN_PAIRS, Alignment, Pairs, Status
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.nearest_neighbours import Grid, ranges_within
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import moved_point
from mapfusion.parameters import Range, require_in_range

# Best supporters among whose pairs the motion to be judged is sought: of that many one is near it.
_CANDIDATES = 20
# Halving ends above this: p is not known from fewer pairs, and 8 of them could hardly be accepted.
_SMALLEST_SELECTION = 16
_ROUNDING = 1e-12  # share of a squared distance that rounding may make it larger


class IndependentPairs(NamedTuple):
    """Pairs that are independent of each other, best match first, for the kernels.

    Attributes:
        p_a, p_b: (N, 2) positions in metres, each in its own frame.
        heights: (N, 4) z of a and of b, and the most that the squared difference of two heights may
            be, as the sum of a part of a's and one of b's.
        possible: (N,) `possible_repairings`.
        near_a: the grid over p_a.
    """

    p_a: Float
    p_b: Float
    heights: Float
    possible: np.ndarray
    near_a: Grid


def independent_pairs(p_a: Float, p_b: Float, heights: Float) -> IndependentPairs:
    """Of positions (N, 2) and heights (N, 4), with all that no motion changes."""
    return IndependentPairs(p_a, p_b, heights, possible_repairings(heights), Grid.of(p_a))


def independent_rows(p_a: Float, p_b: Float, patch_m: float) -> np.ndarray:
    """Rows (n,) of the pairs (N, 2 or 3), in order, that are no neighbours of a kept one.

    Neighbours are less than patch_m apart in both maps.
    """
    return np.flatnonzero(_mark_thinned(p_a, p_b, patch_m, Grid.of(p_a)))


@kernel
def _mark_thinned(p_a: Float, p_b: Float, patch_m: float, near_a: Grid) -> np.ndarray:
    kept = np.zeros(len(p_a), np.bool_)
    runs = np.empty((near_a.shape[1], 2), np.int64)
    for i in range(len(p_a)):
        n_runs = ranges_within(p_a[i, 0], p_a[i, 1], patch_m, near_a, runs)
        kept[i] = not _has_neighbour(i, p_a, p_b, patch_m, near_a.row, runs[:n_runs], kept)
    return kept


@kernel
def _has_neighbour(
    i: int,
    p_a: Float,
    p_b: Float,
    patch_m: float,
    row_of: np.ndarray,
    runs: np.ndarray,
    kept: np.ndarray,
) -> bool:
    """Whether a kept pair in some ranges (R, 2) of the grid is a neighbour of pair i."""
    for run in range(len(runs)):
        for k in range(runs[run, 0], runs[run, 1]):
            j = row_of[k]
            if kept[j] and is_closer(p_a, i, j, patch_m) and is_closer(p_b, i, j, patch_m):
                return True
    return False


@kernel
def is_closer(p: Float, i: int, j: int, distance_m: float) -> bool:
    """Whether points i and j of (N, D) are less than a distance apart."""
    if abs(p[i, 0] - p[j, 0]) >= distance_m:  # most are already told apart by this
        return False
    square = 0.0
    for axis in range(p.shape[1]):
        square += (p[i, axis] - p[j, axis]) ** 2
    return square < distance_m * distance_m


@kernel
def log10_tail(k: int, n: int, p: float) -> float:
    """log10 of the probability of k or more successes in n trials; 0 up to the mean.

    The first term in logarithms and the others relative to it: tails far below the smallest
    number a float can hold.
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
    """T p_b (n, 2)."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    moved = np.empty((len(p_b), 2))
    for i in range(len(p_b)):
        moved[i, 0], moved[i, 1] = moved_point(T_a_b, cos, sin, p_b[i, 0], p_b[i, 1])
    return moved


@kernel
def residuals_m(T_a_b: Float, p_a: Float, p_b: Float) -> Float:
    """Distances (n,) in the plane between p_a and T p_b."""
    moved = moved_points(T_a_b, p_b)
    distance = np.empty(len(p_a))
    for i in range(len(p_a)):
        distance[i] = math.hypot(p_a[i, 0] - moved[i, 0], p_a[i, 1] - moved[i, 1])
    return distance


@kernel
def minimal_motion(p_a: Float, p_b: Float, supporters: np.ndarray, T_a_b: Float) -> Float:
    """The motion (3,) of two pairs nearest to T_a_b: least displacement of the supporters (RMS).

    Supporters (k,) are rows of the pairs (n, 2), those that T_a_b fits best first.
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
    nearest, found = math.inf, T_a_b.copy()
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
                found[0], found[1], found[2] = tx, ty, theta
    return found


@kernel
def same_height(heights: Float, i: int, j: int) -> bool:
    """Whether landmark a of pair i and landmark b of pair j can have one height."""
    dz = heights[i, 0] - heights[j, 1]
    return dz * dz <= heights[i, 2] + heights[j, 3]


@kernel
def possible_repairings(heights: Float) -> np.ndarray:
    """How many (i, j), i not j, can have one height, both among the first m + 1 pairs: (N,)."""
    counts = np.zeros(len(heights), np.int64)
    # a column as one piece, so that the compiler compares several at once
    z_a, z_b = heights[:, 0].copy(), heights[:, 1].copy()
    most_a, most_b = heights[:, 2].copy(), heights[:, 3].copy()
    total = 0
    for m in range(len(heights)):
        for i in range(m):
            there, back = z_a[i] - z_b[m], z_a[m] - z_b[i]
            total += there * there <= most_a[i] + most_b[m]
            total += back * back <= most_a[m] + most_b[i]
        counts[m] = total
    return counts


@kernel
def agreeing_repairings(
    T_a_b: Float, pairs: IndependentPairs, gates_m: Float, first: int
) -> np.ndarray:
    """How many (i, j), i not j, of one height agree under T_a_b within each gate.

    Counts (2, G), for ascending gates: among the `first` pairs only, among all.
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
                if dx * dx + dy * dy > beyond:  # without the root, most are told already
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
    """The larger p of the selection's and all pairs', from counts (2, G) at gate g and of possible.

    One more than was counted, as in a test by permutations: that none of a few re-pairings agrees
    does not make p zero.
    """
    return max((agreeing[0, g] + 1) / (possible + 1), (agreeing[1, g] + 1) / (of_all + 1))


@kernel
def fewest_false_alarms(
    pairs: IndependentPairs, T_a_b: Float, gates_m: Float
) -> tuple[float, float, int, int]:
    """The smallest NFA over gates and selections of the best-matching pairs.

    Gates (G,) are ascending. Returns log10 of the NFA, and the gate, number of pairs and of
    supporters it came from.
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
        # Rows (k,) among the first n whose distance (N,) is within the gate.
        # The nearest, as many as `minimal_motion` seeks among, come first, by ascending distance;
        # they are kept by insertion, since Numba takes seconds to compile its sorts.
        gate_m = gates_m[-1]
        rows = np.empty(n, np.int64)
        k = 0
        for i in range(n):
            if distance[i] <= gate_m:
                place, rows[k] = k, i
                if k >= _CANDIDATES:
                    place = _CANDIDATES - 1
                    if distance[rows[place]] > distance[i]:
                        rows[k] = rows[place]
                    else:
                        place = -1
                k += 1
                while place > 0 and distance[rows[place - 1]] > distance[i]:
                    rows[place] = rows[place - 1]
                    place -= 1
                if place >= 0:
                    rows[place] = i
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


# Times the widest gate: the next of gates that double. Either map may be bent by what the widest
# allows for both; and what a gate more costs is counted, as chance has one more to try.
_BENT = 2.0


def named_false_alarms(
    p_a: Float, p_b: Float, T_a_b: Float, gates_m: Float
) -> tuple[float, float, int, int]:
    """log10 of the smallest NFA over the gates, and the gate, number and supporters behind it.

    Args:
        p_a: (N, 2) positions in metres, in frame a.
        p_b: (N, 2) of their namesakes, in frame b.
        T_a_b: (3,).
        gates_m: (G,) ascending.

    Returns:
        Infinite, the widest gate, N and the supporters within it where these are too few.
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


_MAX_GATES = 20  # each is another pass over all pairs


@dataclass(frozen=True)
class Verdict:
    """Whether an alignment may be used.

    Attributes:
        status: accepted, or why not; that of the alignment where it failed before.
        log10_false_alarms: decimal logarithm of how many alignments at least this well supported
            chance is expected to give for these two maps; NaN where there was none to judge.
        reason: what a person can act on, or has to know of an accepted one; else empty.
        log10_evidence: decimal logarithm of how much likelier what both robots saw is if it is
            right; NaN where none was sought.
        n_confirmed: regions that both must have seen, and have.
        n_contradicted: regions that one of them lacks.
        probability: that it is right; NaN where no evidence was sought.
    """

    status: Status
    log10_false_alarms: float
    reason: str = ""
    log10_evidence: float = math.nan
    n_confirmed: int = 0
    n_contradicted: int = 0
    probability: float = math.nan

    @property
    def accepted(self) -> bool:
        """By the estimator and by all tests."""
        return self.status is Status.ACCEPTED

    def applied_to(self, alignment: Alignment) -> Alignment:
        """The alignment with the status of the verdict; a failed one stays what it is."""
        if self.accepted or not alignment.ok:
            return alignment
        return replace(alignment, status=self.status, reason=self.reason)


@dataclass(frozen=True)
class Acceptance:
    """A-contrario test of an alignment, the same for every estimator (Moisan and Stival 2004).

    Against it stands chance: all correspondences false, each landmark of map a paired with a random
    one of the same height among map b's. Under a motion T such a pair agrees within a gate with a
    probability p(T), the share that do so among all re-pairings of the very landmarks at hand; maps
    made of walls have a larger p(T) where T lays wall on wall. A motion that two of n
    correspondences determine then finds k - 2 supporters or more among the others with probability
    at most the binomial's tail B(k - 2; n - 2, p) (pairs of unequal p only make it smaller:
    Hoeffding 1956), and the expected number of such motions among all n (n - 1) / 2 is at most

        NFA = tests * n (n - 1) / 2 * B(k - 2; n - 2, p(T)),

    where `tests` counts the gates and selections tried. An alignment is judged by the motion of two
    of its own supporters that lies nearest to it; only those count that both bring together. So
    whatever estimator was used, and however often: two maps without common ground have an
    acceptable alignment with probability at most `false_alarms`.

    Two things would break this and are met. Neighbours are not independent: corners of one patch
    share most of their descriptors' windows, and one point may be in a map twice. So of
    correspondences that are neighbours in both maps only the best-matching one is used. And n false
    ones can hide few true ones: the best-matching half, quarter, ... are tested as well.

    Known identities are another matter: see `named_landmarks.py`.

    What it cannot see: texture that repeats is not chance. A poster that hangs on two walls gives
    as many supporters as common ground does (`mapfusion/verification` sees to that).

    Attributes:
        false_alarms: accepted expected number of chance alignments for a pair of maps.
        gates_m: distances in the plane up to which a pair supports a motion: from a landmark's own
            noise to what drift displaces true pairs by.
        patch_m: correspondences nearer than this to each other, in both maps, are one: without
            common ground such neighbours are far more frequent than under re-pairing.
        height: which landmarks can have one height (not for planar maps).
    """

    false_alarms: Annotated[float, Range(1e-100, 1, "1")] = 1e-3
    gates_m: tuple[Annotated[float, Range(1e-3, 100, "m")], ...] = (0.05, 0.1, 0.2, 0.4)
    patch_m: Annotated[float, Range(0, 100, "m")] = 0.2
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        require_in_range(self)
        if not 1 <= len(self.gates_m) <= _MAX_GATES:
            raise ValueError(f"gates_m: expected 1 to {_MAX_GATES} distances")

    def judge(self, pairs: Pairs, alignment: Alignment) -> Verdict:
        """Hold an alignment of these correspondences against chance."""
        return self.on(pairs).judge(alignment)

    def on(self, pairs: Pairs) -> "ChanceTest":
        """The test for these correspondences, made ready for any number of alignments."""
        gates_m = np.array(sorted(self.gates_m))
        if pairs.by_name:
            in_plan = pairs.in_plan()
            return ChanceTest(self.false_alarms, gates_m, (in_plan.p_a, in_plan.p_b))
        pairs = pairs[self._independent(pairs)]
        planar = pairs.in_plan()
        independent = independent_pairs(planar.p_a, planar.p_b, self._heights(pairs))
        return ChanceTest(self.false_alarms, gates_m, independent)

    def _independent(self, pairs: Pairs) -> np.ndarray:
        """Rows (n,) of the pairs that count, best match first."""
        rows = pairs.of_one_height(self.height)
        rows = rows[np.argsort(pairs.distance[rows], kind="stable")]
        return rows[independent_rows(*pairs[rows].points(), self.patch_m)]

    def _heights(self, pairs: Pairs) -> Float:
        """Heights (n, 4) as `IndependentPairs` has them; of planar maps all 0."""
        if pairs.planar:
            return np.zeros((len(pairs), 4))
        bound = self.height.bound
        variance_a = pairs.covariance_a[:, 2, 2]
        variance_b = pairs.covariance_b[:, 2, 2] + self.height.floor_m**2
        return np.stack(
            [pairs.p_a[:, 2], pairs.p_b[:, 2], bound * variance_a, bound * variance_b], axis=1
        )


@dataclass(frozen=True)
class ChanceTest:
    """`Acceptance` for the independent correspondences of two maps.

    Attributes:
        false_alarms: accepted expected number of chance alignments.
        gates_m: (G,) ascending.
        pairs: the correspondences, or the places (N, 2) of namesakes in both maps.
    """

    false_alarms: float
    gates_m: Float
    pairs: IndependentPairs | tuple[Float, Float]

    def judge(self, alignment: Alignment) -> Verdict:
        """Hold one alignment of the correspondences against chance."""
        if not alignment.ok or not np.all(np.isfinite(alignment.T_a_b)):
            return Verdict(alignment.status, math.nan, alignment.reason)
        if isinstance(self.pairs, IndependentPairs):
            found = fewest_false_alarms(self.pairs, alignment.T_a_b, self.gates_m)
        else:
            found = named_false_alarms(*self.pairs, alignment.T_a_b, self.gates_m)
        log10, gate_m, n, k = found
        if log10 <= math.log10(self.false_alarms):
            return Verdict(Status.ACCEPTED, log10)
        return Verdict(Status.REFUSED, log10, self._why(log10, gate_m, n, k))

    def _why(self, log10: float, gate_m: float, n: int, k: int) -> str:
        if n < MIN_PAIRS:
            return f"{n} independent correspondences are too few to tell from chance"
        if k < MIN_PAIRS:
            return f"fewer than {MIN_PAIRS} of {n} independent correspondences support it"
        times = f"{10**log10:.2g}" if log10 < 4 else f"1e{log10:.0f}"
        return (
            f"{k} of {n} independent correspondences agree within {gate_m:g} m; chance alone gives "
            f"as much {times} times for these maps, {self.false_alarms:g} are allowed"
        )
