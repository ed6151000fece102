"""Aligner by a maximum clique of pairwise consistent correspondences.

A greedy search finds large cliques. Branch and bound in the order of degrees, pruned by k-cores and
by greedy colouring, then finds larger ones (Tomita and Seki 2003; San Segundo et al. 2011, BBMC;
order of steps as in Rossi et al. 2015, PMC). A graph of N vertices is an array of bits, uint64,
shape (N, W): bit j of row i is an edge. A set of vertices is an array of bits, shape (W,).
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.alignment import Fit, Pairs, Undetermined
from mapfusion.align.consensus import Consensus, consistency_graphs, packed_rows
from mapfusion.align.mahalanobis_gate import (
    PairSpread,
    PlanarPairs,
    refit_at_best_drift,
    refit_to_support,
)
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry.numerics import WORD, chi_square_bound, count_common, kernel, trailing_zeros
from mapfusion.parameters import Probability, Range


@kernel
def degrees(graph: np.ndarray) -> np.ndarray:
    """Return the number of neighbours of each vertex of a graph (N, W), shape (N,)."""
    degree = np.empty(len(graph), np.int64)
    for v in range(len(graph)):
        degree[v] = count_common(graph[v], graph[v])
    return degree


@kernel
def contains(bits: np.ndarray, v: int) -> bool:
    """Return True if v is in a set (W,)."""
    return (bits[v // WORD] >> np.uint64(v % WORD)) & np.uint64(1) != 0


@kernel
def list_members(bits: np.ndarray, into: np.ndarray) -> int:
    """Write the members of a set (W,) into `into`, ascending; return their number."""
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
    """Return the vertices by descending degree (N,), by a stable counting sort.

    Vertices of negative degree are left out.
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
    """Return the set (W,) of the marked numbers (N,)."""
    bits = np.zeros(-(-len(chosen) // WORD) * WORD, np.bool_)
    bits[: len(chosen)] = chosen
    return np.packbits(bits, bitorder="little").view("<u8")


def full_set(n: int) -> np.ndarray:
    """Return the set (W,) of all numbers below n."""
    return bit_set(np.ones(n, np.bool_))


@kernel
def reduce_to_core(graph: np.ndarray, chosen: np.ndarray, min_size: int, rows: np.ndarray) -> int:
    """Reduce `chosen` (W,) to its k-core with k = `min_size` (Seidman 1983).

    Each vertex of the k-core has at least k neighbours in it; all cliques of more than k vertices
    lie in it. The members are written to `rows`. Returns their number, 0 for an empty core.
    """
    n, n_before = list_members(chosen, rows), -1
    while n != n_before:
        n_before = n
        for i in range(n_before):
            if n <= min_size:  # too few vertices are left
                return 0
            v = rows[i]
            if count_common(graph[v], chosen) < min_size:
                chosen[v // WORD] &= ~(np.uint64(1) << np.uint64(v % WORD))
                n -= 1
        list_members(chosen, rows)
    return n if n > min_size else 0


def may_contain_clique(graph: np.ndarray, among: np.ndarray, size: int) -> bool:
    """Return False if the k-core of a set (W,) excludes a clique of more than `size` vertices."""
    return reduce_to_core(graph, among.copy(), size, np.empty(len(graph), np.int64)) > 0


@kernel
def greedy_clique(graph: np.ndarray, starts: int) -> np.ndarray:
    """Return a large clique (K,) by greedy search.

    From each of the `starts` vertices of highest degree, vertices are added by descending degree.
    The largest clique is returned, the first on a tie.
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
    """Colour candidates so that neighbours differ; a clique contains at most one of each colour.

    Candidates with a colour of at most `at_least` cannot extend a clique beyond it.

    Args:
        graph: graph, shape (n, W).
        candidates: set of vertices, shape (W,).
        at_least: number of colours that are left out.
        vertex: output, the other candidates by ascending colour.
        number: output, their colours, counted from 1.
        uncoloured: work space, shape (W,).
        same: work space, shape (W,).

    Returns:
        Number of candidates in the output.
    """
    words = len(candidates)
    for w in range(words):  # compiles faster than an assignment of slices
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
    """Return a maximum clique (K,) of a small graph (n, W) if larger than `at_least`, else empty.

    Also return the remaining budget of search nodes; at 0 the search ended early.
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
def larger_clique(
    graph: np.ndarray, among: np.ndarray, at_least: int, budget: int
) -> tuple[np.ndarray, bool]:
    """Find a maximum clique among some vertices if it has more than `at_least` vertices.

    Vertices of sufficient degree are visited by descending degree. Each vertex is searched together
    with its earlier neighbours, so that a clique is found at its last vertex.

    Args:
        graph: symmetric graph without diagonal, shape (N, W).
        among: set of vertices, shape (W,).
        at_least: size that the clique must exceed.
        budget: largest number of search nodes.

    Returns:
        Vertices (K,), none if no clique is larger, and True if the search was complete. If it was
        not, the clique is the largest one found.
    """
    n, words = graph.shape
    best, rows = np.zeros(0, np.int64), np.empty(n, np.int64)
    chosen, previous = among.copy(), np.zeros(words, np.uint64)
    degree = np.full(n, -1)
    for v in rows[: reduce_to_core(graph, chosen, at_least, rows)]:
        degree[v] = count_common(graph[v], chosen)
    for v in by_descending_degree(degree):
        if degree[v] < at_least:  # a larger clique was found meanwhile
            break
        if count_common(previous, graph[v]) >= at_least:
            for w in range(words):
                chosen[w] = previous[w] & graph[v, w]
            count = reduce_to_core(graph, chosen, at_least - 1, rows)
            if count:
                # subgraph of the vertices rows[:count], numbered from 0
                subgraph = np.zeros((count, (count + WORD - 1) // WORD), np.uint64)
                for i in range(count):
                    for j in range(count):
                        if contains(graph[rows[i]], rows[j]):
                            subgraph[i, j // WORD] |= np.uint64(1) << np.uint64(j % WORD)
                clique, budget = _branch_and_bound(subgraph, at_least - 1, budget)
                if len(clique):
                    at_least = len(clique) + 1
                    best = np.empty(at_least, np.int64)
                    best[0] = v
                    for k in range(len(clique)):
                        best[k + 1] = rows[clique[k]]
                if budget <= 0:
                    return best, False
        previous[v // WORD] |= np.uint64(1) << np.uint64(v % WORD)
    return best, True


_GREEDY_STARTS = 100  # start vertices; a large greedy clique prunes most of the search
_SAMPLE = 128  # pairs of the first, cheap search
# Share of supporters at which the graph of the other pairs takes half the time of the whole graph.
# A clique of the sample must contain at least half of this share.
_WORTH_A_LOOK = 0.3
# Largest number of pairs of one graph, which fits the processor's cache; the time grows with the
# square. In smaller parts chance agreement would exceed the true pairs.
_PART = 2500
_MOST_TWOS = 200  # motions of two pairs that are tried if the largest clique has none


@dataclass(frozen=True)
class Clique(Consensus):
    """Largest set of pairwise consistent correspondences.

    Two correspondences are consistent if the distance between their landmarks is equal in both maps
    within the covariances and s_drift (PCM: Mangelson et al. 2018; TEASER++: Yang et al. 2021;
    CLIPPER: Lusk et al. 2021). True pairs are all consistent; three false ones rarely are. With and
    without s_drift, the motion of a greedy clique is refitted to its support, and larger cliques
    are then searched.

    The search for a larger clique is omitted if it can only give the same motion: if the pairs that
    do not support the motion contain no clique of half the number of supporters, every larger
    clique shares more than half of its pairs with the support. If most pairs are true, a clique of
    a sample gives the motion and the graph of the other pairs is small. Many pairs are searched in
    parts, one of which would contain its share of a clique.

    Attributes:
        agreement_probability: probability that two true pairs are consistent (chi-square, 1 degree
            of freedom); closer to 1 than `probability`, since all pairs of a clique must be.
        max_nodes: largest number of search nodes for each s_drift; the largest clique found until
            then is used. The last vertices of a clique take many nodes and hardly change a motion.
    """

    randomised: ClassVar[bool] = False
    agreement_probability: Probability = 0.999
    max_nodes: Annotated[int, Range(1, 10_000_000, "nodes")] = 1000

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Return the motion of largest likelihood among those of cliques; `rng` is not used."""
        del rng
        planar = pairs.in_plan()
        search, rows = CliqueSearch(self, planar), np.arange(len(pairs))
        done = False
        if len(rows) > _SAMPLE:
            sample = rows[:: -(-len(rows) // _SAMPLE)]
            search.offer_greedy(sample, round(_WORTH_A_LOOK / 2 * len(sample)))
            done = search.is_complete()
        if len(rows) > _PART and not done:
            parts = -(-len(rows) // _PART)
            done = search.none_in_parts([rows[k::parts] for k in range(parts)])
        if not done:
            search.exhaust(rows)
        if search.level < 0:
            search.offer_twos()
        return self.fit_of(search.T_a_b, search.inside, search.level, pairs, planar)


class CliqueSearch:
    """Search for the motion of largest likelihood among those of cliques.

    Attributes:
        T_a_b: best motion, refitted to its support, shape (3,); NaN initially.
        inside: support of the motion, bool, shape (N,).
        near: support at the largest s_drift, bool, shape (N,).
        level: index of the most likely s_drift, -1 initially.
        largest: largest clique that was offered, shape (K,).
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
        self.level, self.largest = -1, np.zeros(0, np.int64)

    def graphs(self, rows: np.ndarray) -> np.ndarray:
        """Return the consistency graphs (2, n, W) of some pairs (n,), without and with s_drift."""
        return consistency_graphs(self._rows[rows], self._scales_m2, self._agreement)

    def offer_greedy(self, rows: np.ndarray, min_size: int = 2) -> np.ndarray:
        """Offer the greedy cliques of some pairs (n,) with at least `min_size` pairs.

        Returns the consistency graphs.
        """
        graphs = self.graphs(rows)
        for graph in graphs:
            greedy = rows[greedy_clique(graph, _GREEDY_STARTS)]
            if len(greedy) >= min_size:
                self.offer(greedy)
        return graphs

    def offer(self, clique: np.ndarray) -> None:
        """Keep the motion of a clique (K,) if its likelihood is the largest so far.

        A clique of one pair, or of supporters of the current motion, is ignored.
        """
        if len(clique) > len(self.largest):
            self.largest = clique
        if len(clique) < 2 or self.near[clique].all():
            return
        pairs, scales, bound = self._pairs, self._variances_m2, self._bound
        T_a_b, inside = np.array(fit_rigid(pairs.p_a, pairs.p_b, clique)), np.empty_like(self.near)
        log, level = refit_at_best_drift(T_a_b, pairs, self._spread, scales, bound, inside)
        if log > self._log:
            self.T_a_b, self.inside, self.level, self._log = T_a_b, inside, level, log
            self.near = self.support(1)

    def support(self, scale: int) -> np.ndarray:
        """Return the support (N,) of the best motion, refitted with s_drift 0 or the largest."""
        inside = np.zeros(len(self._pairs.p_a), np.bool_)
        if self.level >= 0:
            arguments = self._pairs, self._spread.own_m2, self._scales_m2[scale], self._bound
            refit_to_support(self.T_a_b.copy(), *arguments, inside)
        return inside

    def offer_twos(self) -> None:
        """Offer motions of two pairs of the largest clique, pairs far apart first.

        A mirror image keeps all distances and may be the largest clique, but no motion fits it.
        Landmarks near its axis have a motion nevertheless.
        """
        i, j = np.triu_indices(len(self.largest), 1)
        p = self._pairs.p_b[self.largest]
        farthest = np.argsort(-np.linalg.norm(p[i] - p[j], axis=1), kind="stable")[:_MOST_TWOS]
        for two in np.column_stack([i, j])[farthest]:
            self.offer(self.largest[two])

    def is_complete(self) -> bool:
        """Return True if the other pairs contain no clique of half the number of supporters."""
        support, others = int(np.count_nonzero(self.near)), np.flatnonzero(~self.near)
        if support <= _WORTH_A_LOOK * len(self.near):
            return False
        return not may_contain_clique(self.graphs(others)[1], full_set(len(others)), support // 2)

    def none_in_parts(self, parts: list[np.ndarray]) -> bool:
        """Return True if the other pairs contain no clique of half the number of supporters.

        At least one of P parts would contain 1 / P of such a clique.
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
        """Offer the largest clique of all pairs (N,), without and with s_drift.

        The search is omitted if a clique can only give the current motion. A clique without s_drift
        is one with s_drift as well, so that the support with s_drift counts for both.
        """
        for scale, graph in enumerate(self.graphs(rows)):
            greedy = greedy_clique(graph, _GREEDY_STARTS)
            self.offer(greedy)
            if may_contain_clique(
                graph, bit_set(~self.near), int(np.count_nonzero(self.near)) // 2
            ):
                at_least = max(int(np.count_nonzero(self.support(scale))), len(greedy))
                self.offer(larger_clique(graph, full_set(len(rows)), at_least, self._max_nodes)[0])
