"""Selection of consistent alignments of a team, and poses of the connected robots.

Alignments are the edges of a pose graph. A loop of edges is closed if their composition agrees with
the identity. Starting from one edge, a consistent set grows loop by loop: a path of further edges
leaves the robots with a pose and returns to them in agreement with the poses. A loop counts if few
loops would be closed by chance, as for a single alignment (`verification.false_alarms`).

If two consistent sets contradict each other, at most one of them is true. PCM (Mangelson et al.
2018) uses the largest set only. One cause can make several false alignments agree with each other,
so a contradiction by a smaller set counts here, too.

An ambiguous alignment has several alternatives. If accepted alignments connect the same two robots
by another path, the alternative that closes the loop is selected, provided that no other does.
Loops that consist of alternatives are not used: a repeated room makes false alternatives agree.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated

import numpy as np

from mapfusion.fusion.pose_graph import AlignmentEdges, Motions, Placement, optimize_poses
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.parameters import Probability, Range, require_in_range

# Largest number of paths that are extended at the same time, which bounds the work.
_MAX_PATHS = 400


@dataclass(frozen=True)
class LoopTest:
    """Test if a loop of alignments is closed.

    Attributes:
        gate_probability: probability that a loop of true alignments passes (chi-square, 3 degrees
            of freedom).
        false_alarms: expected number of loops of each length in a team that chance closes.
    """

    gate_probability: Probability = 0.999
    false_alarms: Annotated[float, Range(1e-12, 1, "loops")] = 0.1

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis distance."""
        return chi_square_bound(self.gate_probability, 3)

    def chance(self, S: Float, max_distance_m: float) -> Float:
        """Return the probability that a random motion is within a gate, shape (n,).

        Args:
            S: covariances of the gates, shape (n, 3, 3).
            max_distance_m: radius of the disc of the random translations; angles are uniform.
        """
        gate_volume = 4 / 3 * np.pi * self.gate**1.5 * np.sqrt(np.linalg.det(S))
        volume = np.pi * max_distance_m**2 * 2 * np.pi
        return np.minimum(gate_volume / volume, 1.0)


@dataclass(frozen=True)
class ConsistentSet:
    """Consistent edges and the poses of their robots.

    Attributes:
        rows: rows of the edges, ascending, shape (n,).
        placement: poses of the robots.
    """

    rows: np.ndarray
    placement: Placement

    @property
    def robots(self) -> np.ndarray:
        """Robots with a pose, ascending."""
        return np.flatnonzero(self.placement.row >= 0)


@dataclass(frozen=True)
class _Paths:
    """Paths from robots with a pose through robots without one.

    Attributes:
        steps: rows of directed edges, shape (n, L).
        last: last robot of each path, shape (n,).
        visited: true for visited robots, shape (n, N).
        motions: motion from the first robot to the last.
    """

    steps: np.ndarray
    last: np.ndarray
    visited: np.ndarray
    motions: Motions

    def __getitem__(self, rows: np.ndarray) -> "_Paths":
        return _Paths(self.steps[rows], self.last[rows], self.visited[rows], self.motions[rows])


