"""Acceptance: is the support of an alignment more than chance would give for these two maps?"""

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.pairs import MIN_PAIRS, Pairs, gather
from mapfusion.align.result import Alignment
from mapfusion.align.rigid import fit_rigid
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

# Best supporters among whose pairs the motion to be judged is sought: of 190 pairs one reproduces
# the alignment to a few millimetres.
_CANDIDATES = 20
# Halving ends above this: p is not known from fewer pairs, and 8 of them could hardly be accepted.
_SMALLEST_SELECTION = 16


@dataclass(frozen=True)
class Verdict:
    """Whether an alignment may be used.

    Attributes:
        accepted: by the estimator and by the test against chance.
        log10_false_alarms: decimal logarithm of how many alignments at least this well supported
            chance is expected to give for these two maps; NaN where there was none to judge.
        reason: empty when accepted, else what a person can act on.
    """

    accepted: bool
    log10_false_alarms: float
    reason: str = ""


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

    What it cannot see: texture that repeats is not chance. A poster that hangs on two walls gives
    as many supporters as common ground does.

    Attributes:
        false_alarms: accepted expected number of chance alignments for a pair of maps.
        gates_m: distances in the plane up to which a pair supports a motion: from a landmark's own
            noise to what drift displaces true pairs by.
        patch_m: correspondences nearer than this to each other, in both maps, are one. Measured
            on maps without common ground: such neighbours are 11 times (below 0.1 m) and 2.8 times
            (0.1 to 0.2 m) as frequent as under re-pairing, 1.3 times beyond.
        height: which landmarks can have one height (not for planar maps).
    """

    false_alarms: float = 1e-3
    gates_m: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4)
    patch_m: float = 0.2
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        if not 0 < self.false_alarms <= 1:
            raise ValueError(f"false_alarms: is {self.false_alarms}, expected above 0, at most 1")
        if not self.gates_m or not all(0 < gate < math.inf for gate in self.gates_m):
            raise ValueError("gates_m: expected one or more positive distances")
        if not 0 <= self.patch_m < math.inf:
            raise ValueError("patch_m: must not be negative")

    def judge(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        alignment: Alignment,
    ) -> Verdict:
        """Hold an alignment of these correspondences against chance.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        if not alignment.ok or not np.all(np.isfinite(alignment.T_a_b)):
            return Verdict(False, math.nan, alignment.reason)
        pairs = gather(map_a, map_b, correspondences)
        pairs = pairs[self._independent(pairs, correspondences.distance)]
        log10, gate_m, n, k = fewest_false_alarms(
            np.ascontiguousarray(pairs.p_a[:, :2]),
            np.ascontiguousarray(pairs.p_b[:, :2]),
            *self._heights(pairs),
            alignment.T_a_b,
            np.array(sorted(self.gates_m)),
        )
        if log10 <= math.log10(self.false_alarms):
            return Verdict(True, log10)
        return Verdict(False, log10, self._why(log10, gate_m, n, k))

    def _independent(self, pairs: Pairs, distance: Float) -> np.ndarray:
        """Rows (n,) of the pairs that count, best match first."""
        rows = pairs.of_one_height(self.height)
        rows = rows[np.argsort(distance[rows], kind="stable")]
        dimensions = 2 if pairs.planar else 3
        kept = thin(
            np.ascontiguousarray(pairs.p_a[rows, :dimensions]),
            np.ascontiguousarray(pairs.p_b[rows, :dimensions]),
            self.patch_m,
        )
        return rows[kept]

    def _heights(self, pairs: Pairs) -> tuple[Float, Float, Float, Float]:
        """z_a, z_b and their variances (n,), scaled so that 1 bounds the gate; planar: all 0."""
        if pairs.planar:
            none = np.zeros(len(pairs))
            return none, none, none, none
        bound = self.height.bound
        return (
            np.ascontiguousarray(pairs.p_a[:, 2]),
            np.ascontiguousarray(pairs.p_b[:, 2]),
            bound * pairs.covariance_a[:, 2, 2],
            bound * (pairs.covariance_b[:, 2, 2] + self.height.floor_m**2),
        )

    def _why(self, log10: float, gate_m: float, n: int, k: int) -> str:
        allowed = f"chance may give it {self.false_alarms:g} times"
        if n < MIN_PAIRS:
            return f"{n} independent correspondences are too few to tell from chance"
        if k < MIN_PAIRS:
            return f"fewer than {MIN_PAIRS} of {n} independent correspondences support it"
        times = f"{10**log10:.2g}" if log10 < 4 else f"1e{log10:.0f}"
        return (
            f"{k} of {n} independent correspondences agree within {gate_m:g} m, which {allowed} "
            f"for these maps and is expected to {times} times"
        )


@njit(cache=True)
def thin(p_a: Float, p_b: Float, patch_m: float) -> np.ndarray:
    """Rows (n,) of the pairs (N, 2 or 3), in order, that are no neighbours of a kept one.

    Neighbours are less than patch_m apart in both maps.
    """
    kept = np.empty(len(p_a), np.int64)
    n = 0
    limit = patch_m * patch_m
    for i in range(len(p_a)):
        free = True
        for m in range(n):
            j = kept[m]
            apart_a = apart_b = 0.0
            for axis in range(p_a.shape[1]):
                apart_a += (p_a[i, axis] - p_a[j, axis]) ** 2
                apart_b += (p_b[i, axis] - p_b[j, axis]) ** 2
            if apart_a < limit and apart_b < limit:
                free = False
                break
        if free:
            kept[n] = i
            n += 1
    return kept[:n].copy()


