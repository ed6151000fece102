"""Sets of alignments that confirm each other around loops: readings of what a team's robots saw.

A reading is grown from one alignment, loop by loop: a path of further alignments that leaves the
robots placed so far and comes back to them where the placement says. Each loop is a coincidence, or
the alignments in it are true together. How many loops chance would close is told before one is
believed, as for a single alignment (`align/acceptance.py`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.arguments import Probability, Range, require_in_range
from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float
from mapfusion.team.placement import Placement, placed
from mapfusion.team.relations import Motions, Relations

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

    def chance(self, S: Float, reach_m: float) -> Float:
        """(n,) that a motion drawn within reach, turned by anything, lies in gates S (n, 3, 3)."""
        inside = 4 / 3 * np.pi * self.gate**1.5 * np.sqrt(np.linalg.det(S))
        anywhere = np.pi * reach_m**2 * 2 * np.pi
        return np.minimum(inside / anywhere, 1.0)


@dataclass(frozen=True)
class Reading:
    """Alignments that agree, and where they put their robots."""

    which: np.ndarray  # (n,) rows of the relations, ascending
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


class Team:
    """The alignments of a team, in both directions."""

    def __init__(self, relations: Relations, test: LoopTest) -> None:
        self.relations, self.test = relations, test
        self._reach_m = relations.reach_m()
        there = Motions(relations.T_a_b, relations.covariance)
        back = there.inverse()
        self._from = np.concatenate([relations.robots[:, 0], relations.robots[:, 1]])
        self._to = np.concatenate([relations.robots[:, 1], relations.robots[:, 0]])
        self._motions = Motions(
            np.concatenate([there.T, back.T]), np.concatenate([there.covariance, back.covariance])
        )

    def readings(self, allowed: np.ndarray) -> list[Reading]:
        """Readings of the `allowed` (E,) alignments, those of most alignments first.

        Each loop of them is in one reading at least.
        """
        found: list[Reading] = []
        for loop in self._all_loops(allowed):
            if not any(np.isin(loop, reading.which).all() for reading in found):
                found.append(self._grown(loop, allowed))
        return sorted(found, key=lambda reading: -len(reading.which))

    def agreeing(self, placement: Placement, among: np.ndarray) -> np.ndarray:
        """Rows of `among` (E,) between placed robots that agree with the placement."""
        relations = self.relations
        rows = np.flatnonzero(among & placement.holds(relations.robots).all(axis=1))
        distance, _ = placement.squared_distances(
            relations.robots[rows], Motions(relations.T_a_b, relations.covariance)[rows]
        )
        return rows[distance <= self.test.gate]

    def _all_loops(self, allowed: np.ndarray) -> list[np.ndarray]:
        """Alignments (rows) of each loop, the shortest first, and of these the best closed."""
        if np.count_nonzero(allowed) < 2:  # one alone closes none
            return []
        found: dict[tuple[int, ...], float] = {}
        for seed in np.flatnonzero(allowed):
            placement = placed(self.relations, np.array([seed]))
            for loops in self._closed_loops(placement, allowed):
                for loop, distance in zip(loops.steps, loops.distance, strict=True):
                    found.setdefault(tuple(np.union1d(seed, loop).tolist()), distance)
        ordered = sorted(found, key=lambda loop: (len(loop), found[loop]))
        return [np.array(loop) for loop in ordered]

    def _grown(self, which: np.ndarray, allowed: np.ndarray) -> Reading:
        """All that loops can add to some alignments that agree."""
        while True:
            placement = placed(self.relations, which)
            loops = next(self._closed_loops(placement, allowed), None)
            if loops is None:
                return Reading(which, placement)
            which = np.union1d(which, loops.best())
            inside = self.agreeing(placed(self.relations, which), allowed)
            which = np.union1d(which, inside)

    def _closed_loops(self, placement: Placement, allowed: np.ndarray) -> Iterator[_Loops]:
        """Those that chance would not close, the shortest first, until there are too many."""
        n = len(self.relations)
        usable = np.concatenate([allowed, allowed])
        paths = self._first_steps(placement, usable)
        while 0 < len(paths.last) <= _MOST_PATHS:
            paths = self._extended(paths, usable)
            home = placement.holds(paths.last)
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
        steps = np.flatnonzero(usable & placement.holds(self._from) & ~placement.holds(self._to))
        visited = np.zeros((len(steps), self.relations.n_robots), dtype=bool)
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
        motions = paths.motions[path].then(self._motions[step])
        return _Paths(steps, self._to[step], visited, motions)


def _rows(paths: _Paths, which: np.ndarray) -> _Paths:
    return _Paths(paths.steps[which], paths.last[which], paths.visited[which], paths.motions[which])