class LoopSearch:
    """Search for closed loops of edges, in both directions of each edge."""

    def __init__(self, edges: AlignmentEdges, test: LoopTest) -> None:
        self.edges, self.test = edges, test
        self._max_distance_m = edges.max_distance_m()
        forward = Motions(edges.T_a_b, edges.covariance)
        backward = forward.inverse()
        self._from = np.concatenate([edges.robots[:, 0], edges.robots[:, 1]])
        self._to = np.concatenate([edges.robots[:, 1], edges.robots[:, 0]])
        self._motions = Motions(
            np.concatenate([forward.T, backward.T]),
            np.concatenate([forward.covariance, backward.covariance]),
        )

    def consistent_sets(self, allowed: np.ndarray) -> list[ConsistentSet]:
        """Return consistent sets of the `allowed` (E,) edges, largest first.

        Each closed loop of allowed edges is part of at least one set.
        """
        if np.count_nonzero(allowed) < 2:
            return []
        # closed loops, shortest first, and then by their distance
        distance_of: dict[tuple[int, ...], float] = {}
        for seed in np.flatnonzero(allowed):
            placement = optimize_poses(self.edges, np.array([seed]))
            for loops in self._closed_loops(placement, allowed):
                for loop, distance in zip(*loops, strict=True):
                    distance_of.setdefault(tuple(np.union1d(seed, loop).tolist()), distance)
        sets: list[ConsistentSet] = []
        for loop in sorted(distance_of, key=lambda loop: (len(loop), distance_of[loop])):
            if not any(np.isin(loop, edge_set.rows).all() for edge_set in sets):
                sets.append(self._grow(np.array(loop), allowed))
        return sorted(sets, key=lambda edge_set: -len(edge_set.rows))

    def consistent_rows(self, placement: Placement, among: np.ndarray) -> np.ndarray:
        """Return the rows of `among` (E,) that agree with the placement."""
        edges = self.edges
        rows = np.flatnonzero(among & placement.contains(edges.robots).all(axis=1))
        distance, _ = placement.squared_distances(
            edges.robots[rows], Motions(edges.T_a_b, edges.covariance)[rows]
        )
        return rows[distance <= self.test.gate]

    def _grow(self, rows: np.ndarray, allowed: np.ndarray) -> ConsistentSet:
        """Add closed loops to a set of consistent edges until there is none."""
        while True:
            placement = optimize_poses(self.edges, rows)
            loops = next(self._closed_loops(placement, allowed), None)
            if loops is None:
                return ConsistentSet(rows, placement)
            # the loop whose first step is part of most loops, and of these the best closed
            steps, distance = loops
            n_confirming = np.bincount(steps[:, 0])[steps[:, 0]]
            best = np.lexsort([distance, -n_confirming])[0]
            rows = np.union1d(rows, steps[best])
            rows = np.union1d(rows, self.consistent_rows(optimize_poses(self.edges, rows), allowed))

    def _closed_loops(
        self, placement: Placement, allowed: np.ndarray
    ) -> Iterator[tuple[np.ndarray, Float]]:
        """Yield significant closed loops by length, until there are too many paths.

        Yields:
            Rows of the edges of n loops in their order, shape (n, L), and the squared Mahalanobis
            distances of the loops from the identity, shape (n,).
        """
        n = len(self.edges)
        usable = np.concatenate([allowed, allowed])
        leaves = placement.contains(self._from) & ~placement.contains(self._to)
        steps = np.flatnonzero(usable & leaves)
        visited = np.zeros((len(steps), self.edges.n_robots), dtype=bool)
        visited[np.arange(len(steps)), self._from[steps]] = True
        visited[np.arange(len(steps)), self._to[steps]] = True
        paths = _Paths(steps[:, None], self._to[steps], visited, self._motions[steps])
        while 0 < len(paths.last) <= _MAX_PATHS:
            # extend each path by every edge to a robot that it has not visited
            possible = (paths.last[:, None] == self._from) & usable & ~paths.visited[:, self._to]
            path, step = np.nonzero(possible)
            visited = paths.visited[path]
            visited[np.arange(len(path)), self._to[step]] = True
            steps = np.column_stack([paths.steps[path], step])
            motions = paths.motions[path].compose_independent(self._motions[step])
            paths = _Paths(steps, self._to[step], visited, motions)
            returned = placement.contains(paths.last)
            closed, paths = paths[returned], paths[~returned]
            first = closed.steps[:, 0]
            ends = np.stack([self._from[first], closed.last], axis=1)
            distance, S = placement.squared_distances(ends, closed.motions)
            # each loop is found in both directions and can start with any edge
            n_tests = allowed.sum() * len(first) / 2
            by_chance = n_tests * self.test.chance(S, self._max_distance_m)
            true = (distance <= self.test.gate) & (by_chance <= self.test.false_alarms)
            if true.any():
                yield closed.steps[true] % n, distance[true]


def resolve_alternatives(
    edges: AlignmentEdges,
    is_kept: np.ndarray,
    component: np.ndarray,
    alternatives: AlignmentEdges,
    test: LoopTest,
) -> np.ndarray:
    """Return the rows (n,) of alternatives that accepted alignments confirm alone.

    Args:
        edges: accepted alignments.
        is_kept: true for those that are used, shape (E,).
        component: connected component of each robot, shape (N,).
        alternatives: alternatives of ambiguous alignments; those of the same two robots exclude
            each other.
        test: test of closed loops.
    """
    low, high = np.sort(alternatives.robots, axis=1).T
    together = np.flatnonzero(component[low] == component[high])
    distance, by_chance = np.full(len(alternatives), np.inf), np.ones(len(alternatives))
    for name in np.unique(component[low[together]]):
        inside = is_kept & (component[edges.robots] == name).all(axis=1)
        placement = optimize_poses(edges, np.flatnonzero(inside))
        rows = together[component[low[together]] == name]
        motions = Motions(alternatives.T_a_b, alternatives.covariance)[rows]
        distance[rows], S = placement.squared_distances(alternatives.robots[rows], motions)
        by_chance[rows] = test.chance(S, max(edges.max_distance_m(), alternatives.max_distance_m()))
    closes = distance <= test.gate
    resolved = []
    for pair in np.unique(np.stack([low, high], axis=1)[together], axis=0):
        rivals = np.flatnonzero((low == pair[0]) & (high == pair[1]))
        closing = rivals[closes[rivals]]
        # every alternative of every pair of robots is a test
        if len(closing) == 1 and len(together) * by_chance[closing[0]] <= test.false_alarms:
            resolved.append(closing[0])
    return np.array(resolved, dtype=np.int64)


