"""Tests of `mapfusion.align.nearest_neighbours`."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from mapfusion.align.nearest_neighbours import (
    GROUP,
    POINTS_PER_LEAF,
    BoxTree,
    Grid,
    Groups,
    find_nearest_of_group,
    new_search_state,
    ranges_within,
)
from mapfusion.geometry import se2


def points(kind, rng):
    return {
        "spread": rng.uniform(0, 20, (300, 3)),
        "one wall": np.column_stack([np.full(200, 3.0), rng.uniform(0, 15, 200), np.zeros(200)]),
        "far outlier": np.vstack([rng.uniform(0, 5, (200, 3)), [[500.0, -300.0, 1.0]]]),
        "one place": np.ones((40, 3)),
        "two": rng.uniform(0, 1, (2, 3)),
    }[kind]


@pytest.mark.parametrize("kind", ["spread", "one wall", "far outlier", "one place", "two"])
def test_all_within_a_radius_are_in_the_runs_about_a_point(kind):
    rng = np.random.default_rng(1)
    p = points(kind, rng)
    grid, looked_at = Grid.of(p), 0
    runs = np.empty((grid.shape[1], 2), np.int64)
    queries = np.vstack([rng.uniform(-2, 22, (200, 3)), rng.uniform(-1000, 1000, (20, 3)), p[:20]])
    for q, radius in zip(queries, rng.uniform(0, 3, len(queries)), strict=True):
        ranges = runs[: ranges_within(q[0], q[1], radius, grid, runs)]
        found = np.concatenate([grid.row[first:end] for first, end in ranges] + [np.zeros(0, int)])
        near = np.flatnonzero(np.hypot(*(p - q)[:, :2].T) <= radius)
        assert len(set(found)) == len(found)
        assert set(near) <= set(found)
        looked_at += len(found)
    assert kind != "spread" or looked_at < 0.2 * len(queries) * len(p)


def test_of_no_points_there_is_a_grid():
    grid = Grid.of(np.zeros((0, 2)))
    runs = np.empty((grid.shape[1], 2), np.int64)
    assert ranges_within(0.0, 0.0, 1.0, grid, runs) <= 1
    np.testing.assert_array_equal(grid.start, 0)


KINDS = ["spread", "one wall", "far outlier", "one place", "two"]


@pytest.mark.parametrize("kind", KINDS)
def test_each_box_holds_its_points_and_halves_those_of_the_one_above(kind):
    p = points(kind, np.random.default_rng(1))
    tree = BoxTree.of(p)
    np.testing.assert_array_equal(tree.p, p[tree.row])
    np.testing.assert_array_equal(np.stack([tree.x, tree.y, tree.z], axis=1), tree.p)
    assert sorted(tree.row) == list(range(len(tree.p)))
    inner = len(tree.first) // 2
    size = -(-len(p) // (inner + 1))
    assert size <= POINTS_PER_LEAF
    leaves = tree.end[inner:] - tree.first[inner:]
    np.testing.assert_array_equal(leaves, np.clip(len(p) - size * np.arange(inner + 1), 0, size))
    for node, (first, end) in enumerate(zip(tree.first, tree.end, strict=True)):
        held = tree.p[first:end]
        if len(held) == 0:
            np.testing.assert_array_equal(tree.box[node], [np.inf] * 3 + [-np.inf] * 3)
            continue
        np.testing.assert_array_equal(tree.box[node], [*held.min(axis=0), *held.max(axis=0)])
        if node < inner:
            low, high = 2 * node + 1, 2 * node + 2
            assert tree.first[low] == first
            assert tree.end[low] == tree.first[high]
            assert tree.end[high] == end
            axis = np.argmax(np.ptp(held, axis=0))
            above = tree.p[tree.first[high] : end, axis]
            assert tree.p[first : tree.end[low], axis].max() <= above.min(initial=np.inf)


@pytest.mark.parametrize("n", [1, POINTS_PER_LEAF, 10 * POINTS_PER_LEAF])
def test_kernels_get_arrays_of_one_layout_from_trees_of_any_size(n: int) -> None:
    """Another memory layout would compile the kernels again."""
    tree = BoxTree.of(np.random.default_rng(0).uniform(0, 9, (n, 3)))
    assert all(part.flags.c_contiguous for part in tree)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("begins", ["with nothing", "with others", "with the answer"])
@pytest.mark.parametrize("n", [1, GROUP, 75])
def test_finds_what_looking_at_all_finds(kind: str, begins: str, n: int) -> None:
    rng = np.random.default_rng(0)
    p, T = points(kind, rng), np.array([3.0, -1.0, 0.7])
    asked = np.vstack([rng.uniform(-2, 22, (40, 3)), rng.uniform(-100, 100, (20, 3)), p[:20]])
    asked = rng.permutation(np.tile(asked, (2, 1)))[:n]
    tree, groups, room = BoxTree.of(p), Groups.of(asked), new_search_state()
    away = cdist(se2.transform_points(T, asked[groups.row]), tree.p)
    nearest = np.full(len(groups.row), -1)
    if begins == "with others":
        nearest[:] = rng.integers(0, len(p), len(nearest))
    elif begins == "with the answer":
        nearest[:] = away.argmin(axis=1)
    for first in range(0, len(groups.row), GROUP):
        find_nearest_of_group(T, first, groups, tree, nearest, room)
        own = away[first : first + GROUP]
        np.testing.assert_allclose(np.sqrt(room.square), own.min(axis=1), rtol=0, atol=1e-10)
        found = own[np.arange(GROUP), room.nearest.astype(int)]
        np.testing.assert_allclose(found, own.min(axis=1), rtol=0, atol=1e-10)


@pytest.mark.parametrize("apart_m", [0.05, 1.0, 30.0])
def test_close_groups_find_theirs_in_a_large_tree(apart_m: float) -> None:
    """Most of the tree is excluded, and a wrong exclusion changes the result."""
    rng = np.random.default_rng(1)
    p = rng.uniform(0, [20, 20, 2], (3000, 3))
    asked = rng.permutation(p)[:1600] + rng.normal(0, apart_m, (1600, 3))
    tree, groups, room = BoxTree.of(p), Groups.of(asked), new_search_state()
    away = cdist(asked[groups.row], tree.p)
    for before in (np.full(1600, -1), away.argpartition(9, axis=1)[:, 9]):
        for first in range(0, 1600, GROUP):
            find_nearest_of_group(np.zeros(3), first, groups, tree, before, room)
            own = away[first : first + GROUP].min(axis=1)
            np.testing.assert_allclose(np.sqrt(room.square), own, rtol=0, atol=1e-10)


@pytest.mark.parametrize("n", [1, 15, 16, 17, 100, 500])
def test_each_point_is_in_a_group_and_the_last_one_is_filled_up(n: int) -> None:
    p = np.random.default_rng(n).uniform(0, 9, (n, 3))
    groups = Groups.of(p)
    assert groups.n == n
    assert len(groups.row) == -(-n // GROUP) * GROUP
    assert sorted(groups.row[:n]) == list(range(n))
    assert set(groups.row[n:]) <= {groups.row[n // GROUP * GROUP]} if n % GROUP else True
    np.testing.assert_array_equal(np.stack(groups[2:], axis=1), p[groups.row])


def test_groups_lie_close_together() -> None:
    """On a wall of 512 points a group has about 1/16 of the wall's extent."""
    along = np.random.default_rng(0).permutation(np.linspace(0, 1, 512))
    groups = Groups.of(np.column_stack([along, np.zeros((512, 2))]))
    assert np.ptp(groups.x.reshape(-1, GROUP), axis=1).max() == pytest.approx(15 / 511)
