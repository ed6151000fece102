"""Consistent alignments of a team: edges confirmed or refused by loops, and connected components.

A reading is grown from one alignment, loop by loop: a path of further alignments that leaves the
robots placed so far and comes back to them where the placement says. Each loop is a coincidence, or
the alignments in it are true together. How many loops chance would close is told before one is
believed, as for a single alignment (`align/acceptance.py`).

An alignment that is ambiguous by its own verdict fits, and so may its rivals. Where alignments that
were accepted connect the same two robots another way round, they say where the one lies to the
other: of the alternatives the one that closes this loop is right, if no other closes it as well and
chance would not. Loops of alternatives alone tell nothing: what made one of them fit, a room that
is there twice, makes false ones agree.

Alignments that confirm each other around loops make a reading (`consistent_sets.py`). Where two readings
contradict each other, at most one is true. Kim, Mangelson et al. look for the largest set alone
(PCM, 2018); whatever made one false alignment may have made others that agree with it, so here a
smaller set counts as a warning, too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated

import numpy as np

from mapfusion.fusion.pose_graph import AlignmentEdges, Motions, Placement, optimize_poses
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.parameters import Probability, Range, require_in_range

# Paths out of the placed robots that are followed at one time, which bounds the work: of ten robots
# that all met, those over two more robots from one alignment are 112, those over three 672.
_MOST_PATHS = 400


@dataclass(frozen=True)
class LoopTest:
    """When a loop of alignments counts as closed.

    Attributes:
        gate_probability: of closing a loop of true alignments (chi-square, 3 degrees of freedom).
        false_alarms: loops that chance may be expected to close in a team, of each length.
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
        """(n,) that a motion drawn within reach, turned by anything, lies in gates S (n, 3, 3)."""
        inside = 4 / 3 * np.pi * self.gate**1.5 * np.sqrt(np.linalg.det(S))
        anywhere = np.pi * max_distance_m**2 * 2 * np.pi
        return np.minimum(inside / anywhere, 1.0)


@dataclass(frozen=True)
class ConsistentSet:
    """Alignments that agree, and where they put their robots."""

    rows: np.ndarray  # (n,) rows of the relations, ascending
    placement: Placement

    @property
    def robots(self) -> np.ndarray:
        """Those it places, ascending."""
        return np.flatnonzero(self.placement.row >= 0)


@dataclass(frozen=True)
class _Paths:
    """Paths from placed robots through robots that are not placed.

    Attributes:
        steps: (n, L) rows of directed alignments.
        last: (n,) robot they have come to.
        visited: (n, N) bool.
        motions: from the first robot to the last.
    """

    steps: np.ndarray
    last: np.ndarray
    visited: np.ndarray
    motions: Motions


@dataclass(frozen=True)
class _Loops:
    """Loops of one length: alignments (n, L) in their order, and squared distances (n,)."""

    steps: np.ndarray
    distance: Float

    def best(self) -> np.ndarray:
        """The one whose way out most others confirm, of these the best closed."""
        confirmed = np.bincount(self.steps[:, 0])[self.steps[:, 0]]
        return self.steps[np.lexsort([self.distance, -confirmed])[0]]