class Unconfirmed(StrEnum):
    """Treatment of alignments that no loop confirms."""

    KEEP = "keep"  # used if nothing contradicts them; of contradictory sets the larger one is used
    DROP = "drop"  # not used; sets with a contradiction are not used, either


class EdgeStatus(StrEnum):
    """Status of an alignment given the other alignments of the team."""

    CONFIRMED = "confirmed"  # part of a closed loop
    BRIDGE = "bridge"  # the only connection: neither confirmed nor contradicted
    CONTRADICTED = "contradicted"  # inconsistent with the poses by the other alignments
    AMBIGUOUS = "ambiguous"  # part of one of several sets that contradict each other
    UNCONFIRMED = "unconfirmed"  # not confirmed although confirmation is required
    REFUSED = "refused"  # rejected by itself, and not compared with others


@dataclass(frozen=True)
class TeamParameters:
    """Parameters of the selection of consistent alignments.

    Attributes:
        unconfirmed: treatment of alignments that no loop confirms.
        loop: test of closed loops.
    """

    unconfirmed: Unconfirmed = Unconfirmed.KEEP
    loop: LoopTest = field(default_factory=LoopTest)

    def __post_init__(self) -> None:
        object.__setattr__(self, "unconfirmed", Unconfirmed(self.unconfirmed))


@dataclass(frozen=True)
class TeamGraph:
    """Poses of N robots by consistent alignments.

    Attributes:
        component: number of each robot's connected component, shape (N,). The largest component is
            0; of equally large ones the one with the first robot comes first.
        T_root_robot: poses in the frame of the component's root, shape (N, 3).
        covariance: covariances of the poses, shape (N, 3, 3).
        edge_status: `EdgeStatus` of each alignment and, after them, of each alternative; REFUSED
            for alternatives that are not resolved.
    """

    component: np.ndarray
    T_root_robot: Float
    covariance: Float
    edge_status: np.ndarray


def team_graph(
    edges: AlignmentEdges,
    parameters: TeamParameters = TeamParameters(),
    rank: np.ndarray | None = None,
    alternatives: AlignmentEdges | None = None,
) -> TeamGraph:
    """Select consistent alignments and compute the poses of the robots.

    The order of robots and alignments affects only the frame, and the choice between equally good
    results.

    Args:
        edges: accepted alignments between the robots' maps.
        parameters: parameters of the selection.
        rank: rank of each robot, shape (N,); the root of a component has the lowest rank. By
            default the root is the first robot.
        alternatives: alternatives of ambiguous alignments, one or more for two robots. At most one
            of them is used, if accepted alignments confirm it alone (`resolve_alternatives`).
    """
    if alternatives is None or not len(alternatives):
        return _graph_of_accepted(edges, parameters, rank)
    connected = _graph_of_accepted(edges, replace(parameters, unconfirmed=Unconfirmed.KEEP), rank)
    is_kept = np.isin(connected.edge_status, [EdgeStatus.CONFIRMED, EdgeStatus.BRIDGE])
    resolved = resolve_alternatives(
        edges, is_kept, connected.component, alternatives, parameters.loop
    )
    graph = _graph_of_accepted(edges.concatenated(alternatives[resolved]), parameters, rank)
    of_alternatives = np.full(len(alternatives), EdgeStatus.REFUSED, dtype=object)
    of_alternatives[resolved] = graph.edge_status[len(edges) :]
    status = np.concatenate([graph.edge_status[: len(edges)], of_alternatives])
    return replace(graph, edge_status=status)


