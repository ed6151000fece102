"""Loops of alignments: closed by true ones, hardly ever by chance."""

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.fusion.team_graph import LoopTest, Team
from mapfusion.geometry.se2 import between
from tests.mapfusion.team.teams import SIGMA, measured, poses


def test_chance_is_the_gate_s_share_of_all_motions() -> None:
    rng, test, reach_m = np.random.default_rng(0), LoopTest(), 3.0
    S = np.diag([0.2, 0.3, 0.1]) ** 2
    n = 400_000
    drawn = rng.uniform([-reach_m, -reach_m, -np.pi], [reach_m, reach_m, np.pi], (n, 3))
    drawn = drawn[np.hypot(drawn[:, 0], drawn[:, 1]) <= reach_m]
    inside = np.mean(np.sum(drawn**2 / np.diag(S), axis=1) <= test.gate)
    assert test.chance(S[None], reach_m)[0] == pytest.approx(inside, rel=0.05)
    assert test.chance(1e6 * S[None], reach_m)[0] == 1.0


@pytest.mark.parametrize("n", [3, 4, 6])
def test_a_ring_is_a_loop_of_all_its_robots(n: int) -> None:
    rng = np.random.default_rng(n)
    true, each = poses(n, rng), np.arange(n)
    robots = np.stack([each, (each + 1) % n], axis=1)
    relations = measured(robots, between(true[robots[:, 0]], true[robots[:, 1]]), n, rng)
    everything = np.ones(n, dtype=bool)
    (found,) = Team(relations, LoopTest()).readings(everything)
    np.testing.assert_array_equal(found.which, each)
    relations.T_a_b[1] += 12 * SIGMA * np.sqrt(n)
    assert Team(relations, LoopTest()).readings(everything) == []


def test_what_chance_would_close_is_no_loop() -> None:
    """Alignments that are off by as much as they reach close any loop."""
    rng = np.random.default_rng(5)
    true, robots = poses(3, rng), np.array([[0, 1], [1, 2], [0, 2]])
    relations = measured(robots, between(true[robots[:, 0]], true[robots[:, 1]]), 3, rng)
    everything = np.ones(3, dtype=bool)
    assert len(Team(relations, LoopTest()).readings(everything)) == 1
    relations.covariance[:] = np.diag([5.0, 5.0, 1.0]) ** 2
    assert Team(relations, LoopTest()).readings(everything) == []


def test_the_gate_keeps_true_loops_with_its_probability() -> None:
    """The error of a loop has three degrees of freedom: two coordinates and an angle."""
    for probability in (0.9, 0.999):
        assert LoopTest(probability).gate == pytest.approx(chi2.ppf(probability, 3))
