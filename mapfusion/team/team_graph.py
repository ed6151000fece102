"""Which robots of a team belong together, and where: all alignments of their maps, judged at once.

Alignments that confirm each other around loops make a reading (`readings.py`). Where two readings
contradict each other, at most one is true. Kim, Mangelson et al. look for the largest set alone
(PCM, 2018); whatever made one false alignment may have made others that agree with it, so here a
smaller set counts as a warning, too.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from mapfusion.se2 import Float
from mapfusion.team.alternatives import told_apart
from mapfusion.team.placement import placed
from mapfusion.team.readings import LoopTest, Reading, Team
from mapfusion.team.relations import Relations


class Unconfirmed(StrEnum):
    """What becomes of alignments that no loop confirms."""

    KEEP = "keep"  # the pair's own verdict vouches for them; of two readings the larger one counts
    DROP = "drop"  # nothing counts that no loop confirms, or that another loop speaks against


class Place(StrEnum):
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
    relations: Relations,
    parameters: TeamParameters = TeamParameters(),
    rank: np.ndarray | None = None,
    alternatives: Relations | None = None,
) -> TeamGraph:
    """Find the alignments that are true together, and place the robots by them.

    The order of robots and of alignments makes no difference but for the frame, and where two
    answers are equally good.

    Args:
        relations: between the robots' maps.
        parameters: which of them are believed.
        rank: (N,) of the robots; a component's root is the one of least rank, by default its first.
        alternatives: motions that robots' maps leave open, one or more for two robots. At most one
            of these is believed, and only where the alignments tell it (`alternatives.py`).
    """
    if alternatives is None or not len(alternatives):
        return _judged(relations, parameters, rank)
    connected = _judged(relations, replace(parameters, unconfirmed=Unconfirmed.KEEP), rank)
    kept = np.isin(connected.place, [Place.CONFIRMED, Place.BRIDGE])
    told = told_apart(relations, kept, connected.component, alternatives, parameters.loop)
    graph = _judged(relations.joined(alternatives[told]), parameters, rank)
    of_alternatives = np.full(len(alternatives), Place.REFUSED, dtype=object)
    of_alternatives[told] = graph.place[len(relations) :]
    place = np.concatenate([graph.place[: len(relations)], of_alternatives])
    return replace(graph, place=place)


def _judged(relations: Relations, parameters: TeamParameters, rank: np.ndarray | None) -> TeamGraph:
    """The graph of alignments that were accepted, or told apart."""
    team = Team(relations, parameters.loop)
    everything = np.ones(len(relations), dtype=bool)
    confirmed, ambiguous = _without_rivals(team, team.readings(everything), parameters.unconfirmed)
    kept, bridge = confirmed.copy(), np.zeros_like(confirmed)
    if parameters.unconfirmed is Unconfirmed.KEEP:
        bridge = _bridges(team, kept, ~confirmed & ~ambiguous)
        kept |= bridge
    component = _components(relations, kept)
    rank = np.arange(relations.n_robots) if rank is None else rank
    T, covariance, agrees = _solved(team, component, kept, rank)
    place = np.full(len(relations), Place.UNCONFIRMED, dtype=object)
    together = component[relations.robots[:, 0]] == component[relations.robots[:, 1]]
    place[ambiguous] = Place.AMBIGUOUS
    place[together & ~agrees] = Place.CONTRADICTED
    place[bridge] = Place.BRIDGE
    place[confirmed] = Place.CONFIRMED
    return TeamGraph(component, T, covariance, place)


def _without_rivals(
    team: Team, readings: list[Reading], unconfirmed: Unconfirmed
) -> tuple[np.ndarray, np.ndarray]:
    """Masks (E,) of alignments in readings that stand, and of those that rivals leave open."""
    E = len(team.relations)
    kept, ambiguous = np.zeros(E, dtype=bool), np.zeros(E, dtype=bool)
    standing: list[Reading] = []
    for reading in readings:  # the larger ones first
        larger = (other for other in standing if len(other.which) > len(reading.which))
        if unconfirmed is Unconfirmed.DROP or not any(
            _contradict(team, reading, other) for other in larger
        ):
            standing.append(reading)
    for reading in standing:
        others = (other for other in standing if other is not reading)
        rivals = [other for other in others if _contradict(team, reading, other)]
        stands = _undisputed(team, reading, rivals)
        kept[stands] = True
        ambiguous[np.setdiff1d(reading.which, stands)] = True
    return kept, ambiguous & ~kept


def _contradict(team: Team, one: Reading, other: Reading) -> bool:
    """Whether two readings put two robots differently."""
    shared = np.intersect1d(one.robots, other.robots)
    return not _alike(team, one, other, shared).all()


def _alike(team: Team, one: Reading, other: Reading, shared: np.ndarray) -> np.ndarray:
    """(n, n) bool, whether both put the shared robots (n,) alike, two by two."""
    i, j = np.triu_indices(len(shared), 1)
    pairs = np.stack([shared[i], shared[j]], axis=1)
    motions = other.placement.relative(pairs)
    distance, _ = one.placement.squared_distances(pairs, motions)
    alike = np.eye(len(shared), dtype=bool)
    alike[i, j] = alike[j, i] = distance <= team.test.gate
    return alike


def _undisputed(team: Team, reading: Reading, rivals: list[Reading]) -> np.ndarray:
    """Its alignments (rows) that no rival touches and that loops of such alone confirm.

    A rival splits a reading's robots into groups that both put alike, and the rest.
    """
    robots, relations = reading.robots, team.relations
    group = np.zeros((relations.n_robots, len(rivals)), dtype=np.int64)
    for k, rival in enumerate(rivals):
        shared = np.intersect1d(robots, rival.robots)
        alike = _alike(team, reading, rival, shared)
        group[shared, k] = 1 + np.argmax(alike, axis=1)
    a, b = relations.robots.T
    inside = np.zeros(len(relations), dtype=bool)
    inside[reading.which] = True
    inside &= np.all(group[a] == group[b], axis=1)
    if not rivals:
        return reading.which
    left = [each.which for each in team.readings(inside)]
    return np.unique(np.concatenate([np.empty(0, dtype=np.int64), *left]))


def _bridges(team: Team, kept: np.ndarray, free: np.ndarray) -> np.ndarray:
    """(E,) those that connect what is not connected yet, the surest first."""
    relations = team.relations
    component = _components(relations, kept)
    bridge = np.zeros_like(kept)
    for row in np.argsort(relations.log10_false_alarms, kind="stable"):
        a, b = component[relations.robots[row]]
        if free[row] and a != b:
            bridge[row] = True
            component[component == b] = a
    return bridge


def _components(relations: Relations, kept: np.ndarray) -> np.ndarray:
    """(N,) the component of each robot: those of most robots first, then by their first robot."""
    label = np.arange(relations.n_robots)
    for a, b in relations.robots[kept]:
        low, high = sorted((label[a], label[b]))
        label[label == high] = low
    first, inverse, count = np.unique(label, return_inverse=True, return_counts=True)
    place = np.empty(len(first), dtype=np.int64)
    place[np.lexsort([first, -count])] = np.arange(len(first))
    return place[inverse]


def _solved(
    team: Team, component: np.ndarray, kept: np.ndarray, rank: np.ndarray
) -> tuple[Float, Float, np.ndarray]:
    """Poses (N, 3) by the kept alignments, covariances (N, 3, 3), and which (E,) agree."""
    relations = team.relations
    T, covariance = np.zeros((len(component), 3)), np.zeros((len(component), 3, 3))
    agrees = kept.copy()
    for name in np.unique(component):
        inside = kept & (component[relations.robots] == name).all(axis=1)
        if not inside.any():
            continue
        robots = np.flatnonzero(component == name)
        root = int(robots[np.argmin(rank[robots])])
        placement = placed(relations, np.flatnonzero(inside), root)
        row = placement.row[robots]
        T[robots] = placement.T_root_robot[row]
        covariance[robots] = placement.covariance[row, row]
        agrees[team.agreeing(placement, np.ones_like(kept))] = True
    return T, covariance, agrees