def _graph_of_accepted(
    edges: AlignmentEdges, parameters: TeamParameters, rank: np.ndarray | None
) -> TeamGraph:
    """Return the graph of accepted alignments and resolved alternatives."""
    search = LoopSearch(edges, parameters.loop)
    confirmed, ambiguous = _confirmed_edges(search, parameters.unconfirmed)
    is_kept, is_bridge = confirmed.copy(), np.zeros_like(confirmed)
    if parameters.unconfirmed is Unconfirmed.KEEP:
        # connect separate components by single alignments, most reliable first
        component, free = _components(edges, is_kept), ~confirmed & ~ambiguous
        for row in np.argsort(edges.log10_false_alarms, kind="stable"):
            a, b = component[edges.robots[row]]
            if free[row] and a != b:
                is_bridge[row] = True
                component[component == b] = a
        is_kept |= is_bridge

    component = _components(edges, is_kept)
    rank = np.arange(edges.n_robots) if rank is None else rank
    T, covariance = np.zeros((len(component), 3)), np.zeros((len(component), 3, 3))
    agrees = is_kept.copy()
    for name in np.unique(component):
        inside = is_kept & (component[edges.robots] == name).all(axis=1)
        if not inside.any():
            continue
        robots = np.flatnonzero(component == name)
        root = int(robots[np.argmin(rank[robots])])
        placement = optimize_poses(edges, np.flatnonzero(inside), root)
        row = placement.row[robots]
        T[robots] = placement.T_root_robot[row]
        covariance[robots] = placement.covariance[row, row]
        agrees[search.consistent_rows(placement, np.ones_like(is_kept))] = True

    status = np.full(len(edges), EdgeStatus.UNCONFIRMED, dtype=object)
    together = component[edges.robots[:, 0]] == component[edges.robots[:, 1]]
    status[ambiguous] = EdgeStatus.AMBIGUOUS
    status[together & ~agrees] = EdgeStatus.CONTRADICTED
    status[is_bridge] = EdgeStatus.BRIDGE
    status[confirmed] = EdgeStatus.CONFIRMED
    return TeamGraph(component, T, covariance, status)


def _confirmed_edges(search: LoopSearch, unconfirmed: Unconfirmed) -> tuple[np.ndarray, np.ndarray]:
    """Return masks (E,) of edges that loops confirm, and of edges in contradictory sets.

    A rival divides the robots of a set into groups whose relative poses agree, and the rest. Edges
    within a group are confirmed if loops of such edges confirm them.
    """
    edges = search.edges
    confirmed, ambiguous = np.zeros(len(edges), dtype=bool), np.zeros(len(edges), dtype=bool)
    remaining: list[ConsistentSet] = []
    for edge_set in search.consistent_sets(np.ones(len(edges), dtype=bool)):  # largest first
        larger = (other for other in remaining if len(other.rows) > len(edge_set.rows))
        if unconfirmed is Unconfirmed.DROP or not any(
            _contradict(search, edge_set, other) for other in larger
        ):
            remaining.append(edge_set)
    for edge_set in remaining:
        others = (other for other in remaining if other is not edge_set)
        rivals = [other for other in others if _contradict(search, edge_set, other)]
        undisputed = edge_set.rows
        if rivals:
            group = np.zeros((edges.n_robots, len(rivals)), dtype=np.int64)
            for k, rival in enumerate(rivals):
                shared_robots = np.intersect1d(edge_set.robots, rival.robots)
                same = _same_relative_poses(search, edge_set, rival, shared_robots)
                group[shared_robots, k] = 1 + np.argmax(same, axis=1)
            a, b = edges.robots.T
            inside = np.zeros(len(edges), dtype=bool)
            inside[edge_set.rows] = True
            inside &= np.all(group[a] == group[b], axis=1)
            parts = [part.rows for part in search.consistent_sets(inside)]
            undisputed = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *parts]))
        confirmed[undisputed] = True
        ambiguous[np.setdiff1d(edge_set.rows, undisputed)] = True
    return confirmed, ambiguous & ~confirmed


def _contradict(search: LoopSearch, first: ConsistentSet, second: ConsistentSet) -> bool:
    """Return True if the relative pose of two robots differs between two sets."""
    shared_robots = np.intersect1d(first.robots, second.robots)
    return not _same_relative_poses(search, first, second, shared_robots).all()


def _same_relative_poses(
    search: LoopSearch, first: ConsistentSet, second: ConsistentSet, shared_robots: np.ndarray
) -> np.ndarray:
    """Return True for pairs (n, n) of shared robots (n,) with equal relative poses in both sets."""
    i, j = np.triu_indices(len(shared_robots), 1)
    pairs = np.stack([shared_robots[i], shared_robots[j]], axis=1)
    motions = second.placement.relative(pairs)
    distance, _ = first.placement.squared_distances(pairs, motions)
    same = np.eye(len(shared_robots), dtype=bool)
    same[i, j] = same[j, i] = distance <= search.test.gate
    return same


def _components(edges: AlignmentEdges, is_kept: np.ndarray) -> np.ndarray:
    """Return the component of each robot, shape (N,), ordered by size and then by first robot."""
    label = np.arange(edges.n_robots)
    for a, b in edges.robots[is_kept]:
        low, high = sorted((label[a], label[b]))
        label[label == high] = low
    first, inverse, count = np.unique(label, return_inverse=True, return_counts=True)
    position = np.empty(len(first), dtype=np.int64)
    position[np.lexsort([first, -count])] = np.arange(len(first))
    return position[inverse]
