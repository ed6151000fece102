import numpy as np
import pytest

from mapfusion.align.nearest_neighbours import POINTS_PER_LEAF, BoxTree
from tests.mapfusion.align.test_closest import points

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
    """Of another layout they would be compiled once more."""
    tree = BoxTree.of(np.random.default_rng(0).uniform(0, 9, (n, 3)))
    assert all(part.flags.c_contiguous for part in tree)
