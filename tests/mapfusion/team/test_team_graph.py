"""Which robots belong together: true alignments are found among false ones, or none are."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.fusion.pose_graph import Relations
from mapfusion.fusion.team_graph import Place, TeamParameters, Unconfirmed, team_graph
from mapfusion.geometry.se2 import between, compose
from tests.mapfusion.team.teams import all_pairs, falsely_placed, measured, poses, team

DROP, KEEP = TeamParameters(Unconfirmed.DROP), TeamParameters(Unconfirmed.KEEP)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["independent", "groups", "shifts"])
def test_half_of_the_alignments_are_false(kind: str, seed: int) -> None:
    met = team(seed, kind, 8 if kind == "shifts" else 10)
    found = team_graph(met.relations, DROP)
    assert len(falsely_placed(found, met.T_world_robot)) == 0
    assert not np.any(met.false & (found.place == Place.CONFIRMED))
    if kind == "independent":
        placed = np.bincount(met.relations.robots[~met.false].ravel(), minlength=10) > 1
        np.testing.assert_array_equal(found.component[placed], 0)
        assert np.all(found.place[met.false] == Place.CONTRADICTED)


@pytest.mark.parametrize("parameters", [DROP, KEEP])
@pytest.mark.parametrize("kind", ["independent", "groups"])
def test_the_order_changes_nothing_but_the_frame(kind: str, parameters: TeamParameters) -> None:
    met, rng = team(4, kind), np.random.default_rng(0)
    relations, new = met.relations, rng.permutation(10)  # robot i is called new[i]
    order = rng.permutation(len(relations))
    other = Relations(
        10,
        new[relations.robots][order],
        relations.T_a_b[order],
        relations.covariance[order],
        relations.log10_false_alarms[order],
    )
    one, two = team_graph(relations, parameters), team_graph(other, parameters)
    np.testing.assert_array_equal(one.place[order], two.place)
    together = one.component[:, None] == one.component
    np.testing.assert_array_equal(together, (two.component[:, None] == two.component)[new][:, new])
    i, j = np.nonzero(together)
    np.testing.assert_allclose(
        between(one.T_root_robot[i], one.T_root_robot[j]),
        between(two.T_root_robot[new[i]], two.T_root_robot[new[j]]),
        atol=1e-6,
    )


def test_an_alignment_that_no_loop_confirms() -> None:
    rng = np.random.default_rng(1)
    true, robots = poses(4, rng), np.array([[0, 1], [1, 2], [0, 2], [2, 3]])
    relations = measured(robots, between(true[robots[:, 0]], true[robots[:, 1]]), 4, rng)
    kept, dropped = team_graph(relations, KEEP), team_graph(relations, DROP)
    assert kept.place.tolist() == [Place.CONFIRMED] * 3 + [Place.BRIDGE]
    assert dropped.place.tolist() == [Place.CONFIRMED] * 3 + [Place.UNCONFIRMED]
    np.testing.assert_array_equal(kept.component, 0)
    np.testing.assert_array_equal(dropped.component, [0, 0, 0, 1])
    assert len(falsely_placed(kept, true)) == 0
    # the bridge adds its own variance to that of the robot it starts from
    assert np.all(np.diagonal(kept.covariance[3] - relations.covariance[3]) > 0)


def test_of_bridges_that_contradict_each_other_the_surest() -> None:
    rng = np.random.default_rng(2)
    relations = measured(all_pairs(3), poses(3, rng), 3, rng)  # a triangle that does not close
    sure = replace(relations, log10_false_alarms=np.array([-20.0, -6.0, -9.0]))
    found = team_graph(sure, KEEP)
    assert found.place.tolist() == [Place.BRIDGE, Place.CONTRADICTED, Place.BRIDGE]
    np.testing.assert_array_equal(team_graph(sure, DROP).component, [0, 1, 2])


def test_two_readings_of_one_cut_leave_both_sides_whole() -> None:
    """Four robots and four others: half of the alignments across say this and half say that."""
    rng = np.random.default_rng(3)
    true, robots = poses(8, rng), all_pairs(8)
    across = (robots[:, 0] < 4) & (robots[:, 1] >= 4)
    shifted = np.where(np.arange(8)[:, None] < 4, true, compose(poses(1, rng), true))
    T = between(true[robots[:, 0]], true[robots[:, 1]])
    other = np.flatnonzero(across & (robots.sum(axis=1) % 2 == 1))
    T[other] = between(shifted[robots[other, 0]], shifted[robots[other, 1]])
    relations = measured(robots, T, 8, rng)
    kept, dropped = team_graph(relations, KEEP), team_graph(relations, DROP)
    np.testing.assert_array_equal(kept.component, [0, 0, 0, 0, 1, 1, 1, 1])
    assert np.all(kept.place[across] == Place.AMBIGUOUS)
    assert np.all(kept.place[~across] == Place.CONFIRMED)
    assert not np.any(dropped.place[across] == Place.CONFIRMED)
    assert len(falsely_placed(dropped, true)) == 0


def test_a_small_reading_loses_or_warns() -> None:
    """A false loop of three robots among seven: the many count, unless none may object."""
    rng = np.random.default_rng(4)
    true, robots = poses(7, rng), all_pairs(7)
    T, believed = between(true[robots[:, 0]], true[robots[:, 1]]), poses(7, rng)
    false = (robots < 3).all(axis=1)
    T[false] = between(believed[robots[false, 0]], believed[robots[false, 1]])
    relations = measured(robots, T, 7, rng)
    kept, dropped = team_graph(relations, KEEP), team_graph(relations, DROP)
    np.testing.assert_array_equal(kept.component, 0)
    assert np.all(kept.place[false] == Place.CONTRADICTED)
    assert len(falsely_placed(kept, true)) == 0
    np.testing.assert_array_equal(dropped.component, [1, 2, 3, 0, 0, 0, 0])


def test_no_alignments_at_all() -> None:
    nothing = Relations(
        3, np.empty((0, 2), int), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0)
    )
    found = team_graph(nothing)
    np.testing.assert_array_equal(found.component, [0, 1, 2])
    np.testing.assert_array_equal(found.T_root_robot, 0.0)
