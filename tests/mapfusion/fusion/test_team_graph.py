"""Tests of `mapfusion.fusion.team_graph`."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.fusion.pose_graph import AlignmentEdges
from mapfusion.fusion.team_graph import (
    EdgeStatus,
    LoopSearch,
    LoopTest,
    TeamParameters,
    Unconfirmed,
    resolve_alternatives,
    team_graph,
)
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose
from tests.mapfusion.fusion.teams import (
    SIDE_M,
    SIGMA,
    all_pairs,
    falsely_placed,
    measured,
    poses,
    team,
)

BOTH = [TeamParameters(each) for each in Unconfirmed]
DROP, KEEP = (TeamParameters(each) for each in (Unconfirmed.DROP, Unconfirmed.KEEP))


def true_of(robots: list[tuple[int, int]], true: Float, rng: np.random.Generator) -> AlignmentEdges:
    pairs = np.array(robots).reshape(-1, 2)
    return measured(pairs, between(true[pairs[:, 0]], true[pairs[:, 1]]), len(true), rng)


def wrong(robots: list[tuple[int, int]], n: int, rng: np.random.Generator) -> AlignmentEdges:
    pairs = np.array(robots).reshape(-1, 2)
    T = poses(len(pairs), rng) - [SIDE_M / 2, SIDE_M / 2, 0.0]
    return measured(pairs, T, n, rng)


@pytest.mark.parametrize("parameters", BOTH)
@pytest.mark.parametrize("seed", range(5))
def test_the_right_one_among_rivals_is_chosen(parameters: TeamParameters, seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = poses(3, rng)
    accepted = true_of([(0, 1), (1, 2)], true, rng)
    alternatives = wrong([(2, 0)] * 2, 3, rng).concatenated(true_of([(0, 2)], true, rng))
    found = team_graph(accepted, parameters, None, alternatives)
    assert found.edge_status.tolist() == [EdgeStatus.CONFIRMED] * 2 + [EdgeStatus.REFUSED] * 2 + [
        EdgeStatus.CONFIRMED
    ]
    assert found.component.tolist() == [0, 0, 0]
    assert len(falsely_placed(found, true)) == 0


def test_its_loop_makes_the_placement_surer() -> None:
    rng = np.random.default_rng(0)
    true = poses(3, rng)
    accepted, right = true_of([(0, 1), (1, 2)], true, rng), true_of([(0, 2)], true, rng)
    alone, told = team_graph(accepted), team_graph(accepted, alternatives=right)
    assert np.trace(told.covariance[2]) < np.trace(alone.covariance[2])


@pytest.mark.parametrize("parameters", BOTH)
def test_without_a_loop_of_accepted_ones_none_is_chosen(parameters: TeamParameters) -> None:
    """One accepted alignment, and alternatives that close a loop with it only among themselves."""
    rng = np.random.default_rng(1)
    true = poses(3, rng)
    accepted, alternatives = true_of([(0, 1)], true, rng), true_of([(1, 2), (0, 2)], true, rng)
    found = team_graph(accepted, parameters, None, alternatives)
    assert found.edge_status[1:].tolist() == [EdgeStatus.REFUSED] * 2
    assert found.component[2] != found.component[0]
    nothing = team_graph(accepted[np.arange(0)], parameters, None, alternatives)
    assert nothing.edge_status.tolist() == [EdgeStatus.REFUSED] * 2


def test_of_two_that_close_the_loop_alike_none_is_chosen() -> None:
    rng = np.random.default_rng(2)
    true = poses(3, rng)
    accepted, alternatives = (true_of(e, true, rng) for e in ([(0, 1), (1, 2)], [(0, 2)] * 2))
    found = team_graph(accepted, KEEP, None, alternatives)
    assert found.edge_status[2:].tolist() == [EdgeStatus.REFUSED] * 2


def test_no_false_merge_in_many_teams() -> None:
    """Six robots, true accepted alignments of some pairs, three rivals for each other pair.

    In half of the pairs one of the rivals is right. No other one may be believed, and those that
    loops can tell are nearly all found.
    """
    n_right = n_found = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        true, pairs = poses(6, rng), all_pairs(6)
        met = rng.random(len(pairs)) < 0.4
        accepted = true_of(pairs[met].tolist(), true, rng)
        alternatives = wrong(np.repeat(pairs[~met], 3, axis=0).tolist(), 6, rng)
        right = true_of(pairs[~met][::2].tolist(), true, rng)
        found = team_graph(accepted, KEEP, None, alternatives.concatenated(right))
        n_wrong = len(accepted) + len(alternatives)
        assert not np.any(found.edge_status[len(accepted) : n_wrong] == EdgeStatus.CONFIRMED), seed
        assert len(falsely_placed(found, true)) == 0, seed
        linked = found.component[right.robots[:, 0]] == found.component[right.robots[:, 1]]
        n_right += np.count_nonzero(linked)
        n_found += np.count_nonzero(found.edge_status[n_wrong:] == EdgeStatus.CONFIRMED)
        dropped = team_graph(accepted, DROP, None, alternatives.concatenated(right))
        assert len(falsely_placed(dropped, true)) == 0, seed
    assert n_found > 0.9 * n_right > 15


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("accepted_m", "rival_m", "told"), [(2.0, 2.0, False), (60.0, 2.0, True), (2.0, 60.0, True)]
)
def test_chance_closes_a_loop_as_far_as_any_alignment_reaches(
    seed: int, accepted_m: float, rival_m: float, told: bool
) -> None:
    """One of two alternatives of 0-2 closes the loop of the accepted 0-1 and 1-2.

    A gate with deviations of 0.5 m and 0.05 rad holds a fifth of all motions within 2 m, and less
    than a thousandth of those within 60 m. It does not matter which alignment reaches so far.
    """
    rng = np.random.default_rng(seed)
    way = rng.uniform(-np.pi, np.pi)
    out = np.array([accepted_m * np.cos(way), accepted_m * np.sin(way), 0.3])
    right = np.array([0.5, -0.4, 1.0])
    rival = np.array([-rival_m, 0.0, -2.0])
    covariance = np.diag([0.5, 0.5, 0.05]) ** 2

    def relations(robots: list[tuple[int, int]], T: list[Float]) -> AlignmentEdges:
        n = len(robots)
        return AlignmentEdges(
            3, np.array(robots), np.array(T), np.tile(covariance, (n, 1, 1)), -np.ones(n)
        )

    accepted = relations([(0, 1), (1, 2)], [out, between(out, right)])
    alternatives = relations([(0, 2), (0, 2)], [rival, right])
    kept, component = np.ones(2, dtype=bool), np.zeros(3, dtype=np.int64)
    found = resolve_alternatives(accepted, kept, component, alternatives, LoopTest())
    assert found.tolist() == ([1] if told else [])


def test_chance_is_the_gate_s_share_of_all_motions() -> None:
    rng, test, max_distance_m = np.random.default_rng(0), LoopTest(), 3.0
    S = np.diag([0.2, 0.3, 0.1]) ** 2
    n = 400_000
    drawn = rng.uniform(
        [-max_distance_m, -max_distance_m, -np.pi], [max_distance_m, max_distance_m, np.pi], (n, 3)
    )
    drawn = drawn[np.hypot(drawn[:, 0], drawn[:, 1]) <= max_distance_m]
    inside = np.mean(np.sum(drawn**2 / np.diag(S), axis=1) <= test.gate)
    assert test.chance(S[None], max_distance_m)[0] == pytest.approx(inside, rel=0.05)
    assert test.chance(1e6 * S[None], max_distance_m)[0] == 1.0


@pytest.mark.parametrize("n", [3, 4, 6])
def test_a_ring_is_a_loop_of_all_its_robots(n: int) -> None:
    rng = np.random.default_rng(n)
    true, each = poses(n, rng), np.arange(n)
    robots = np.stack([each, (each + 1) % n], axis=1)
    relations = measured(robots, between(true[robots[:, 0]], true[robots[:, 1]]), n, rng)
    everything = np.ones(n, dtype=bool)
    (found,) = LoopSearch(relations, LoopTest()).consistent_sets(everything)
    np.testing.assert_array_equal(found.rows, each)
    relations.T_a_b[1] += 12 * SIGMA * np.sqrt(n)
    assert LoopSearch(relations, LoopTest()).consistent_sets(everything) == []


def test_what_chance_would_close_is_no_loop() -> None:
    """Alignments that are off by as much as they reach close any loop."""
    rng = np.random.default_rng(5)
    true, robots = poses(3, rng), np.array([[0, 1], [1, 2], [0, 2]])
    relations = measured(robots, between(true[robots[:, 0]], true[robots[:, 1]]), 3, rng)
    everything = np.ones(3, dtype=bool)
    assert len(LoopSearch(relations, LoopTest()).consistent_sets(everything)) == 1
    relations.covariance[:] = np.diag([5.0, 5.0, 1.0]) ** 2
    assert LoopSearch(relations, LoopTest()).consistent_sets(everything) == []


def test_the_gate_keeps_true_loops_with_its_probability() -> None:
    """The error of a loop has three degrees of freedom: two coordinates and an angle."""
    for probability in (0.9, 0.999):
        assert LoopTest(probability).gate == pytest.approx(chi2.ppf(probability, 3))


TEAM_GRAPH_DROP, TEAM_GRAPH_KEEP = (
    TeamParameters(Unconfirmed.DROP),
    TeamParameters(Unconfirmed.KEEP),
)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["independent", "groups", "shifts"])
def test_half_of_the_alignments_are_false(kind: str, seed: int) -> None:
    met = team(seed, kind, 8 if kind == "shifts" else 10)
    found = team_graph(met.relations, TEAM_GRAPH_DROP)
    assert len(falsely_placed(found, met.T_world_robot)) == 0
    assert not np.any(met.false & (found.edge_status == EdgeStatus.CONFIRMED))
    if kind == "independent":
        placed = np.bincount(met.relations.robots[~met.false].ravel(), minlength=10) > 1
        np.testing.assert_array_equal(found.component[placed], 0)
        assert np.all(found.edge_status[met.false] == EdgeStatus.CONTRADICTED)


@pytest.mark.parametrize("parameters", [TEAM_GRAPH_DROP, TEAM_GRAPH_KEEP])
@pytest.mark.parametrize("kind", ["independent", "groups"])
def test_the_order_changes_nothing_but_the_frame(kind: str, parameters: TeamParameters) -> None:
    met, rng = team(4, kind), np.random.default_rng(0)
    relations, new = met.relations, rng.permutation(10)  # robot i is called new[i]
    order = rng.permutation(len(relations))
    other = AlignmentEdges(
        10,
        new[relations.robots][order],
        relations.T_a_b[order],
        relations.covariance[order],
        relations.log10_false_alarms[order],
    )
    one, two = team_graph(relations, parameters), team_graph(other, parameters)
    np.testing.assert_array_equal(one.edge_status[order], two.edge_status)
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
    kept, dropped = team_graph(relations, TEAM_GRAPH_KEEP), team_graph(relations, TEAM_GRAPH_DROP)
    assert kept.edge_status.tolist() == [EdgeStatus.CONFIRMED] * 3 + [EdgeStatus.BRIDGE]
    assert dropped.edge_status.tolist() == [EdgeStatus.CONFIRMED] * 3 + [EdgeStatus.UNCONFIRMED]
    np.testing.assert_array_equal(kept.component, 0)
    np.testing.assert_array_equal(dropped.component, [0, 0, 0, 1])
    assert len(falsely_placed(kept, true)) == 0
    # the bridge adds its own variance to that of the robot it starts from
    assert np.all(np.diagonal(kept.covariance[3] - relations.covariance[3]) > 0)


def test_of_bridges_that_contradict_each_other_the_surest() -> None:
    rng = np.random.default_rng(2)
    relations = measured(all_pairs(3), poses(3, rng), 3, rng)  # a triangle that does not close
    sure = replace(relations, log10_false_alarms=np.array([-20.0, -6.0, -9.0]))
    found = team_graph(sure, TEAM_GRAPH_KEEP)
    assert found.edge_status.tolist() == [
        EdgeStatus.BRIDGE,
        EdgeStatus.CONTRADICTED,
        EdgeStatus.BRIDGE,
    ]
    np.testing.assert_array_equal(team_graph(sure, TEAM_GRAPH_DROP).component, [0, 1, 2])


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
    kept, dropped = team_graph(relations, TEAM_GRAPH_KEEP), team_graph(relations, TEAM_GRAPH_DROP)
    np.testing.assert_array_equal(kept.component, [0, 0, 0, 0, 1, 1, 1, 1])
    assert np.all(kept.edge_status[across] == EdgeStatus.AMBIGUOUS)
    assert np.all(kept.edge_status[~across] == EdgeStatus.CONFIRMED)
    assert not np.any(dropped.edge_status[across] == EdgeStatus.CONFIRMED)
    assert len(falsely_placed(dropped, true)) == 0


def test_a_small_reading_loses_or_warns() -> None:
    """A false loop of three robots among seven: the many count, unless none may object."""
    rng = np.random.default_rng(4)
    true, robots = poses(7, rng), all_pairs(7)
    T, believed = between(true[robots[:, 0]], true[robots[:, 1]]), poses(7, rng)
    false = (robots < 3).all(axis=1)
    T[false] = between(believed[robots[false, 0]], believed[robots[false, 1]])
    relations = measured(robots, T, 7, rng)
    kept, dropped = team_graph(relations, TEAM_GRAPH_KEEP), team_graph(relations, TEAM_GRAPH_DROP)
    np.testing.assert_array_equal(kept.component, 0)
    assert np.all(kept.edge_status[false] == EdgeStatus.CONTRADICTED)
    assert len(falsely_placed(kept, true)) == 0
    np.testing.assert_array_equal(dropped.component, [1, 2, 3, 0, 0, 0, 0])


def test_no_alignments_at_all() -> None:
    nothing = AlignmentEdges(
        3, np.empty((0, 2), int), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0)
    )
    found = team_graph(nothing)
    np.testing.assert_array_equal(found.component, [0, 1, 2])
    np.testing.assert_array_equal(found.T_root_robot, 0.0)