@njit(cache=True)
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


@njit(cache=True)
def residuals_m(T_a_b: Float, p_a: Float, p_b: Float) -> Float:
    """Distances (n,) in the plane between p_a and T p_b."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    distance = np.empty(len(p_a))
    for i in range(len(p_a)):
        dx = p_a[i, 0] - T_a_b[0] - cos * p_b[i, 0] + sin * p_b[i, 1]
        dy = p_a[i, 1] - T_a_b[1] - sin * p_b[i, 0] - cos * p_b[i, 1]
        distance[i] = math.sqrt(dx * dx + dy * dy)
    return distance


@njit(cache=True)
def minimal_motion(p_a: Float, p_b: Float, supporters: np.ndarray, T_a_b: Float) -> Float:
    """The motion (3,) of two pairs nearest to T_a_b: least displacement of the supporters (RMS).

    Args:
        p_a: (n, 2).
        p_b: (n, 2).
        supporters: (k,) rows of the pairs, those that T_a_b fits best first.
        T_a_b: (3,).
    """
    k = len(supporters)
    mean_x = mean_y = square = 0.0
    for row in supporters:
        mean_x += p_b[row, 0] / k
        mean_y += p_b[row, 1] / k
    for row in supporters:
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


@njit(cache=True)
def repairings(
    T_a_b: Float,
    p_a: Float,
    p_b: Float,
    z_a: Float,
    z_b: Float,
    variance_a: Float,
    variance_b: Float,
    gates_m: Float,
) -> tuple[np.ndarray, int]:
    """How many re-pairings (i, j), i not j, have one height, and how many of them agree under T.

    Args:
        T_a_b: (3,).
        p_a: (n, 2).
        p_b: (n, 2).
        z_a: (n,) heights.
        z_b: (n,) heights.
        variance_a: (n,) most that the squared difference of two heights may be is the sum of
            both sides' values.
        variance_b: (n,).
        gates_m: (G,) ascending.

    Returns:
        Those that agree within each gate (G,), and the number of re-pairings of one height.
    """
    n = len(p_a)
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    agreeing = np.zeros(len(gates_m), np.int64)
    compatible = 0
    widest = gates_m[-1] * gates_m[-1]
    x, y = np.empty(n), np.empty(n)
    for j in range(n):
        x[j] = T_a_b[0] + cos * p_b[j, 0] - sin * p_b[j, 1]
        y[j] = T_a_b[1] + sin * p_b[j, 0] + cos * p_b[j, 1]
    for i in range(n):
        for j in range(n):
            dz = z_a[i] - z_b[j]
            if i == j or dz * dz > variance_a[i] + variance_b[j]:
                continue
            compatible += 1
            square = (p_a[i, 0] - x[j]) ** 2 + (p_a[i, 1] - y[j]) ** 2
            if square > widest:
                continue
            for g in range(len(gates_m)):
                if square <= gates_m[g] * gates_m[g]:
                    agreeing[g] += 1
    return agreeing, compatible


@njit(cache=True)
def fewest_false_alarms(
    p_a: Float,
    p_b: Float,
    z_a: Float,
    z_b: Float,
    variance_a: Float,
    variance_b: Float,
    T_a_b: Float,
    gates_m: Float,
) -> tuple[float, float, int, int]:
    """The smallest NFA over gates and selections of the best-matching pairs.

    Args:
        p_a: (N, 2) of independent pairs, best match first.
        p_b: (N, 2).
        z_a: (N,), as all that follow, see `repairings`.
        z_b: (N,).
        variance_a: (N,).
        variance_b: (N,).
        T_a_b: (3,) to be judged.
        gates_m: (G,) ascending.

    Returns:
        log10 of the NFA, and the gate, number of pairs and of supporters it came from.
    """
    total = len(p_a)
    selections = 1
    while total >> selections >= _SMALLEST_SELECTION:
        selections += 1
    distance = residuals_m(T_a_b, p_a, p_b)
    tests = math.log10(selections * len(gates_m))
    best, best_gate, best_n, best_k = math.inf, 0.0, total, 0
    for s in range(selections):
        n = total >> s
        order = np.argsort(distance[:n], kind="mergesort")
        supporters = order[: np.sum(distance[:n] <= gates_m[-1])]
        if len(supporters) < MIN_PAIRS:
            continue
        T_two = minimal_motion(p_a, p_b, supporters, T_a_b)
        all_agreeing, all_compatible = repairings(
            T_two, p_a, p_b, z_a, z_b, variance_a, variance_b, gates_m
        )
        agreeing, compatible = repairings(
            T_two, p_a[:n], p_b[:n], z_a[:n], z_b[:n], variance_a[:n], variance_b[:n], gates_m
        )
        both = np.maximum(distance[:n], residuals_m(T_two, p_a[:n], p_b[:n]))
        motions = math.log10(n * (n - 1) / 2)
        for g in range(len(gates_m)):
            k = int(np.sum(both <= gates_m[g]))
            if k < MIN_PAIRS:
                continue
            # one more than was counted: zero of a few re-pairings does not make p zero
            p = max(
                (agreeing[g] + 1) / (compatible + 1), (all_agreeing[g] + 1) / (all_compatible + 1)
            )
            log10 = tests + motions + log10_tail(k - 2, n - 2, p)
            if log10 < best:
                best, best_gate, best_n, best_k = log10, gates_m[g], n, k
    return best, best_gate, best_n, best_k
