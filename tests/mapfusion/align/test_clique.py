import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.align.alignment import Fit, Pairs
from mapfusion.align.clique import (
    Clique,
    full_set,
    greedy_clique,
    larger_clique,
    may_contain_clique,
    reduce_to_core,
)
from mapfusion.align.correspondences import match
from mapfusion.geometry.se2 import transform_points
from tests.mapfusion.align.map_pairs import landmarks

UNLIMITED = 1_000_000


def on_bits(adjacent):
    rows, n = adjacent.shape
    padded = np.zeros((rows, -(-n // 64) * 64), np.uint8)
    padded[:, :n] = adjacent
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)


def random_graph(seed, n, density, planted=0):
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.random((n, n)) < density, 1)
    members = rng.choice(n, planted, replace=False)
    upper[np.ix_(members, members)] = True
    adjacent = np.triu(upper | upper.T, 1)
    return adjacent | adjacent.T


def bron_kerbosch(adjacent):
    """Return the size of the largest clique (Bron and Kerbosch 1973, with a pivot)."""
    neighbours = [set(np.flatnonzero(row)) for row in adjacent]
    largest = 0

    def extend(size, candidates, excluded):
        nonlocal largest
        if not candidates and not excluded:
            largest = max(largest, size)
            return
        pivot = max(candidates | excluded, key=lambda u: len(neighbours[u] & candidates))
        for v in list(candidates - neighbours[pivot]):
            extend(size + 1, candidates & neighbours[v], excluded & neighbours[v])
            candidates.remove(v)
            excluded.add(v)

    extend(0, set(range(len(adjacent))), set())
    return largest


def larger_of(adjacent, at_least, budget=UNLIMITED):
    return larger_clique(on_bits(adjacent), full_set(len(adjacent)), at_least, budget)


def is_clique(adjacent, vertices):
    joined = adjacent[np.ix_(vertices, vertices)]
    return len(set(vertices)) == len(vertices) and np.all(
        joined | np.eye(len(vertices), dtype=bool)
    )


graphs = st.builds(
    random_graph,
    st.integers(0, 10**6),
    st.sampled_from([1, 2, 5, 12, 25, 63, 64, 65, 130]),
    st.floats(0, 0.35),
)
dense_graphs = st.builds(
    random_graph, st.integers(0, 10**6), st.integers(1, 22), st.floats(0.3, 1.0)
)


@settings(max_examples=80)
@given(st.one_of(graphs, dense_graphs), st.integers(0, 4))
def test_as_large_as_the_slow_way_finds(adjacent, short_of):
    size = bron_kerbosch(adjacent)
    at_least = max(size - short_of, 1)
    clique, finished = larger_of(adjacent, at_least)
    assert finished
    assert len(clique) == (size if size > at_least else 0)
    assert is_clique(adjacent, clique)


@settings(max_examples=60)
@given(st.one_of(graphs, dense_graphs))
def test_greedy_gives_a_clique_that_nothing_can_join(adjacent):
    clique = greedy_clique(on_bits(adjacent), 10)
    assert is_clique(adjacent, clique)
    joined_to_all = adjacent[clique].all(axis=0)
    assert len(clique) >= 1
    assert not joined_to_all.any()


@settings(max_examples=40)
@given(st.one_of(graphs, dense_graphs), st.integers(0, 2**64 - 1))
def test_among_some_vertices_the_others_do_not_count(adjacent, seed):
    chosen = np.random.default_rng(seed).random(len(adjacent)) < 0.6
    among = on_bits(chosen[None])[0]
    clique, finished = larger_clique(on_bits(adjacent), among, 1, UNLIMITED)
    assert finished
    assert chosen[clique].all()
    size = bron_kerbosch(adjacent[np.ix_(chosen, chosen)])
    assert len(clique) == (size if size > 1 else 0)


@settings(max_examples=60)
@given(st.one_of(graphs, dense_graphs), st.integers(0, 12))
def test_core_is_what_taking_away_leaves(adjacent, least):
    left = np.ones(len(adjacent), dtype=bool)
    while np.any(poor := left & (adjacent[:, left].sum(axis=1) < least)):
        left &= ~poor
    chosen, rows = full_set(len(adjacent)), np.empty(len(adjacent), np.int64)
    count = reduce_to_core(on_bits(adjacent), chosen, least, rows)
    np.testing.assert_array_equal(rows[:count], np.flatnonzero(left))


def test_planted_clique_is_found_among_thousands():
    adjacent = random_graph(1, 2000, 0.03, planted=15)
    clique, finished = larger_of(adjacent, 5)
    assert finished
    assert len(clique) == 15
    assert is_clique(adjacent, clique)


@pytest.mark.parametrize("budget", [1, 3, 20])
def test_a_spent_budget_is_told_and_what_was_found_is_a_clique(budget):
    adjacent = random_graph(2, 200, 0.7)
    clique, finished = larger_of(adjacent, 2, budget)
    assert not finished
    assert is_clique(adjacent, clique)


def may_be_larger(adjacent, size):
    return may_contain_clique(on_bits(adjacent), full_set(len(adjacent)), size)


@pytest.mark.parametrize("seed", range(10))
def test_no_clique_is_larger_than_possible(seed):
    adjacent = random_graph(seed, 40, 0.1 * (seed + 1) / 2, planted=seed)
    assert may_be_larger(adjacent, bron_kerbosch(adjacent) - 1)


def test_of_one_clique_beside_single_vertices_the_bound_is_its_size():
    planted = random_graph(0, 70, 0.0, planted=9)
    assert may_be_larger(planted, 8)
    assert not may_be_larger(planted, 9)
    assert not may_be_larger(random_graph(0, 70, 0.0), 1)


def test_a_mirror_image_has_the_motion_of_one_wall():
    """All distances of two mirrored walls agree, but a motion lays only one on its image."""
    rng, T_a_b = np.random.default_rng(3), np.array([2.0, -1.0, 0.4])
    wall = np.arange(20) < 12
    p_b = np.column_stack([rng.uniform(0, 40, 20), np.where(wall, 0.0, 2.5), np.zeros(20)])
    p_a = p_b * [1, -1, 1]
    p_a[:, :2] = transform_points(T_a_b, p_a[:, :2])
    label = np.arange(20, dtype=np.int32)
    maps = [landmarks(p, 0.02, label=label, planar=True) for p in (p_a, p_b)]
    found = Clique().find(Pairs(*maps, match(*maps)), rng)
    assert isinstance(found, Fit)
    assert np.array_equal(found.inlier, wall)
    assert np.allclose(found.T_a_b, T_a_b, atol=1e-9)
