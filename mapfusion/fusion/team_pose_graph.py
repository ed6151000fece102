"""Pose graphs of several robots, judged by the consistency of the alignments of a team.

The poses of each robot are estimated from the motions between them alone. A measured motion between
poses of two robots is then an alignment of their frames,

    T_a_b = T_a_i T_i_j T_b_j^-1,

with covariances to first order. The largest set of alignments of two robots that agree with each
other is fused, and `team_graph` selects the consistent ones of the fused alignments. The errors of
alignments are taken to be independent, although alignments of two robots share errors of their
paths.

Public graphs often state the information of every motion as 1. By default the standard deviations
of translations and of rotations are therefore multiplied by factors that are estimated from the
residuals of the robots' own loops (variance components: Foerstner 1979).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mapfusion.exchange import PlanarPoseGraph
from mapfusion.fusion.pose_graph import AlignmentEdges, Motions, Placement, optimize_poses
from mapfusion.fusion.team_graph import EdgeStatus, TeamGraph, TeamParameters, team_graph
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, wrap

MAX_POSES = 2000  # of a robot: their joint covariance is dense
_ROUNDS = 10  # of the variance components; they converge to a percent in three
# Smallest number of the robots' own loops from which the noise is estimated. Its relative error is
# then a fifth.
_MIN_LOOPS = 12


class NoiseFactors(NamedTuple):
    """Factors on the stated standard deviations of translations and rotations."""

    translation: float
    rotation: float


STATED = NoiseFactors(1.0, 1.0)


@dataclass(frozen=True)
class JudgedPoseGraph:
    """Alignments between N robots of a pose graph, and their status.

    Attributes:
        robots: names of the robots.
        n_poses: number of poses of each robot that its own motions connect, shape (N,).
        noise: the factors; None if there are too few loops to estimate them.
        edges: the alignments, one for each motion between robots.
        keys: keys of the two poses of each alignment, shape (E, 2).
        status: `EdgeStatus` of each alignment, shape (E,).
        component: connected component of each robot, shape (N,); the largest is 0.
        T_root_robot: poses of the robots' frames in that of the root of their component, (N, 3).
        squared_distance: squared Mahalanobis distance of each alignment from these poses, without
            their uncertainty, shape (E,); NaN for robots that are not connected.
        n_left_out: number of motions whose poses are not known.
    """

    robots: tuple[str, ...]
    n_poses: np.ndarray
    noise: NoiseFactors | None
    edges: AlignmentEdges
    keys: np.ndarray
    status: np.ndarray
    component: np.ndarray
    T_root_robot: Float
    squared_distance: Float
    n_left_out: int

    @property
    def is_kept(self) -> np.ndarray:
        """True for the alignments that determine the poses, shape (E,)."""
        return np.isin(self.status, [EdgeStatus.CONFIRMED, EdgeStatus.BRIDGE])

    @property
    def nees_per_dof(self) -> float:
        """Sum of squared distances of the kept alignments over their redundancy; 1 is expected."""
        n_components = self.component.max(initial=-1) + 1
        redundancy = np.count_nonzero(self.is_kept) - (len(self.robots) - n_components)
        if redundancy < 1:
            return np.nan
        return float(self.squared_distance[self.is_kept].sum()) / (3 * redundancy)


def judge_pose_graph(
    graph: PlanarPoseGraph,
    parameters: TeamParameters | None = None,
    estimate_noise: bool = True,
) -> JudgedPoseGraph:
    """Judge the motions between the robots of a pose graph.

    Args:
        graph: poses and motions of all robots.
        parameters: parameters of the selection; None for the defaults.
        estimate_noise: estimate the noise of all motions; else it is as stated.

    Raises:
        ValueError: the graph has fewer than two robots, or a robot has more than MAX_POSES poses.
    """
    robots = tuple(sorted(set(graph.robot)))
    if len(robots) < 2:
        raise ValueError(f"a team has two robots or more; the graph has {len(robots)}")
    robot = np.searchsorted(robots, graph.robot)
    own = robot[graph.pairs[:, 0]] == robot[graph.pairs[:, 1]]
    row = np.full(len(robot), -1)  # row of each pose among the connected poses of its robot
    own_graphs = []
    for k, name in enumerate(robots):
        poses, inside = _connected(graph, np.flatnonzero(robot == k), own)
        if len(poses) > MAX_POSES:
            raise ValueError(f"robot {name} has {len(poses)} poses; at most {MAX_POSES} are read")
        row[poses] = np.arange(len(poses))
        zeros = np.zeros(len(inside))
        motions = graph.T_i_j[inside], graph.covariance[inside], zeros
        own_graphs.append(AlignmentEdges(len(poses), row[graph.pairs[inside]], *motions))
    noise = _estimate_noise(own_graphs) if estimate_noise else STATED
    used = noise or STATED
    paths = [_path(_scaled(motions, used)) for motions in own_graphs]
    is_known = ~own & (row[graph.pairs] >= 0).all(axis=1)
    pairs = graph.pairs[is_known]
    T, covariance = np.empty((len(pairs), 3)), np.empty((len(pairs), 3, 3))
    scale = _scale(used)
    for e, (i, j) in enumerate(pairs):
        path_a, path_b = paths[robot[i]], paths[robot[j]]
        at_i, at_j = path_a[row[[i]]], path_b[row[[j]]]
        measured = Motions(graph.T_i_j[is_known][[e]], graph.covariance[is_known][[e]] * scale)
        aligned = at_i.compose_independent(measured).compose_independent(at_j.inverse())
        T[e], covariance[e] = aligned.T[0], aligned.covariance[0]
    edges = AlignmentEdges(len(robots), robot[pairs], T, covariance, np.zeros(len(pairs)))
    team, status = _team_of_fused(edges, parameters or TeamParameters())
    return JudgedPoseGraph(
        robots,
        np.array([motions.n_robots for motions in own_graphs]),
        noise,
        edges,
        np.array(graph.key, dtype=np.int64)[pairs],
        status,
        team.component,
        team.T_root_robot,
        _squared_distances(edges, team),
        graph.n_left_out + int(np.count_nonzero(~own & ~is_known)),
    )


def _team_of_fused(
    edges: AlignmentEdges, parameters: TeamParameters
) -> tuple[TeamGraph, np.ndarray]:
    """Return the team by one fused alignment for two robots, and the status of each alignment."""
    status = np.full(len(edges), EdgeStatus.CONTRADICTED, dtype=object)
    fused: list[tuple[np.ndarray, Float, Float]] = []
    used: list[np.ndarray] = []
    low_high = np.sort(edges.robots, axis=1)
    for two in np.unique(low_high, axis=0):
        rows = np.flatnonzero((low_high == two).all(axis=1))
        agreeing, is_ambiguous = _largest_agreeing(edges, rows, parameters.loop.gate)
        if is_ambiguous:
            status[rows] = EdgeStatus.AMBIGUOUS
            continue
        placement = optimize_poses(edges, agreeing, root=int(two[0]))
        fused.append((two, placement.T_root_robot[1], placement.covariance[1, 1]))
        used.append(agreeing)
    if not fused:
        none = np.empty((0, 2), np.int64), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0)
        return team_graph(AlignmentEdges(edges.n_robots, *none), parameters), status
    robots, T, covariance = (np.array(part) for part in zip(*fused, strict=True))
    # Alignments by more measurements are taken first where no loop decides.
    order = -np.array([float(len(rows)) for rows in used])
    team = team_graph(AlignmentEdges(edges.n_robots, robots, T, covariance, order), parameters)
    for rows, of_fused in zip(used, team.edge_status, strict=True):
        agrees = of_fused is EdgeStatus.BRIDGE and len(rows) > 1
        status[rows] = EdgeStatus.CONFIRMED if agrees else of_fused
    return team, status


def _largest_agreeing(
    edges: AlignmentEdges, rows: np.ndarray, gate: float
) -> tuple[np.ndarray, bool]:
    """Return the largest set of alignments of two robots that agree; True if another is as large.

    A set has the alignments within the gate of one of them.
    """
    a = edges.robots[rows[0], 0]
    forward = Motions(edges.T_a_b[rows], edges.covariance[rows])
    backward, is_forward = forward.inverse(), edges.robots[rows, 0] == a
    T = np.where(is_forward[:, None], forward.T, backward.T)
    S = np.where(is_forward[:, None, None], forward.covariance, backward.covariance)
    e = T[:, None] - T[None]
    e[..., 2] = wrap(e[..., 2])
    squared = np.einsum("ijk,ijk->ij", e, np.linalg.solve(S[:, None] + S, e[..., None])[..., 0])
    agree = squared <= gate
    size = agree.sum(axis=1)
    best = agree[np.lexsort([np.where(agree, squared, 0).sum(axis=1), -size])[0]]
    is_ambiguous = np.any((size == best.sum()) & ~(agree & best).any(axis=1))
    return rows[best], bool(is_ambiguous)


def _connected(
    graph: PlanarPoseGraph, poses: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of a robot that its own motions connect with its first one, and these."""
    inside = np.flatnonzero(own & np.isin(graph.pairs[:, 0], poses))
    i, j = np.searchsorted(poses, graph.pairs[inside]).T
    links = coo_array((np.ones(len(inside)), (i, j)), shape=(len(poses), len(poses)))
    component = connected_components(links, directed=False)[1]
    is_first = component == component[0]
    return poses[is_first], inside[is_first[i]]