class LoopSearch:
    """The alignments of a team, in both directions."""

    def __init__(self, edges: AlignmentEdges, test: LoopTest) -> None:
        self.edges, self.test = edges, test
        self._reach_m = edges.max_distance_m()
        there = Motions(edges.T_a_b, edges.covariance)
        back = there.inverse()
        self._from = np.concatenate([edges.robots[:, 0], edges.robots[:, 1]])
        self._to = np.concatenate([edges.robots[:, 1], edges.robots[:, 0]])
        self._motions = Motions(
            np.concatenate([there.T, back.T]), np.concatenate([there.covariance, back.covariance])
        )

    def consistent_sets(self, allowed: np.ndarray) -> list[ConsistentSet]:
        """Readings of the `allowed` (E,) alignments, those of most alignments first.

        Each loop of them is in one reading at least.
        """
        found: list[ConsistentSet] = []
        for loop in self._all_loops(allowed):
            if not any(np.isin(loop, edge_set.rows).all() for edge_set in found):
                found.append(self._grown(loop, allowed))
        return sorted(found, key=lambda edge_set: -len(edge_set.rows))

    def consistent_rows(self, placement: Placement, among: np.ndarray) -> np.ndarray:
        """Rows of `among` (E,) between placed robots that agree with the placement."""
        edges = self.edges
        rows = np.flatnonzero(among & placement.contains(edges.robots).all(axis=1))
        distance, _ = placement.squared_distances(
            edges.robots[rows], Motions(edges.T_a_b, edges.covariance)[rows]
        )
        return rows[distance <= self.test.gate]

    def _all_loops(self, allowed: np.ndarray) -> list[np.ndarray]:
        """Alignments (rows) of each loop, the shortest first, and of these the best closed."""
        if np.count_nonzero(allowed) < 2:  # one alone closes none
            return []
        found: dict[tuple[int, ...], float] = {}
        for seed in np.flatnonzero(allowed):
            placement = optimize_poses(self.edges, np.array([seed]))
            for loops in self._closed_loops(placement, allowed):
                for loop, distance in zip(loops.steps, loops.distance, strict=True):
                    found.setdefault(tuple(np.union1d(seed, loop).tolist()), distance)
        ordered = sorted(found, key=lambda loop: (len(loop), found[loop]))
        return [np.array(loop) for loop in ordered]

    def _grown(self, rows: np.ndarray, allowed: np.ndarray) -> ConsistentSet:
        """All that loops can add to some alignments that agree."""
        while True:
            placement = optimize_poses(self.edges, rows)
            loops = next(self._closed_loops(placement, allowed), None)
            if loops is None:
                return ConsistentSet(rows, placement)
            rows = np.union1d(rows, loops.best())
            inside = self.consistent_rows(optimize_poses(self.edges, rows), allowed)
            rows = np.union1d(rows, inside)

    def _closed_loops(self, placement: Placement, allowed: np.ndarray) -> Iterator[_Loops]:
        """Those that chance would not close, the shortest first, until there are too many."""
        n = len(self.edges)
        usable = np.concatenate([allowed, allowed])
        paths = self._first_steps(placement, usable)
        while 0 < len(paths.last) <= _MOST_PATHS:
            paths = self._extended(paths, usable)
            home = placement.contains(paths.last)
            closed, paths = _rows(paths, home), _rows(paths, ~home)
            first = closed.steps[:, 0]
            ends = np.stack([self._from[first], closed.last], axis=1)
            distance, S = placement.squared_distances(ends, closed.motions)
            # each is found in both directions, and any alignment may have been where one began
            n_tests = allowed.sum() * len(first) / 2
            by_chance = n_tests * self.test.chance(S, self._reach_m)
            true = (distance <= self.test.gate) & (by_chance <= self.test.false_alarms)
            if true.any():
                yield _Loops(closed.steps[true] % n, distance[true])

    def _first_steps(self, placement: Placement, usable: np.ndarray) -> _Paths:
        steps = np.flatnonzero(
            usable & placement.contains(self._from) & ~placement.contains(self._to)
        )
        visited = np.zeros((len(steps), self.edges.n_robots), dtype=bool)
        visited[np.arange(len(steps)), self._from[steps]] = True
        visited[np.arange(len(steps)), self._to[steps]] = True
        return _Paths(steps[:, None], self._to[steps], visited, self._motions[steps])

    def _extended(self, paths: _Paths, usable: np.ndarray) -> _Paths:
        """By each alignment that leads to a robot not visited yet, home or farther out."""
        goes_on = (paths.last[:, None] == self._from) & usable & ~paths.visited[:, self._to]
        path, step = np.nonzero(goes_on)
        visited = paths.visited[path]
        visited[np.arange(len(path)), self._to[step]] = True
        steps = np.column_stack([paths.steps[path], step])
        motions = paths.motions[path].compose_independent(self._motions[step])
        return _Paths(steps, self._to[step], visited, motions)


