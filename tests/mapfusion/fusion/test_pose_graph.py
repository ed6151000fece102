"""Tests of `mapfusion.fusion.pose_graph`."""

import numpy as np
import pytest

from mapfusion.fusion.pose_graph import AlignmentEdges, Motions, optimize_poses
from mapfusion.geometry.se2 import between, compose, inverse, wrap
from tests.mapfusion.fusion.teams import SIGMA, all_pairs, measured, poses


def test_a_chain_is_what_its_motions_say() -> None:
    rng = np.random.default_rng(0)
    robots = np.array([[2, 0], [2, 4], [1, 4]])
    relations = measured(robots, poses(3, rng), 5, rng)
    found = optimize_poses(relations, np.arange(3))
    T_2_0, T_2_4, T_1_4 = relations.T_a_b
    T_0_4 = compose(between(T_2_0, np.zeros(3)), T_2_4)
    np.testing.assert_array_equal(found.row, [0, 1, 2, -1, 3])
    np.testing.assert_allclose(found.T_root_robot[3], T_0_4, atol=1e-12)
    np.testing.assert_allclose(
        found.T_root_robot[1], compose(T_0_4, between(T_1_4, np.zeros(3))), atol=1e-12
    )
    there = Motions(relations.T_a_b, relations.covariance)
    along = there[np.array([0])].inverse().compose_independent(there[np.array([1])])
    np.testing.assert_allclose(found.covariance[3, 3], along.covariance[0], rtol=1e-9)


def test_as_sure_as_many_tries_show() -> None:
    """The squared error over the covariance has the mean of a chi-square variable."""
    n, tries = 5, 200
    rng = np.random.default_rng(1)
    robots, true = all_pairs(n), poses(n, rng)
    T_a_b, squares = between(true[robots[:, 0]], true[robots[:, 1]]), []
    for _ in range(tries):
        found = optimize_poses(measured(robots, T_a_b, n, rng), np.arange(len(robots)))
        off = found.T_root_robot - between(true[0], true)
        off[:, 2] = wrap(off[:, 2])
        joint = found.covariance[1:, 1:].swapaxes(1, 2).reshape(3 * (n - 1), -1)
        squares.append(off[1:].ravel() @ np.linalg.solve(joint, off[1:].ravel()))
        best = np.sqrt(np.diagonal(found.covariance[1, 1]))
        assert np.all(best < SIGMA * [20, 20, 1])  # turns move what is far
    dof = 3 * (n - 1)
    assert np.mean(squares) == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / tries))


def test_a_motion_s_distance_counts_both_covariances() -> None:
    rng = np.random.default_rng(2)
    robots = np.array([[0, 1], [1, 2]])
    relations = measured(robots, poses(2, rng), 3, rng)
    found = optimize_poses(relations, np.arange(2))
    pair = np.array([[0, 2]])
    exact = found.relative(pair)
    # what both poses share, the first step of the chain, is no error between them
    second = found.relative(np.array([[1, 2], [2, 1]])).covariance
    np.testing.assert_allclose(second[0], relations.covariance[1], atol=1e-9)
    back = Motions(relations.T_a_b, relations.covariance).inverse().covariance[1]
    np.testing.assert_allclose(second[1], back, atol=1e-9)
    root = np.linalg.cholesky(exact.covariance[0] + np.diag(SIGMA**2))
    off = Motions(exact.T + root @ [0.0, 3.0, 0.0], np.diag(SIGMA**2)[None])
    distance, S = found.squared_distances(pair, off)
    assert distance[0] == pytest.approx(9.0, rel=1e-6)
    np.testing.assert_allclose(S[0], root @ root.T, rtol=1e-6)


def test_robots_that_nothing_connects() -> None:
    rng = np.random.default_rng(3)
    relations = measured(np.array([[0, 1], [2, 3]]), poses(2, rng), 4, rng)
    with pytest.raises(ValueError, match="do not connect"):
        optimize_poses(relations, np.arange(2))


T = np.array([[1.0, -2.0, 0.7], [-3.0, 0.5, -2.5]])
L = np.array([[3e-3, 0, 0], [1e-3, 2e-3, 0], [5e-4, -4e-4, 1e-3]])
C = np.stack([L @ L.T, 4 * L.T @ L])


def spread(of, *motions: Motions) -> np.ndarray:
    """(3, 3) by central differences, through the covariances' roots."""
    total = np.zeros((3, 3))
    for k, motion in enumerate(motions):
        root, J = np.linalg.cholesky(motion.covariance[0]), np.empty((3, 3))
        for i, step in enumerate(1e-4 * np.eye(3)):
            ends = []
            for sign in (1, -1):
                at = [each.T[0] for each in motions]
                at[k] = at[k] + sign * step
                ends.append(of(*at))
            J[:, i] = (ends[0] - ends[1]) / 2e-4
        total += J @ root @ root.T @ J.T
    return total


def test_the_way_back() -> None:
    motions = Motions(T, C)
    np.testing.assert_allclose(motions.inverse().T, inverse(T))
    np.testing.assert_allclose(motions.inverse().covariance[0], spread(inverse, motions), rtol=1e-6)
    np.testing.assert_allclose(motions.inverse().inverse().covariance, C)


def test_one_after_the_other() -> None:
    first, second = Motions(T[:1], C[:1]), Motions(T[1:], C[1:])
    both = first.compose_independent(second)
    np.testing.assert_allclose(both.T, compose(T[:1], T[1:]))
    np.testing.assert_allclose(both.covariance[0], spread(compose, first, second), rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"robots": np.array([[0, 3]])}, "robots: outside 0 to 2"),
        ({"robots": np.array([[1, 1]])}, "alignment of a map with itself"),
        ({"T_a_b": np.full((1, 3), np.nan)}, "T_a_b"),
        ({"covariance": np.zeros((1, 2, 2))}, "covariance"),
    ],
)
def test_what_is_no_relation_is_refused(change: dict, told: str) -> None:
    good = {"robots": np.array([[0, 1]]), "T_a_b": T[:1], "covariance": C[:1]}
    AlignmentEdges(3, **good, log10_false_alarms=np.zeros(1))
    with pytest.raises(ValueError, match=told):
        AlignmentEdges(3, **(good | change), log10_false_alarms=np.zeros(1))
