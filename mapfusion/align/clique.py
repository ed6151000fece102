"""Maximum clique of pairwise consistent correspondences."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.consensus import Consensus
from mapfusion.align.consistency import consistency, in_rows
from mapfusion.align.mahalanobis_gate import (
    PlanarPairs,
    Spread,
    settle,
    settle_at_best_scale,
)
from mapfusion.align.max_clique import (
    everyone,
    greedy_clique,
    larger_clique,
    may_hold,
    set_of,
)
from mapfusion.align.method import Fit, Undetermined
from mapfusion.align.pairs import Pairs
from mapfusion.align.rigid import fit_rigid
from mapfusion.arguments import Probability, Range
from mapfusion.chi_square import chi_square_bound

_GREEDY_STARTS = 100  # a walk costs microseconds, and a large clique spares the search most
_SAMPLE = 128  # pairs; a graph of all their edges takes a tenth of a millisecond
# Share in support from which the graph of the others costs half of all pairs' or less. A clique of
# a sample that comes from so much support holds half that share of the sample at least.
_WORTH_A_LOOK = 0.3
# Pairs whose graph is searched at once: it fits the processor's cache, and the time grows with the
# square. In smaller parts those that agree by chance would be too many beside a part's true ones.
_PART = 2500


@dataclass(frozen=True)
class Clique(Consensus):
    """The largest set of correspondences of which any two agree.

    Two agree when their landmarks lie equally far apart in both maps, as far as covariances and
    s_drift can tell (PCM: Mangelson et al. 2018; TEASER++: Yang et al. 2021; CLIPPER: Lusk et al.
    2021). True pairs all agree; false ones rarely do by threes. Both with s_drift and without, a
    greedy clique is fitted and its support counted, then cliques larger than that are looked for.

    A larger clique need not be looked for where it can only be the same motion again: if the pairs
    that do not support the motion found hold no clique of half as many as do, every larger clique
    shares more than half its pairs with the support. That is shown by as few edges as possible.
    Where most pairs are true, a clique of evenly chosen pairs gives the motion, and the others'
    graph is small. Of many pairs, parts are searched, of which one would hold its share.

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
        best = self._likeliest(planar)
        return self.fit_of(best.T_a_b, best.inside, best.level, pairs, planar)

    def _likeliest(self, pairs: PlanarPairs) -> "CliqueSearch":
        search, rows = CliqueSearch(self, pairs), np.arange(len(pairs.p_a))
        if len(rows) > _SAMPLE:
            sample = rows[:: -(-len(rows) // _SAMPLE)]
            search.offer_greedy(sample, round(_WORTH_A_LOOK / 2 * len(sample)))
            if search.is_plain():
                return search
        if len(rows) > _PART:
            parts = -(-len(rows) // _PART)
            if search.none_in_parts([rows[k::parts] for k in range(parts)]):
                return search
        search.exhaust(rows)
        return search


class CliqueSearch:
    """The likeliest of the motions that cliques have.

    Attributes:
        T_a_b: (3,), settled on its support; NaN before there is one.
        inside: (N,) bool, its support.
        near: (N,) bool, its support at the largest s_drift.
        level: of s_drift at which it is likeliest, -1 before there is one.
    """

    def __init__(self, clique: Clique, pairs: PlanarPairs) -> None:
        self._pairs, self._bound, self._variances_m2 = pairs, clique.bound, clique.variances_m2
        self._rows, self._spread = in_rows(pairs), Spread.of(pairs)
        self._scales_m2 = float(self._variances_m2[0]), float(self._variances_m2[-1])
        self._agreement = chi_square_bound(clique.agreement_probability, 1)
        self._max_nodes = clique.max_nodes
        self._log = -np.inf
        self.T_a_b = np.full(3, np.nan)
        self.inside = self.near = np.zeros(len(pairs.p_a), np.bool_)
        self.level = -1

    def graphs(self, rows: np.ndarray) -> np.ndarray:
        """Which of some pairs (n,) agree (2, n, W): without s_drift, and with it."""
        return consistency(self._rows[rows], self._scales_m2, self._agreement)

    def offer_greedy(self, rows: np.ndarray, least: int = 2) -> np.ndarray:
        """Offer a greedy clique of some pairs (n,) at either scale, of no fewer than `least`.

        Returns their graphs.
        """
        graphs = self.graphs(rows)
        for graph in graphs:
            greedy = rows[greedy_clique(graph, _GREEDY_STARTS)]
            if len(greedy) >= least:
                self.offer(greedy)
        return graphs

    def offer(self, clique: np.ndarray) -> None:
        """Take the motion of a clique (K,) if it is the likeliest so far.

        It is the same motion where all support that one, and none where the clique is of one pair.
        """
        if len(clique) < 2 or self.near[clique].all():
            return
        pairs, scales, bound = self._pairs, self._variances_m2, self._bound
        T_a_b, inside = np.array(fit_rigid(pairs.p_a, pairs.p_b, clique)), np.empty_like(self.near)
        log, level = settle_at_best_scale(T_a_b, pairs, self._spread, scales, bound, inside)
        if log > self._log:
            self.T_a_b, self.inside, self.level, self._log = T_a_b, inside, level, log
            self.near = self.support(1)

    def support(self, scale: int) -> np.ndarray:
        """Which pairs (N,) support the likeliest motion, settled at a scale; none before."""
        inside = np.zeros(len(self._pairs.p_a), np.bool_)
        if self.level >= 0:
            given = self._pairs, self._spread.own_m2, self._scales_m2[scale], self._bound
            settle(self.T_a_b.copy(), *given, inside)
        return inside

    def is_plain(self) -> bool:
        """Whether so many pairs support the motion that no clique of others comes near."""
        support, others = int(np.count_nonzero(self.near)), np.flatnonzero(~self.near)
        if support <= _WORTH_A_LOOK * len(self.near):
            return False
        return not may_hold(self.graphs(others)[1], everyone(len(others)), support // 2)

    def none_in_parts(self, parts: list[np.ndarray]) -> bool:
        """Whether no clique of the pairs that do not support the motion has half as many.

        If it had, one of P parts would hold at least 1 / P of it.
        """
        graphs = [self.offer_greedy(rows) for rows in parts]
        size = int(np.count_nonzero(self.near)) // (2 * len(parts))
        for rows, graph in zip(parts, graphs, strict=True):
            others = set_of(~self.near[rows])
            clique, finished = larger_clique(graph[1], others, size, self._max_nodes)
            if len(clique) or not finished:
                return False
        return True

    def exhaust(self, rows: np.ndarray) -> None:
        """Offer the largest clique of all pairs (N,) at either scale if its motion may be new.

        One without s_drift is one with it, so that the support with it counts at both.
        """
        for scale, graph in enumerate(self.graphs(rows)):
            greedy = greedy_clique(graph, _GREEDY_STARTS)
            self.offer(greedy)
            if may_hold(graph, set_of(~self.near), int(np.count_nonzero(self.near)) // 2):
                at_least = max(int(np.count_nonzero(self.support(scale))), len(greedy))
                self.offer(larger_clique(graph, everyone(len(rows)), at_least, self._max_nodes)[0])