def _rows(paths: _Paths, rows: np.ndarray) -> _Paths:
    return _Paths(paths.steps[rows], paths.last[rows], paths.visited[rows], paths.motions[rows])


def resolve_alternatives(
    edges: AlignmentEdges,
    kept: np.ndarray,
    component: np.ndarray,
    ambiguous_edges: AlignmentEdges,
    test: LoopTest,
) -> np.ndarray:
    """Rows (n,) of the alternatives that accepted alignments tell from their rivals.

    Args:
        edges: that were accepted.
        kept: (E,) bool, those that are believed.
        component: (N,) of the robots, as they connect them.
        ambiguous_edges: the alternatives; those of the same two robots are each other's rivals.
        test: when a loop counts as closed.
    """
    low, high = np.sort(ambiguous_edges.robots, axis=1).T
    together = np.flatnonzero(component[low] == component[high])
    distance, by_chance = np.full(len(ambiguous_edges), np.inf), np.ones(len(ambiguous_edges))
    for name in np.unique(component[low[together]]):
        inside = kept & (component[edges.robots] == name).all(axis=1)
        placement = optimize_poses(edges, np.flatnonzero(inside))
        rows = together[component[low[together]] == name]
        motions = Motions(ambiguous_edges.T_a_b, ambiguous_edges.covariance)[rows]
        distance[rows], S = placement.squared_distances(ambiguous_edges.robots[rows], motions)
        by_chance[rows] = test.chance(
            S, max(edges.max_distance_m(), ambiguous_edges.max_distance_m())
        )
    closes = distance <= test.gate
    told = []
    for pair in np.unique(np.stack([low, high], axis=1)[together], axis=0):
        rivals = np.flatnonzero((low == pair[0]) & (high == pair[1]))
        closing = rivals[closes[rivals]]
        # any alternative of any two robots may be the one that closes a loop by chance
        if len(closing) == 1 and len(together) * by_chance[closing[0]] <= test.false_alarms:
            told.append(closing[0])
    return np.array(told, dtype=np.int64)


class Unconfirmed(StrEnum):
    """What becomes of alignments that no loop confirms."""

    KEEP = "keep"  # the pair's own verdict vouches for them; of two readings the larger one counts
    DROP = "drop"  # nothing counts that no loop confirms, or that another loop speaks against


class EdgeStatus(StrEnum):
    """What the others say of an alignment."""

    CONFIRMED = "confirmed"  # a loop of others agrees
    BRIDGE = "bridge"  # nothing confirms it and nothing speaks against it
    CONTRADICTED = "contradicted"  # the team's other alignments say something else
    AMBIGUOUS = "ambiguous"  # of two readings, either of which has loops of its own
    UNCONFIRMED = "unconfirmed"  # nothing confirms it, and that is asked for
    REFUSED = "refused"  # by its own verdict: the others were not asked


@dataclass(frozen=True)
class TeamParameters:
    """How a team's alignments are judged together.

    Attributes:
        unconfirmed: what becomes of those that no loop confirms.
        loop: when a loop counts as closed.
    """

    unconfirmed: Unconfirmed = Unconfirmed.KEEP
    loop: LoopTest = field(default_factory=LoopTest)

    def __post_init__(self) -> None:
        object.__setattr__(self, "unconfirmed", Unconfirmed(self.unconfirmed))


@dataclass(frozen=True)
class TeamGraph:
    """A team's robots, placed.

    Attributes:
        component: (N,) 0 for the robots placed together in the largest number, 1, ...; those that
            nothing connects have one of their own. Of equal ones the one with the first robot is
            first.
        T_root_robot: (N, 3) in the frame of the component's root.
        covariance: (N, 3, 3) of these.
        place: (E,) what is said of each alignment, a `Place`; behind them of each alternative,
            which is REFUSED where nothing tells it from its rivals.
    """

    component: np.ndarray
    T_root_robot: Float
    covariance: Float
    place: np.ndarray


