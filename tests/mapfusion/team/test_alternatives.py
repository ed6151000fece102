"""Alternatives of an ambiguous pair: the right one is told by a loop of accepted ones, or none."""

import numpy as np
import pytest

from mapfusion.fusion.pose_graph import Relations
from mapfusion.fusion.team_graph import (
    LoopTest,
    Place,
    TeamParameters,
    Unconfirmed,
    team_graph,
    told_apart,
)
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between
from tests.mapfusion.team.teams import SIDE_M, all_pairs, falsely_placed, measured, poses

BOTH = [TeamParameters(each) for each in Unconfirmed]
DROP, KEEP = (TeamParameters(each) for each in (Unconfirmed.DROP, Unconfirmed.KEEP))


def true_of(robots: list[tuple[int, int]], true: Float, rng: np.random.Generator) -> Relations:
    pairs = np.array(robots).reshape(-1, 2)
    return measured(pairs, between(true[pairs[:, 0]], true[pairs[:, 1]]), len(true), rng)


def wrong(robots: list[tuple[int, int]], n: int, rng: np.random.Generator) -> Relations:
    pairs = np.array(robots).reshape(-1, 2)
    T = poses(len(pairs), rng) - [SIDE_M / 2, SIDE_M / 2, 0.0]
    return measured(pairs, T, n, rng)


@pytest.mark.parametrize("parameters", BOTH)
@pytest.mark.parametrize("seed", range(5))
def test_the_right_one_among_rivals_is_chosen(parameters: TeamParameters, seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = poses(3, rng)
    accepted = true_of([(0, 1), (1, 2)], true, rng)
    alternatives = wrong([(2, 0)] * 2, 3, rng).joined(true_of([(0, 2)], true, rng))
    found = team_graph(accepted, parameters, None, alternatives)
    assert found.place.tolist() == [Place.CONFIRMED] * 2 + [Place.REFUSED] * 2 + [Place.CONFIRMED]
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
    assert found.place[1:].tolist() == [Place.REFUSED] * 2
    assert found.component[2] != found.component[0]
    nothing = team_graph(accepted[np.arange(0)], parameters, None, alternatives)
    assert nothing.place.tolist() == [Place.REFUSED] * 2


def test_of_two_that_close_the_loop_alike_none_is_chosen() -> None:
    rng = np.random.default_rng(2)
    true = poses(3, rng)
    accepted, alternatives = (true_of(e, true, rng) for e in ([(0, 1), (1, 2)], [(0, 2)] * 2))
    found = team_graph(accepted, KEEP, None, alternatives)
    assert found.place[2:].tolist() == [Place.REFUSED] * 2


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
        found = team_graph(accepted, KEEP, None, alternatives.joined(right))
        n_wrong = len(accepted) + len(alternatives)
        assert not np.any(found.place[len(accepted) : n_wrong] == Place.CONFIRMED), seed
        assert len(falsely_placed(found, true)) == 0, seed
        linked = found.component[right.robots[:, 0]] == found.component[right.robots[:, 1]]
        n_right += np.count_nonzero(linked)
        n_found += np.count_nonzero(found.place[n_wrong:] == Place.CONFIRMED)
        dropped = team_graph(accepted, DROP, None, alternatives.joined(right))
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

    def relations(robots: list[tuple[int, int]], T: list[Float]) -> Relations:
        n = len(robots)
        return Relations(
            3, np.array(robots), np.array(T), np.tile(covariance, (n, 1, 1)), -np.ones(n)
        )

    accepted = relations([(0, 1), (1, 2)], [out, between(out, right)])
    alternatives = relations([(0, 2), (0, 2)], [rival, right])
    kept, component = np.ones(2, dtype=bool), np.zeros(3, dtype=np.int64)
    found = told_apart(accepted, kept, component, alternatives, LoopTest())
    assert found.tolist() == ([1] if told else [])
