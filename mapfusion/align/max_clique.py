"""The largest set of vertices of a graph that are all joined to one another, on bitsets.

First the cliques that a greedy walk finds; then branch and bound in the order of degrees, pruned
by cores and by greedy colouring (Tomita and Seki 2003; San Segundo et al. 2011, BBMC; the order of
steps is that of Rossi et al. 2015, PMC).
"""

import numpy as np

from mapfusion.align.bits import WORD, count_common, trailing_zeros
from mapfusion.kernels import inner_kernel, kernel, kernel_part


@kernel_part
def degrees(graph: np.ndarray) -> np.ndarray:
    """Number of neighbours (N,) of each vertex of a graph (N, W)."""
    degree = np.empty(len(graph), np.int64)
    for v in range(len(graph)):
        degree[v] = count_common(graph[v], graph[v])
    return degree


@inner_kernel
def has(bits: np.ndarray, v: int) -> bool:
    """Whether v is in a set (W,)."""
    return (bits[v // WORD] >> np.uint64(v % WORD)) & np.uint64(1) != 0


@inner_kernel
def members(bits: np.ndarray, into: np.ndarray) -> int:
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
def most_first(degree: np.ndarray) -> np.ndarray:
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


def set_of(chosen: np.ndarray) -> np.ndarray:
    """The numbers that are marked (N,) as bits of words (W,)."""
    bits = np.zeros(-(-len(chosen) // WORD) * WORD, np.bool_)
    bits[: len(chosen)] = chosen
    return np.packbits(bits, bitorder="little").view("<u8")


def everyone(n: int) -> np.ndarray:
    """The set (W,) of all numbers below n."""
    return set_of(np.ones(n, np.bool_))


@kernel
def keep_core(graph: np.ndarray, chosen: np.ndarray, least: int, rows: np.ndarray) -> int:
    """Take away from `chosen` (W,) until all that remain have `least` neighbours among them.

    They are the core of that order (Seidman 1983): all cliques of more vertices than `least` are in
    it. Their numbers go into `rows`; returns how many, 0 where too few are left to have so many.
    """
    n, before = members(chosen, rows), -1
    while n != before:
        before = n
        for i in range(before):
            if n <= least:  # the others need no look
                return 0
            v = rows[i]
            if count_common(graph[v], chosen) < least:
                chosen[v // WORD] &= ~(np.uint64(1) << np.uint64(v % WORD))
                n -= 1
        members(chosen, rows)
    return n if n > least else 0


def may_hold(graph: np.ndarray, among: np.ndarray, size: int) -> bool:
    """Whether some vertices (W,) have neighbours enough for a clique of more than `size`."""
    return keep_core(graph, among.copy(), size, np.empty(len(graph), np.int64)) > 0


@kernel
def greedy_clique(graph: np.ndarray, starts: int) -> np.ndarray:
    """A large clique: from each of the vertices of most neighbours, add the next of most that fits.

    From `starts` vertices; of all walks (K,) the largest, the first on a tie.
    """
    n, words = graph.shape
    order = most_first(degrees(graph))
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
            if has(left, v):
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


@inner_kernel
def colour(
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


@kernel_part
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
    listed[0] = colour(graph, candidates[0], at_least, vertex[0], number[0], uncoloured, same)
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
            listed[depth] = colour(
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


@kernel_part
def _subgraph(graph: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The graph (n, ceil(n / 64)) of some vertices (n,), numbered 0 to n - 1."""
    n = len(rows)
    small = np.zeros((n, (n + WORD - 1) // WORD), np.uint64)
    for i in range(n):
        for j in range(n):
            if has(graph[rows[i]], rows[j]):
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
    for v in rows[: keep_core(graph, chosen, at_least, rows)]:
        degree[v] = count_common(graph[v], chosen)
    for v in most_first(degree):
        if degree[v] < at_least:  # a larger clique was found since
            break
        if count_common(before, graph[v]) >= at_least:
            for w in range(words):
                chosen[w] = before[w] & graph[v, w]
            count = keep_core(graph, chosen, at_least - 1, rows)
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