def team_graph(
    edges: AlignmentEdges,
    parameters: TeamParameters = TeamParameters(),
    rank: np.ndarray | None = None,
    alternatives: AlignmentEdges | None = None,
) -> TeamGraph:
    """Find the alignments that are true together, and place the robots by them.

    The order of robots and of alignments makes no difference but for the frame, and where two
    answers are equally good.

    Args:
        edges: between the robots' maps.
        parameters: which of them are believed.
        rank: (N,) of the robots; a component's root is the one of least rank, by default its first.
        alternatives: motions that robots' maps leave open, one or more for two robots. At most one
            of these is believed, and only where the alignments tell it (`alternatives.py`).
    """
    if alternatives is None or not len(alternatives):
        return _judged(edges, parameters, rank)
    connected = _judged(edges, replace(parameters, unconfirmed=Unconfirmed.KEEP), rank)
    kept = np.isin(connected.place, [EdgeStatus.CONFIRMED, EdgeStatus.BRIDGE])
    told = resolve_alternatives(edges, kept, connected.component, alternatives, parameters.loop)
    graph = _judged(edges.concatenated(alternatives[told]), parameters, rank)
    of_alternatives = np.full(len(alternatives), EdgeStatus.REFUSED, dtype=object)
    of_alternatives[told] = graph.place[len(edges) :]
    place = np.concatenate([graph.place[: len(edges)], of_alternatives])
    return replace(graph, place=place)


def _judged(
    edges: AlignmentEdges, parameters: TeamParameters, rank: np.ndarray | None
) -> TeamGraph:
    """The graph of alignments that were accepted, or told apart."""
    team = LoopSearch(edges, parameters.loop)
    everything = np.ones(len(edges), dtype=bool)
    confirmed, ambiguous = _without_rivals(
        team, team.consistent_sets(everything), parameters.unconfirmed
    )
    kept, bridge = confirmed.copy(), np.zeros_like(confirmed)
    if parameters.unconfirmed is Unconfirmed.KEEP:
        bridge = _bridges(team, kept, ~confirmed & ~ambiguous)
        kept |= bridge
    component = _components(edges, kept)
    rank = np.arange(edges.n_robots) if rank is None else rank
    T, covariance, agrees = _solved(team, component, kept, rank)
    place = np.full(len(edges), EdgeStatus.UNCONFIRMED, dtype=object)
    together = component[edges.robots[:, 0]] == component[edges.robots[:, 1]]
    place[ambiguous] = EdgeStatus.AMBIGUOUS
    place[together & ~agrees] = EdgeStatus.CONTRADICTED
    place[bridge] = EdgeStatus.BRIDGE
    place[confirmed] = EdgeStatus.CONFIRMED
    return TeamGraph(component, T, covariance, place)


def _without_rivals(
    team: LoopSearch, consistent_sets: list[ConsistentSet], unconfirmed: Unconfirmed
) -> tuple[np.ndarray, np.ndarray]:
    """Masks (E,) of alignments in readings that stand, and of those that rivals leave open."""
    E = len(team.edges)
    kept, ambiguous = np.zeros(E, dtype=bool), np.zeros(E, dtype=bool)
    standing: list[ConsistentSet] = []
    for edge_set in consistent_sets:  # the larger ones first
        larger = (other for other in standing if len(other.rows) > len(edge_set.rows))
        if unconfirmed is Unconfirmed.DROP or not any(
            _contradict(team, edge_set, other) for other in larger
        ):
            standing.append(edge_set)
    for edge_set in standing:
        others = (other for other in standing if other is not edge_set)
        rivals = [other for other in others if _contradict(team, edge_set, other)]
        stands = _undisputed(team, edge_set, rivals)
        kept[stands] = True
        ambiguous[np.setdiff1d(edge_set.rows, stands)] = True
    return kept, ambiguous & ~kept


