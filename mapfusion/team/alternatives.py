"""Which of several motions that two maps leave open is the one that the team's others tell.

An alignment that is ambiguous by its own verdict fits, and so may its rivals. Where alignments that
were accepted connect the same two robots another way round, they say where the one lies to the
other: of the alternatives the one that closes this loop is right, if no other closes it as well and
chance would not. Loops of alternatives alone tell nothing: what made one of them fit, a room that
is there twice, makes false ones agree.
"""

import numpy as np

from mapfusion.team.placement import placed
from mapfusion.team.readings import LoopTest
from mapfusion.team.relations import Motions, Relations


def told_apart(
    relations: Relations, kept: np.ndarray, component: np.ndarray, open_: Relations, test: LoopTest
) -> np.ndarray:
    """Rows (n,) of the alternatives that accepted alignments tell from their rivals.

    Args:
        relations: that were accepted.
        kept: (E,) bool, those that are believed.
        component: (N,) of the robots, as they connect them.
        open_: the alternatives; those of the same two robots are each other's rivals.
        test: when a loop counts as closed.
    """
    low, high = np.sort(open_.robots, axis=1).T
    together = np.flatnonzero(component[low] == component[high])
    distance, by_chance = np.full(len(open_), np.inf), np.ones(len(open_))
    for name in np.unique(component[low[together]]):
        inside = kept & (component[relations.robots] == name).all(axis=1)
        placement = placed(relations, np.flatnonzero(inside))
        rows = together[component[low[together]] == name]
        motions = Motions(open_.T_a_b, open_.covariance)[rows]
        distance[rows], S = placement.squared_distances(open_.robots[rows], motions)
        by_chance[rows] = test.chance(S, max(relations.reach_m(), open_.reach_m()))
    closes = distance <= test.gate
    told = []
    for pair in np.unique(np.stack([low, high], axis=1)[together], axis=0):
        rivals = np.flatnonzero((low == pair[0]) & (high == pair[1]))
        closing = rivals[closes[rivals]]
        # any alternative of any two robots may be the one that closes a loop by chance
        if len(closing) == 1 and len(together) * by_chance[closing[0]] <= test.false_alarms:
            told.append(closing[0])
    return np.array(told, dtype=np.int64)