def _scale(noise: NoiseFactors) -> Float:
    """Return the factors (3, 3) on covariances."""
    sigma = np.array([noise.translation, noise.translation, noise.rotation])
    return np.outer(sigma, sigma)


def _scaled(motions: AlignmentEdges, noise: NoiseFactors) -> AlignmentEdges:
    parts = motions.covariance * _scale(noise), motions.log10_false_alarms
    return AlignmentEdges(motions.n_robots, motions.robots, motions.T_a_b, *parts)


def _path(motions: AlignmentEdges) -> Motions:
    """Return the poses of a robot in the frame of its first one, with their covariances."""
    placement = _placed(motions)
    n = motions.n_robots
    return Motions(placement.T_root_robot, placement.covariance[np.arange(n), np.arange(n)])


def _placed(motions: AlignmentEdges) -> Placement:
    if motions.n_robots == 1:
        return Placement(np.zeros(1, dtype=np.int64), np.zeros((1, 3)), np.zeros((1, 1, 3, 3)))
    return optimize_poses(motions, np.arange(len(motions)), root=0)


def _estimate_noise(own_graphs: list[AlignmentEdges]) -> NoiseFactors | None:
    """Return the factors by the residuals of all robots; None for too few loops."""
    if sum(len(motions) - motions.n_robots + 1 for motions in own_graphs) < _MIN_LOOPS:
        return None
    noise = STATED
    for _ in range(_ROUNDS):
        squares, redundancy = np.zeros(2), np.zeros(2)
        for motions in own_graphs:
            if len(motions) < motions.n_robots:  # without loops there are no residuals
                continue
            scaled = _scaled(motions, noise)
            fitted = _placed(scaled).relative(motions.robots)
            e = motions.T_a_b - fitted.T
            e[:, 2] = wrap(e[:, 2])
            for k, part in enumerate((slice(0, 2), slice(2, 3))):
                S = scaled.covariance[:, part, part]
                weighted = np.linalg.solve(S, e[:, part, None])[..., 0]
                squares[k] += np.sum(e[:, part] * weighted)
                left = np.linalg.solve(S, S - fitted.covariance[:, part, part])
                redundancy[k] += np.trace(left, axis1=1, axis2=2).sum()
        along, turning = np.sqrt(squares / redundancy).tolist()
        noise = NoiseFactors(noise.translation * along, noise.rotation * turning)
    return noise


def _squared_distances(edges: AlignmentEdges, team: TeamGraph) -> Float:
    """Return the squared distances of the alignments from the poses, shape (E,)."""
    a, b = edges.robots.T
    e = edges.T_a_b - between(team.T_root_robot[a], team.T_root_robot[b])
    e[:, 2] = wrap(e[:, 2])
    squared = np.einsum("ni,ni->n", e, np.linalg.solve(edges.covariance, e[..., None])[..., 0])
    squared[team.component[a] != team.component[b]] = np.nan
    return squared
