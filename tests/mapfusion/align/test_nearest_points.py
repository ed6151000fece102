import numpy as np
import pytest
from scipy.spatial.distance import cdist

from mapfusion.align.nearest_neighbours import (
    GROUP,
    BoxTree,
    Groups,
    look_up_group,
    room_for_groups,
)
from mapfusion.geometry import se2
from tests.helpers.inner_kernels import from_python
from tests.mapfusion.align.test_box_tree import KINDS
from tests.mapfusion.align.test_closest import points


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("begins", ["with nothing", "with others", "with the answer"])
@pytest.mark.parametrize("n", [1, GROUP, 75])
def test_finds_what_looking_at_all_finds(kind: str, begins: str, n: int) -> None:
    rng = np.random.default_rng(0)
    p, T = points(kind, rng), np.array([3.0, -1.0, 0.7])
    asked = np.vstack([rng.uniform(-2, 22, (40, 3)), rng.uniform(-100, 100, (20, 3)), p[:20]])
    asked = rng.permutation(np.tile(asked, (2, 1)))[:n]
    tree, groups, room = BoxTree.of(p), Groups.of(asked), room_for_groups()
    away = cdist(se2.transform_points(T, asked[groups.row]), tree.p)
    nearest = np.full(len(groups.row), -1)
    if begins == "with others":
        nearest[:] = rng.integers(0, len(p), len(nearest))
    elif begins == "with the answer":
        nearest[:] = away.argmin(axis=1)
    for first in range(0, len(groups.row), GROUP):
        from_python(look_up_group)(T, first, groups, tree, nearest, room)
        own = away[first : first + GROUP]
        np.testing.assert_allclose(np.sqrt(room.square), own.min(axis=1), rtol=0, atol=1e-10)
        found = own[np.arange(GROUP), room.nearest.astype(int)]
        np.testing.assert_allclose(found, own.min(axis=1), rtol=0, atol=1e-10)


@pytest.mark.parametrize("apart_m", [0.05, 1.0, 30.0])
def test_close_groups_find_theirs_in_a_large_tree(apart_m: float) -> None:
    """Where most of the tree is passed over, and what is passed over matters."""
    rng = np.random.default_rng(1)
    p = rng.uniform(0, [20, 20, 2], (3000, 3))
    asked = rng.permutation(p)[:1600] + rng.normal(0, apart_m, (1600, 3))
    tree, groups, room = BoxTree.of(p), Groups.of(asked), room_for_groups()
    away = cdist(asked[groups.row], tree.p)
    for before in (np.full(1600, -1), away.argpartition(9, axis=1)[:, 9]):
        for first in range(0, 1600, GROUP):
            from_python(look_up_group)(np.zeros(3), first, groups, tree, before, room)
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
    """On a wall of 512 points each group is a sixteenth or so of the wall's extent."""
    along = np.random.default_rng(0).permutation(np.linspace(0, 1, 512))
    groups = Groups.of(np.column_stack([along, np.zeros((512, 2))]))
    assert np.ptp(groups.x.reshape(-1, GROUP), axis=1).max() == pytest.approx(15 / 511)
