"""Maximum clique of pairwise consistent correspondences."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.consensus import Consensus
from mapfusion.align.consistency import consistency
from mapfusion.align.mahalanobis_gate import PlanarPairs, settle, settle_at_best_scale
from mapfusion.align.max_clique import greedy_clique, larger_clique, largest_possible
from mapfusion.align.method import Fit, Undetermined
from mapfusion.align.pairs import Pairs
from mapfusion.align.rigid import fit_rigid
from mapfusion.arguments import Probability, Range
from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float

_GREEDY_STARTS = 100  # a walk costs microseconds, and a large clique spares the search most
_SAMPLE = 128  # pairs; a graph of all their edges takes a quarter of a millisecond
_WORTH_A_LOOK = 0.3  # share in support from which the others' graph costs half of all pairs'


@dataclass(frozen=True)
class Clique(Consensus):
    """The largest set of correspondences of which any two agree.

    Two agree when their landmarks lie equally far apart in both maps, as far as covariances and
    s_drift can tell (PCM: Mangelson et al. 2018; TEASER++: Yang et al. 2021; CLIPPER: Lusk et al.
    2021). True pairs all agree; false ones rarely do by threes. Both with s_drift and without, a
    greedy clique is fitted and its support counted, then cliques larger than that are looked for.

    Where most pairs are true, their graph has nearly all edges, and that is what takes the time. So
    a clique of evenly chosen pairs comes first. If the pairs that do not support it hold no clique
    of half as many as do, every larger clique shares more than half its pairs with the support:
    it is the same motion, and need not be looked for.

    Attributes:
        agreement_probability: of two true pairs to agree (chi-square, 1 degree of freedom). Closer
            to 1 than `probability`, since a clique needs all its pairs to agree.
        max_nodes: of branch and bound at each s_drift; beyond them the largest clique found counts.
            Where most pairs are true the last vertices of a clique take many and change nothing.
    """

    randomised: ClassVar[bool] = False
    agreement_probability: Probability = 0.999
    max_nodes: Annotated[int, Range(1, 10_000_000, "nodes")] = 1000

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """T_a_b under which the residuals are likeliest; nothing is drawn from `rng`."""
        del rng
        planar = pairs.in_plan()
        return self.settled(self._likeliest(planar), pairs, planar)

    def _likeliest(self, pairs: PlanarPairs) -> Float:
        """T_a_b (3,) of the likeliest clique, NaN when no two correspondences agree."""
        agreement = chi_square_bound(self.agreement_probability, 1)
        scales = self.variances_m2[[0, -1]]
        n = len(pairs.p_a)
        sample = np.arange(0, n, max(-(-n // _SAMPLE), 1))
        sampled = consistency(_among(pairs, sample), scales, agreement)
        graphs = sampled if len(sample) == n else None
        best = _Likeliest(pairs, self.variances_m2, self.bound)
        for i, variance in enumerate(scales):
            best.offer(sample[greedy_clique(sampled[i], _GREEDY_STARTS)])
            others = best.others(variance)
            support = n - len(others)
            if support > _WORTH_A_LOOK * n:
                graph = consistency(_among(pairs, others), scales[i : i + 1], agreement)[0]
                if largest_possible(graph) <= support / 2:
                    continue
            graphs = consistency(pairs, scales, agreement) if graphs is None else graphs
            greedy = greedy_clique(graphs[i], _GREEDY_STARTS)
            best.offer(greedy)
            others = best.others(variance)
            support = max(n - len(others), len(greedy))
            if largest_possible(_only(graphs[i], others)) > support / 2:
                best.offer(larger_clique(graphs[i], support, self.max_nodes)[0])
        return best.T_a_b


class _Likeliest:
    """The likeliest of the motions that cliques have.

    Attributes:
        T_a_b: (3,), NaN before there is one.
    """

    def __init__(self, pairs: PlanarPairs, variances_m2: Float, bound: float) -> None:
        self._pairs, self._variances_m2, self._bound = pairs, variances_m2, bound
        self._log = -np.inf
        self.T_a_b = np.full(3, np.nan)

    def offer(self, clique: np.ndarray) -> None:
        """Take the motion of a clique (K,) if it is the likeliest so far; a pair alone has none."""
        if len(clique) < 2:
            return
        T_a_b = np.array(fit_rigid(self._pairs.p_a, self._pairs.p_b, clique))
        inside = np.empty(len(self._pairs.p_a), np.bool_)
        log, _ = settle_at_best_scale(T_a_b, self._pairs, self._variances_m2, self._bound, inside)
        if log > self._log:
            self.T_a_b, self._log = T_a_b, log

    def others(self, variance_m2: float) -> np.ndarray:
        """The pairs (M,) that do not support the motion at a scale."""
        inside = np.zeros(len(self._pairs.p_a), np.bool_)
        if np.isfinite(self._log):
            settle(self.T_a_b.copy(), self._pairs, variance_m2, self._bound, inside)
        return np.flatnonzero(~inside)


def _only(graph: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The graph (N, W) without all edges but those between some vertices (M,)."""
    kept = np.zeros(64 * graph.shape[1], np.uint8)
    kept[rows] = 1
    words = np.packbits(kept, bitorder="little").view("<u8")
    cut = np.zeros_like(graph)
    cut[rows] = graph[rows] & words
    return cut


def _among(pairs: PlanarPairs, rows: np.ndarray) -> PlanarPairs:
    return PlanarPairs(*(np.ascontiguousarray(part[rows]) for part in pairs))
