"""Teams of robots that all met: some of their alignments are true, the others false."""

from typing import NamedTuple

import numpy as np

from mapfusion.fusion.pose_graph import AlignmentEdges
from mapfusion.fusion.team_graph import TeamGraph
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose, wrap

SIDE_M = 20.0
SIGMA = np.array([0.03, 0.03, 0.005])
# Of a placement in deviations of one alignment; a false one is off by metres.
_OFF = 20.0


class Met(NamedTuple):
    """A team with its truth."""

    T_world_robot: Float  # (N, 3)
    false: np.ndarray  # (E,)
    relations: AlignmentEdges


def poses(n: int, rng: np.random.Generator) -> Float:
    """(n, 3) anywhere."""
    return np.column_stack([rng.uniform(0, SIDE_M, (n, 2)), rng.uniform(-np.pi, np.pi, n)])


def all_pairs(n: int) -> np.ndarray:
    """(E, 2) of every robot with every other."""
    return np.stack(np.triu_indices(n, 1), axis=1)


def measured(robots: np.ndarray, T_a_b: Float, n: int, rng: np.random.Generator) -> AlignmentEdges:
    """Relations with noise, each as sure of itself as any."""
    T = T_a_b + rng.normal(0, SIGMA, T_a_b.shape)
    T[:, 2] = wrap(T[:, 2])
    covariance = np.tile(np.diag(SIGMA**2), (len(robots), 1, 1))
    return AlignmentEdges(n, robots, T, covariance, rng.uniform(-30, -5, len(robots)))


def team(seed: int, kind: str, n: int = 10, n_groups: int = 3) -> Met:
    """Half of the alignments are false.

    Args:
        seed: of everything.
        kind: `independent` false alignments; `groups` that each agree on other poses of all robots;
            or `shifts`, groups that each agree on another place of some of the robots.
        n: robots.
        n_groups: how many groups.
    """
    rng = np.random.default_rng(seed)
    true, robots = poses(n, rng), all_pairs(n)
    a, b = robots.T
    T, false = between(true[a], true[b]), np.zeros(len(robots), dtype=bool)
    false[rng.choice(len(robots), len(robots) // 2, replace=False)] = True
    group = np.where(false, rng.integers(n_groups, size=len(robots)), -1)
    for k in range(n_groups):
        believed, shift = poses(n, rng), poses(1, rng)
        if kind == "shifts":
            some = rng.permutation(n) < rng.integers(1, n)
            believed = np.where(some[:, None], compose(shift, true), true)
        T[group == k] = between(believed[a], believed[b])[group == k]
    if kind == "independent":
        T[false] = poses(int(false.sum()), rng) - [SIDE_M / 2, SIDE_M / 2, 0.0]
    off = between(between(true[a], true[b]), T)
    false = np.any(np.abs(off) > _OFF * SIGMA, axis=1)
    return Met(true, false, measured(robots, T, n, rng))


def falsely_placed(found: TeamGraph, T_world_robot: Float) -> np.ndarray:
    """Robots that lie elsewhere than the first of their component says."""
    first = np.array([np.flatnonzero(found.component == name)[0] for name in found.component])
    true = between(T_world_robot[first], T_world_robot)
    off = between(true, found.T_root_robot)
    return np.flatnonzero(np.any(np.abs(off) > _OFF * SIGMA * [1, 1, 1], axis=1))
