"""The largest set of vertices of a graph that are all joined to one another, on bitsets.

First the cliques that a greedy walk finds; then branch and bound in degeneracy order, pruned by
core numbers and by greedy colouring (Tomita and Seki 2003; San Segundo et al. 2011, BBMC; the order
of steps is that of Rossi et al. 2015, PMC).
"""

import numpy as np
from numba import njit

from mapfusion.align.bits import count_common, trailing_zeros

WORD = 64


@njit(cache=True)
def degrees(graph: np.ndarray) -> np.ndarray:
    """Number of neighbours (N,) of each vertex of a graph (N, W)."""
    degree = np.empty(len(graph), np.int64)
    for v in range(len(graph)):
        degree[v] = count_common(graph[v], graph[v])
    return degree


@njit(cache=True)
def has(bits: np.ndarray, v: int) -> bool:
    """Whether v is in a set (W,)."""
    return (bits[v // WORD] >> np.uint64(v % WORD)) & np.uint64(1) != 0


@njit(cache=True)
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


@njit(cache=True)
def by_degree(degree: np.ndarray) -> np.ndarray:
    """Vertices (N,) by ascending degree, those of one degree in their order (a counting sort)."""
    start = np.zeros(len(degree) + 1, np.int64)
    for v in range(len(degree)):
        start[degree[v] + 1] += 1
    for d in range(1, len(start)):
        start[d] += start[d - 1]
    order = np.empty(len(degree), np.int64)
    for v in range(len(degree)):
        order[start[degree[v]]] = v
        start[degree[v]] += 1
    return order


@njit(cache=True)
def degeneracy_order(graph: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in the order of taking away the one with the fewest neighbours left (N,).

    Batagelj and Zaversnik (2003), with vertices kept sorted by degree.

    Returns:
        The order, and the core number (N,) of each vertex: it is in no clique of more than one
        above that.
    """
    n = len(graph)
    core = degrees(graph)
    order = by_degree(core)
    place, start = np.empty(n, np.int64), np.zeros(n + 1, np.int64)
    for k in range(n):
        place[order[k]] = k
        start[core[order[k]] + 1] = k + 1
    for d in range(1, n + 1):
        start[d] = max(start[d], start[d - 1])
    neighbours = np.empty(n, np.int64)
    for k in range(n):
        v = order[k]
        for i in range(members(graph[v], neighbours)):
            u = neighbours[i]
            if core[u] > core[v]:  # u leaves its block by changing places with the block's first
                first = max(start[core[u]], k + 1)
                other = order[first]
                order[place[u]], order[first] = other, u
                place[other], place[u] = place[u], first
                start[core[u]] = first + 1
                core[u] -= 1
    return order, core


@njit(cache=True)
def largest_possible(graph: np.ndarray) -> int:
    """A bound on the size of cliques: one more than the largest core number (Seidman 1983)."""
    _, core = degeneracy_order(graph)
    largest = -1
    for v in range(len(core)):
        largest = max(largest, core[v])
    return largest + 1


@njit(cache=True)
def greedy_clique(graph: np.ndarray, starts: int) -> np.ndarray:
    """A large clique: from each of the vertices of most neighbours, add the next of most that fits.

    From `starts` vertices; of all walks (K,) the largest, the first on a tie.
    """
    n, words = graph.shape
    order = by_degree(n - 1 - degrees(graph))
    best, clique = np.zeros(n, np.int64), np.zeros(n, np.int64)
    size_of_best = 0
    left = np.empty(words, np.uint64)
    for start in range(min(starts, n)):
        clique[0], size = order[start], 1
        left[:] = graph[order[start]]
        for k in range(n):
            v = order[k]
            if has(left, v):
                clique[size] = v
                size += 1
                for w in range(words):
                    left[w] &= graph[v, w]
        if size > size_of_best:
            best[:size] = clique[:size]
            size_of_best = size
    return best[:size_of_best].copy()


@njit(cache=True)
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
    uncoloured[:] = candidates
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


@njit(cache=True)
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


@njit(cache=True)
def _among(graph: np.ndarray, chosen: np.ndarray, needed: int) -> tuple[np.ndarray, np.ndarray]:
    """The graph of the vertices `chosen` (W,) with at least `needed` neighbours among them.

    Takes vertices away from `chosen` until all that remain have enough.

    Returns:
        Their numbers (n,), none where they are too few to have so many neighbours, and the graph
        (n, ceil(n / 64)) in which they are numbered 0 to n - 1.
    """
    rows = np.empty(len(graph), np.int64)
    n, before = members(chosen, rows), -1
    while n > needed and n != before:
        before = n
        for i in range(before):
            v = rows[i]
            if count_common(graph[v], chosen) < needed:
                chosen[v // WORD] &= ~(np.uint64(1) << np.uint64(v % WORD))
                n -= 1
                if n <= needed:  # too few are left, the others need no look
                    break
        members(chosen, rows)
    if n <= needed:
        n = 0
    rows = rows[:n].copy()
    small = np.zeros((n, (n + WORD - 1) // WORD), np.uint64)
    for i in range(n):
        for j in range(n):
            if has(graph[rows[i]], rows[j]):
                small[i, j // WORD] |= np.uint64(1) << np.uint64(j % WORD)
    return rows, small


@njit(cache=True)
def larger_clique(graph: np.ndarray, at_least: int, budget: int) -> tuple[np.ndarray, bool]:
    """A maximum clique, if there is one of more than `at_least` vertices.

    Vertices are taken from the densest core outwards; each with its neighbours that come later in
    degeneracy order, which are few, so that every clique is looked for where its first vertex is.

    The graph (N, W) is symmetric, bit j of row i for an edge, no diagonal. After `budget` nodes of
    the search the largest found so far is returned. Returns (K,) vertices, none when no clique is
    larger; and whether the search came to its end.
    """
    n, words = graph.shape
    order, core = degeneracy_order(graph)
    best = np.zeros(0, np.int64)
    later, chosen = np.zeros(words, np.uint64), np.empty(words, np.uint64)
    for k in range(n - 1, -1, -1):
        v = order[k]
        if core[v] >= at_least:  # a clique of one vertex more than core[v] may begin here
            for w in range(words):
                chosen[w] = later[w] & graph[v, w]
            rows, small = _among(graph, chosen, at_least - 1)
            if len(rows):
                found, budget = _branch_and_bound(small, at_least - 1, budget)
                if len(found):
                    at_least = len(found) + 1
                    best = np.empty(at_least, np.int64)
                    best[0] = v
                    best[1:] = rows[found]
                if budget <= 0:
                    return best, False
        later[v // WORD] |= np.uint64(1) << np.uint64(v % WORD)
    return best, True
