"""A-contrario test of an alignment by geometry alone: number of false alarms over all motions.

Desolneux, Moisan and Morel (2000); Moisan and Stival (2004). There are no correspondences to be
right or wrong, so that all motions and all subsets of the landmarks are tests. Null hypothesis: the
landmarks of map b lie at random about their places, with the density of the map there, and
independently of map a. A motion is given by two landmarks of each map. It is a candidate if both
pairs agree within the gate r: their distances differ by 2 r at most, their heights and attributes
agree. M such motions exist. Under a motion T, another landmark agrees with map a by chance with the
probability p_j(T); their mean is p(T). The expected number of motions of two pairs that k - 2 or
more of the other n - 2 landmarks support is at most

    NFA = gates * M * B(k - 2; n - 2, p(T))

with the binomial tail B (unequal p_j make the tail smaller: Hoeffding 1956). An alignment is tested
by the motion of two of its supporters that is nearest to it, and only pairs that agree under both
count. Two maps without common ground therefore have an acceptable alignment with probability at
most the bound on the NFA, whichever method searched for it, and however often.

p_j(T) is the share of displaced places of landmark j that agree with map a. A landmark is displaced
along the lines to its nearest neighbours. Landmarks on a wall or in a row thus stay on it, and p(T)
is large where T lays rows onto rows. A row laid onto its like by a shift is no chance, and passes;
the other motion with comparable support then makes the alignment ambiguous.
"""

import math
from functools import cached_property

import numpy as np
import scipy

from mapfusion.align.alignment import MIN_PAIRS, Pairs
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.geometric_matching import PlacedSearch, Site, attributes_of_pairs_agree
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import (
    independent_rows,
    log10_tail,
    minimal_motion,
    residuals_m,
)

_NEIGHBOURS = 8  # lines along which a landmark is displaced
# Displacements as shares of the distance to a neighbour, both ways. Neither the landmark's own
# place nor that of the neighbour is among them.
_SHARES = np.array([-5, -3, -1, 1, 3, 5]) / 6
_MOST_PLACES = 50_003  # of displaced landmarks; a prime, so that each step takes all directions
_SAMPLES = 2**17  # quadruples of landmarks that give M; its relative error is a few percent
_SEED = 0


