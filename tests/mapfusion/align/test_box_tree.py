import numpy as np
import pytest

from mapfusion.align.box_tree import BoxTree
from tests.mapfusion.align.test_closest import points

KINDS = ["spread", "one wall", "far outlier", "one place", "two"]


@pytest.mark.parametrize("kind", KINDS)
def test_each_box_holds_its_points_and_halves_those_of_the_one_above(kind):
    p = points(kind, np.random.default_rng(1))
    tree = BoxTree.of(p)
    np.testing.assert_array_equal(tree.p, p[tree.row])
    assert sorted(tree.row) == list(range(len(tree.p)))
    inner = len(tree.first) // 2
    for node, (first, end) in enumerate(zip(tree.first, tree.end, strict=True)):
        held = tree.p[first:end]
        np.testing.assert_array_equal(tree.box[node], [*held.min(axis=0), *held.max(axis=0)])
        if node < inner:
            below = (2 * node + 1, 2 * node + 2)
            assert [tree.first[k] for k in below] == [first, (first + end) // 2]
            assert [tree.end[k] for k in below] == [(first + end) // 2, end]
            axis = np.argmax(np.ptp(held, axis=0))
            halves = (tree.p[tree.first[k] : tree.end[k], axis] for k in below)
            assert next(halves).max() <= next(halves).min()
