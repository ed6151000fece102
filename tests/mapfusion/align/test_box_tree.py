import numpy as np
import pytest
from scipy.spatial.distance import cdist

from mapfusion.align.box_tree import BoxTree, look_up, put_in_order, room_for_search
from tests.mapfusion.align.test_closest import points

KINDS = ["spread", "one wall", "far outlier", "one place", "two"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("begins", ["with nothing", "with others", "with the answer"])
@pytest.mark.parametrize("kept", [1, 4])
def test_finds_what_looking_at_all_finds(kind, begins, kept):
    rng = np.random.default_rng(0)
    p = points(kind, rng)
    tree, todo, n = BoxTree.of(p), room_for_search(), min(kept, len(p))
    np.testing.assert_array_equal(tree.p, p[tree.row])
    queries = np.vstack([rng.uniform(-2, 22, (100, 3)), rng.uniform(-100, 100, (30, 3)), p[:20]])
    for q in queries:
        near, square = np.full(kept, -1), np.empty(kept)
        away = cdist(q[None], tree.p)[0]
        if begins == "with others":
            near[:n] = rng.choice(len(p), n, replace=False)
        elif begins == "with the answer":
            near[:n] = np.argsort(away)[:n][::-1]
        put_in_order(q[0], q[1], q[2], tree.p, near, square)
        assert (square[1:] >= square[:-1]).all()
        look_up(q[0], q[1], q[2], tree, near, square, todo)
        np.testing.assert_allclose(np.sqrt(square[:n]), np.sort(away)[:n], rtol=0, atol=1e-12)
        np.testing.assert_allclose(away[near[:n]], np.sqrt(square[:n]), rtol=0, atol=1e-12)
        assert len(set(near[:n])) == n
        assert (near[n:] == -1).all()
        assert np.isinf(square[n:]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_each_box_holds_its_points_and_halves_those_of_the_one_above(kind):
    tree = BoxTree.of(points(kind, np.random.default_rng(1)))
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