class RandomPlacement:
    """Null hypothesis of two maps, prepared for any number of alignments.

    Args:
        a, b: both maps; no two landmarks of a map are so close that they depend on each other.
        size_tolerance: largest relative difference of two sizes.
    """

    def __init__(self, a: Site, b: Site, size_tolerance: float) -> None:
        self._a, self._b, self._size_tolerance = a, b, size_tolerance
        self._search = PlacedSearch(a, b, size_tolerance)

    @classmethod
    def of(cls, pairs: Pairs, height: HeightGate, patch_m: float) -> "RandomPlacement":
        """Return the null hypothesis of two maps, without landmarks closer than `patch_m`."""
        key = cls, height, patch_m
        if key in pairs.cache:
            return pairs.cache[key]
        gates = math.inf if pairs.planar else height.bound, height.floor_m**2

        def thinned(landmarks: LandmarkMap) -> Site:
            by_count = np.argsort(-landmarks.count.astype(np.int64), kind="stable")
            p = np.ascontiguousarray(landmarks.position_m[by_count, :2])
            rows = by_count[independent_rows(p, p, patch_m)]
            return Site.of(landmarks[np.sort(rows)], *gates)

        sizes = pairs.correspondences.size_tolerance or 0.0
        pairs.cache[key] = cls(thinned(pairs.map_a), thinned(pairs.map_b), sizes)
        return pairs.cache[key]

    @cached_property
    def _displaced(self) -> tuple[np.ndarray, Float]:
        """Rows of displaced landmarks of b (S,), and their places in frame b (S, 2)."""
        p = self._b.p
        k = min(_NEIGHBOURS + 1, len(p))
        neighbour = scipy.spatial.KDTree(p).query(p, k=k)[1].reshape(len(p), k)[:, 1:]
        difference = p[neighbour] - p[:, None]
        places = p[:, None, None] + _SHARES[:, None] * difference[:, :, None]
        rows = np.repeat(np.arange(len(p)), (k - 1) * len(_SHARES))
        step = -(-len(rows) // _MOST_PLACES)
        return rows[::step], places.reshape(-1, 2)[::step]

    def chance_of_agreeing(self, T_a_b: Float, up_m: float, gate_m: float) -> float:
        """Return p(T) within a gate.

        As in a permutation test, one is added to both counts, so that p is not 0.
        """
        rows, places = self._displaced
        agree = self._search.agreeing(rows, transform_points(T_a_b, places), gate_m, up_m)
        return (np.count_nonzero(agree) + 1) / (len(rows) + 1)

    @cached_property
    def _consistent(self) -> tuple[Float, float]:
        """Least gates of sampled quadruples, ascending; and log10 of quadruples per sample."""
        a, b, n_a, n_b = self._a, self._b, len(self._a.p), len(self._b.p)
        rng = np.random.default_rng(_SEED)
        i, j = rng.integers(n_a, size=_SAMPLES), rng.integers(n_b, size=_SAMPLES)
        k = (i + rng.integers(1, n_a, size=_SAMPLES)) % n_a
        l = (j + rng.integers(1, n_b, size=_SAMPLES)) % n_b  # noqa: E741
        height_difference = (a.z[i] - b.z[j]) - (a.z[k] - b.z[l])
        reach_m = np.sqrt(a.most_z_m2[i] + b.most_z_m2[j])
        agree = np.abs(height_difference) <= reach_m + np.sqrt(a.most_z_m2[k] + b.most_z_m2[l])
        agree &= attributes_of_pairs_agree(a, b, i, j, self._size_tolerance)
        agree &= attributes_of_pairs_agree(a, b, k, l, self._size_tolerance)
        i, j, k, l = i[agree], j[agree], k[agree], l[agree]  # noqa: E741
        longer = np.hypot(*(a.p[i] - a.p[k]).T) - np.hypot(*(b.p[j] - b.p[l]).T)
        total = math.log10(n_a * (n_a - 1) / 2) + math.log10(n_b * (n_b - 1))
        return np.sort(np.abs(longer) / 2), total - math.log10(_SAMPLES + 1)

    def log10_motions(self, gate_m: float) -> float:
        """Return log10 of M, the number of motions of two pairs that agree within a gate.

        M is estimated from a sample of all quadruples of landmarks. One is added to the count.
        """
        gates_m, each = self._consistent
        return math.log10(np.searchsorted(gates_m, gate_m, side="right") + 1) + each

    def fewest_false_alarms(self, T_a_b: Float, gates_m: Float) -> tuple[float, float, int, int]:
        """Return the smallest NFA over the gates (G,).

        Returns:
            log10 of the NFA, the gate, the number of landmarks of map b and that of supporters;
            infinite with the widest gate if there are too few supporters.
        """
        a, b, n = self._a, self._b, len(self._b.p)
        best = math.inf, float(gates_m[-1]), n, 0
        if min(len(a.p), n) < MIN_PAIRS:
            return best
        # one test for each height offset that a pair may give
        offsets = n if np.isfinite(a.most_z_m2).all() else 1
        tests = math.log10(len(gates_m) * offsets)
        for gate_m in map(float, gates_m):
            i, j, up_m, _ = self._search.pairs_within(T_a_b, np.arange(n), gate_m)
            if len(i) < MIN_PAIRS:
                continue
            p_a, p_b = np.ascontiguousarray(a.p[i]), np.ascontiguousarray(b.p[j])
            order = np.argsort(residuals_m(T_a_b, p_a, p_b), kind="stable")
            T_two = minimal_motion(p_a, p_b, order, T_a_b)
            k = int(np.count_nonzero(residuals_m(T_two, p_a, p_b) <= gate_m))
            if k < MIN_PAIRS:
                continue
            p = self.chance_of_agreeing(T_two, up_m, gate_m)
            log10 = tests + self.log10_motions(gate_m) + log10_tail(k - 2, n - 2, p)
            if log10 < best[0]:
                best = log10, gate_m, n, k
        return best
