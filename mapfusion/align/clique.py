"""Aligner by a maximum clique of pairwise consistent correspondences.

First the cliques that a greedy walk finds; then branch and bound in the order of degrees, pruned
by cores and by greedy colouring (Tomita and Seki 2003; San Segundo et al. 2011, BBMC; the order of
steps is that of Rossi et al. 2015, PMC).
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.alignment import Pairs
from mapfusion.align.consensus import Consensus, consistency_graphs, packed_rows
from mapfusion.align.mahalanobis_gate import (
    PairSpread,
    PlanarPairs,
    refit_at_best_drift,
    refit_to_support,
)
from mapfusion.align.method import Fit, Undetermined
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry.numerics import WORD, chi_square_bound, count_common, kernel, trailing_zeros
from mapfusion.parameters import Probability, Range


@kernel
def degrees(graph: np.ndarray) -> np.ndarray:
    """Number of neighbours (N,) of each vertex of a graph (N, W)."""
    degree = np.empty(len(graph), np.int64)
    for v in range(len(graph)):
        degree[v] = count_common(graph[v], graph[v])
    return degree


@kernel
def contains(bits: np.ndarray, v: int) -> bool:
    """Whether v is in a set (W,)."""
    return (bits[v // WORD] >> np.uint64(v % WORD)) & np.uint64(1) != 0


@kernel
def list_members(bits: np.ndarray, into: np.ndarray) -> int:
    """Write the numbers of a set (W,) into `into`, ascending; returns how many there are."""
    count = 0
    for w in range(len(bits)):
        word = bits[w]
        while word:
            into[count] = w * WORD + trailing_zeros(word)
            count += 1
            word &= word - np.uint64(1)
    return count


@kernel
def by_descending_degree(degree: np.ndarray) -> np.ndarray:
    """Vertices by descending degree (N,), those of one degree in their order (a counting sort).

    Those of a negative degree are left out.
    """
    start = np.zeros(len(degree) + 1, np.int64)
    for d in degree:
        if d >= 0:
            start[d] += 1
    for d in range(len(degree) - 1, -1, -1):
        start[d] += start[d + 1]
    order = np.empty(start[0], np.int64)
    for v in range(len(degree)):
        if degree[v] >= 0:
            order[start[degree[v] + 1]] = v
            start[degree[v] + 1] += 1
    return order


def bit_set(chosen: np.ndarray) -> np.ndarray:
    """The numbers that are marked (N,) as bits of words (W,)."""
    bits = np.zeros(-(-len(chosen) // WORD) * WORD, np.bool_)
    bits[: len(chosen)] = chosen
    return np.packbits(bits, bitorder="little").view("<u8")


def full_set(n: int) -> np.ndarray:
    """The set (W,) of all numbers below n."""
    return bit_set(np.ones(n, np.bool_))


@kernel
def reduce_to_core(graph: np.ndarray, chosen: np.ndarray, least: int, rows: np.ndarray) -> int:
    """Take away from `chosen` (W,) until all that remain have `least` neighbours among them.

    They are the core of that order (Seidman 1983): all cliques of more vertices than `least` are in
    it. Their numbers go into `rows`; returns how many, 0 where too few are left to have so many.
    """
    n, before = list_members(chosen, rows), -1
    while n != before:
        before = n
        for i in range(before):
            if n <= least:  # the others need no look
                return 0
            v = rows[i]
            if count_common(graph[v], chosen) < least:
                chosen[v // WORD] &= ~(np.uint64(1) << np.uint64(v % WORD))
                n -= 1
        list_members(chosen, rows)
    return n if n > least else 0


def may_contain_clique(graph: np.ndarray, among: np.ndarray, size: int) -> bool:
    """Whether some vertices (W,) have neighbours enough for a clique of more than `size`."""
    return reduce_to_core(graph, among.copy(), size, np.empty(len(graph), np.int64)) > 0


@kernel
def greedy_clique(graph: np.ndarray, starts: int) -> np.ndarray:
    """A large clique: from each of the vertices of most neighbours, add the next of most that fits.

    From `starts` vertices; of all walks (K,) the largest, the first on a tie.
    """
    n, words = graph.shape
    order = by_descending_degree(degrees(graph))
    best, clique = np.zeros(n, np.int64), np.zeros(n, np.int64)
    size_of_best = 0
    left = np.empty(words, np.uint64)
    for start in range(min(starts, n)):
        clique[0], size = order[start], 1
        some = np.uint64(0)
        for w in range(words):
            left[w] = graph[order[start], w]
            some |= left[w]
        for v in order:
            if not some:
                break
            if contains(left, v):
                clique[size] = v
                size += 1
                some = np.uint64(0)
                for w in range(words):
                    left[w] &= graph[v, w]
                    some |= left[w]
        if size > size_of_best:
            for k in range(size):
                best[k] = clique[k]
            size_of_best = size
    return best[:size_of_best].copy()


@kernel
def greedy_colouring(
    graph: np.ndarray,
    candidates: np.ndarray,
    at_least: int,
    vertex: np.ndarray,
    number: np.ndarray,
    uncoloured: np.ndarray,
    same: np.ndarray,
) -> int:
    """Colour candidates so that neighbours differ; a clique holds at most one of each colour.

    Candidates (W,) are a set of the graph's (n, W) vertices. Those of a colour number `at_least` or
    less cannot lead on; the others are listed in `vertex`, by ascending colour, with their colours,
    counted from 1, in `number`. `uncoloured` and `same` (W,) are work space. Returns how many.
    """
    words = len(candidates)
    for w in range(words):  # a slice would take long to compile, with the wording of its error
        uncoloured[w] = candidates[w]
    count, k = 0, 0
    while True:
        k += 1
        some = False
        for w in range(words):
            same[w] = uncoloured[w]
            some = some or uncoloured[w] != 0
        if not some:
            return count
        for w in range(words):
            while same[w]:
                v = w * WORD + trailing_zeros(same[w])
                bit = np.uint64(1) << np.uint64(v % WORD)
                same[w] &= ~bit
                uncoloured[w] &= ~bit
                for x in range(w, words):
                    same[x] &= ~graph[v, x]
                if k > at_least:
                    vertex[count], number[count] = v, k
                    count += 1


@kernel
def _branch_and_bound(graph: np.ndarray, at_least: int, budget: int) -> tuple[np.ndarray, int]:
    """Maximum clique (K,) of a small graph (n, W) if larger than `at_least`, else empty.

    Also returns what is left of the budget, in nodes of the search; at 0 it ended early.
    """
    n, words = graph.shape
    best = np.zeros(0, np.int64)
    depth_max = n + 1
    candidates = np.zeros((depth_max, words), np.uint64)
    vertex, number = np.empty((depth_max, n), np.int64), np.empty((depth_max, n), np.int64)
    listed, clique = np.zeros(depth_max, np.int64), np.empty(depth_max, np.int64)
    uncoloured, same = np.empty(words, np.uint64), np.empty(words, np.uint64)
    for v in range(n):
        candidates[0, v // WORD] |= np.uint64(1) << np.uint64(v % WORD)
    depth = 0
    listed[0] = greedy_colouring(
        graph, candidates[0], at_least, vertex[0], number[0], uncoloured, same
    )
    while depth >= 0 and budget > 0:
        if listed[depth] == 0 or depth + number[depth, listed[depth] - 1] <= at_least:
            depth -= 1
            continue
        budget -= 1
        listed[depth] -= 1
        v = vertex[depth, listed[depth]]
        clique[depth] = v
        some = False
        for w in range(words):
            candidates[depth + 1, w] = candidates[depth, w] & graph[v, w]
            some = some or candidates[depth + 1, w] != 0
        candidates[depth, v // WORD] &= ~(np.uint64(1) << np.uint64(v % WORD))
        if some:
            depth += 1
            listed[depth] = greedy_colouring(
                graph,
                candidates[depth],
                at_least - depth,
                vertex[depth],
                number[depth],
                uncoloured,
                same,
            )
        elif depth + 1 > at_least:
            at_least = depth + 1
            best = clique[:at_least].copy()
    return best, budget


@kernel
def _subgraph(graph: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The graph (n, ceil(n / 64)) of some vertices (n,), numbered 0 to n - 1."""
    n = len(rows)
    small = np.zeros((n, (n + WORD - 1) // WORD), np.uint64)
    for i in range(n):
        for j in range(n):
            if contains(graph[rows[i]], rows[j]):
                small[i, j // WORD] |= np.uint64(1) << np.uint64(j % WORD)
    return small


@kernel
def larger_clique(
    graph: np.ndarray, among: np.ndarray, at_least: int, budget: int
) -> tuple[np.ndarray, bool]:
    """A maximum clique among some vertices, if there is one of more than `at_least`.

    Of those that have enough neighbours, from the one of most on; each with its neighbours that
    came before, which are half of them where degrees are alike, so that every clique is looked for
    where the last of its vertices is.

    The graph (N, W) is symmetric, bit j of row i for an edge, no diagonal; `among` (W,) is the set
    of vertices. After `budget` nodes of the search the largest found so far is returned. Returns
    (K,) vertices, none when no clique is larger; and whether the search came to its end.
    """
    n, words = graph.shape
    best, rows = np.zeros(0, np.int64), np.empty(n, np.int64)
    chosen, before = among.copy(), np.zeros(words, np.uint64)
    degree = np.full(n, -1)
    for v in rows[: reduce_to_core(graph, chosen, at_least, rows)]:
        degree[v] = count_common(graph[v], chosen)
    for v in by_descending_degree(degree):
        if degree[v] < at_least:  # a larger clique was found since
            break
        if count_common(before, graph[v]) >= at_least:
            for w in range(words):
                chosen[w] = before[w] & graph[v, w]
            count = reduce_to_core(graph, chosen, at_least - 1, rows)
            if count:
                small = _subgraph(graph, rows[:count])
                found, budget = _branch_and_bound(small, at_least - 1, budget)
                if len(found):
                    at_least = len(found) + 1
                    best = np.empty(at_least, np.int64)
                    best[0] = v
                    for k in range(len(found)):
                        best[k + 1] = rows[found[k]]
                if budget <= 0:
                    return best, False
        before[v // WORD] |= np.uint64(1) << np.uint64(v % WORD)
    return best, True


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
        self._rows, self._spread = packed_rows(pairs), PairSpread.of(pairs)
        self._scales_m2 = float(self._variances_m2[0]), float(self._variances_m2[-1])
        self._agreement = chi_square_bound(clique.agreement_probability, 1)
        self._max_nodes = clique.max_nodes
        self._log = -np.inf
        self.T_a_b = np.full(3, np.nan)
        self.inside = self.near = np.zeros(len(pairs.p_a), np.bool_)
        self.level = -1

    def graphs(self, rows: np.ndarray) -> np.ndarray:
        """Which of some pairs (n,) agree (2, n, W): without s_drift, and with it."""
        return consistency_graphs(self._rows[rows], self._scales_m2, self._agreement)

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
        log, level = refit_at_best_drift(T_a_b, pairs, self._spread, scales, bound, inside)
        if log > self._log:
            self.T_a_b, self.inside, self.level, self._log = T_a_b, inside, level, log
            self.near = self.support(1)

    def support(self, scale: int) -> np.ndarray:
        """Which pairs (N,) support the likeliest motion, settled at a scale; none before."""
        inside = np.zeros(len(self._pairs.p_a), np.bool_)
        if self.level >= 0:
            given = self._pairs, self._spread.own_m2, self._scales_m2[scale], self._bound
            refit_to_support(self.T_a_b.copy(), *given, inside)
        return inside

    def is_plain(self) -> bool:
        """Whether so many pairs support the motion that no clique of others comes near."""
        support, others = int(np.count_nonzero(self.near)), np.flatnonzero(~self.near)
        if support <= _WORTH_A_LOOK * len(self.near):
            return False
        return not may_contain_clique(self.graphs(others)[1], full_set(len(others)), support // 2)

    def none_in_parts(self, parts: list[np.ndarray]) -> bool:
        """Whether no clique of the pairs that do not support the motion has half as many.

        If it had, one of P parts would hold at least 1 / P of it.
        """
        graphs = [self.offer_greedy(rows) for rows in parts]
        size = int(np.count_nonzero(self.near)) // (2 * len(parts))
        for rows, graph in zip(parts, graphs, strict=True):
            others = bit_set(~self.near[rows])
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
            if may_contain_clique(
                graph, bit_set(~self.near), int(np.count_nonzero(self.near)) // 2
            ):
                at_least = max(int(np.count_nonzero(self.support(scale))), len(greedy))
                self.offer(larger_clique(graph, full_set(len(rows)), at_least, self._max_nodes)[0])