def _contradict(team: LoopSearch, one: ConsistentSet, other: ConsistentSet) -> bool:
    """Whether two readings put two robots differently."""
    shared = np.intersect1d(one.robots, other.robots)
    return not _alike(team, one, other, shared).all()


def _alike(
    team: LoopSearch, one: ConsistentSet, other: ConsistentSet, shared: np.ndarray
) -> np.ndarray:
    """(n, n) bool, whether both put the shared robots (n,) alike, two by two."""
    i, j = np.triu_indices(len(shared), 1)
    pairs = np.stack([shared[i], shared[j]], axis=1)
    motions = other.placement.relative(pairs)
    distance, _ = one.placement.squared_distances(pairs, motions)
    alike = np.eye(len(shared), dtype=bool)
    alike[i, j] = alike[j, i] = distance <= team.test.gate
    return alike


def _undisputed(
    team: LoopSearch, edge_set: ConsistentSet, rivals: list[ConsistentSet]
) -> np.ndarray:
    """Its alignments (rows) that no rival touches and that loops of such alone confirm.

    A rival splits a reading's robots into groups that both put alike, and the rest.
    """
    robots, edges = edge_set.robots, team.edges
    group = np.zeros((edges.n_robots, len(rivals)), dtype=np.int64)
    for k, rival in enumerate(rivals):
        shared = np.intersect1d(robots, rival.robots)
        alike = _alike(team, edge_set, rival, shared)
        group[shared, k] = 1 + np.argmax(alike, axis=1)
    a, b = edges.robots.T
    inside = np.zeros(len(edges), dtype=bool)
    inside[edge_set.rows] = True
    inside &= np.all(group[a] == group[b], axis=1)
    if not rivals:
        return edge_set.rows
    left = [each.rows for each in team.consistent_sets(inside)]
    return np.unique(np.concatenate([np.empty(0, dtype=np.int64), *left]))


def _bridges(team: LoopSearch, kept: np.ndarray, free: np.ndarray) -> np.ndarray:
    """(E,) those that connect what is not connected yet, the surest first."""
    edges = team.edges
    component = _components(edges, kept)
    bridge = np.zeros_like(kept)
    for row in np.argsort(edges.log10_false_alarms, kind="stable"):
        a, b = component[edges.robots[row]]
        if free[row] and a != b:
            bridge[row] = True
            component[component == b] = a
    return bridge


def _components(edges: AlignmentEdges, kept: np.ndarray) -> np.ndarray:
    """(N,) the component of each robot: those of most robots first, then by their first robot."""
    label = np.arange(edges.n_robots)
    for a, b in edges.robots[kept]:
        low, high = sorted((label[a], label[b]))
        label[label == high] = low
    first, inverse, count = np.unique(label, return_inverse=True, return_counts=True)
    place = np.empty(len(first), dtype=np.int64)
    place[np.lexsort([first, -count])] = np.arange(len(first))
    return place[inverse]


def _solved(
    team: LoopSearch, component: np.ndarray, kept: np.ndarray, rank: np.ndarray
) -> tuple[Float, Float, np.ndarray]:
    """Poses (N, 3) by the kept alignments, covariances (N, 3, 3), and which (E,) agree."""
    edges = team.edges
    T, covariance = np.zeros((len(component), 3)), np.zeros((len(component), 3, 3))
    agrees = kept.copy()
    for name in np.unique(component):
        inside = kept & (component[edges.robots] == name).all(axis=1)
        if not inside.any():
            continue
        robots = np.flatnonzero(component == name)
        root = int(robots[np.argmin(rank[robots])])
        placement = optimize_poses(edges, np.flatnonzero(inside), root)
        row = placement.row[robots]
        T[robots] = placement.T_root_robot[row]
        covariance[robots] = placement.covariance[row, row]
        agrees[team.consistent_rows(placement, np.ones_like(kept))] = True
    return T, covariance, agrees
