"""Maps of many robots: merged as far as alignments connect them, whichever two these are of."""

from dataclasses import replace

import numpy as np

from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import AlignedPair, MergeParameters
from mapfusion.fusion.kalman import KalmanDrift
from mapfusion.fusion.merge import merge
from mapfusion.fusion.team_graph import EdgeStatus, TeamParameters, Unconfirmed
from mapfusion.geometry import se2
from tests.mapfusion.robots_of_one_world import Robots


def fused_by_kalman(maps, pairs, parameters=MergeParameters()):  # noqa: B008 - frozen
    return merge(maps, pairs, parameters, KalmanDrift())


class Team(Robots):
    """Five robots, each of which met the next; the first met none of them as far as it knows."""

    def __init__(self):
        super().__init__([slice(30 * k, 30 * k + 60) for k in range(5)], drift_m=0.0)
        self.pairs = [self.pair(k, k + 1) for k in range(4)]

    def pair(self, a, b, false=False):
        _, at_a, at_b = np.intersect1d(self.rows[a], self.rows[b], return_indices=True)
        T = se2.between(self.T_world_map[a], self.T_world_map[b]) + (3.0 if false else 0.0)
        if false:
            at_a = at_b = np.arange(20)  # rows of either map are in an order of their own
        alignment = replace(self.alignments[0], T_a_b=T, inlier=np.ones(len(at_a), dtype=bool))
        return AlignedPair(a, b, alignment, Correspondences(at_a, at_b, np.zeros(len(at_a))))


def test_maps_are_reached_through_others():
    """The first map has no common ground with the last three."""
    team = Team()
    fusion = fused_by_kalman(team.maps, team.pairs)
    (fused,) = fusion.fused
    assert fusion.edge_status == (EdgeStatus.BRIDGE,) * 4
    assert fused.left_out == ()
    points = team.point_of(fused)
    assert len(np.unique(points)) == len(points) == 180
    assert np.abs(team.errors(fused)).max() < 0.3
    backwards = fused_by_kalman(
        team.maps, [replace(p, a=p.b, b=p.a, **turned(p)) for p in team.pairs]
    )
    moved = backwards.fused[0].T_first_map
    np.testing.assert_allclose(moved, fused.T_first_map, atol=1e-9)
    assert len(backwards.fused[0].landmarks) == 180


def turned(pair):
    """The same pair from the other side."""
    T = se2.inverse(pair.alignment.T_a_b)
    found = pair.correspondences
    return {
        "alignment": replace(pair.alignment, T_a_b=T),
        "correspondences": Correspondences(found.index_b, found.index_a, found.distance),
    }


def test_each_set_of_connected_maps_is_a_map_of_its_own():
    team = Team()
    del team.pairs[1]  # the first two, and the other three
    larger, smaller = fused_by_kalman(team.maps, team.pairs).fused
    np.testing.assert_array_equal(larger.members, [2, 3, 4])
    np.testing.assert_array_equal(smaller.members, [0, 1])
    np.testing.assert_array_equal(larger.T_first_map[2], 0.0)
    assert larger.left_out == (
        ("robot 0", "no alignment connects it"),
        ("robot 1", "no alignment connects it"),
    )
    assert (len(larger.landmarks), len(smaller.landmarks)) == (120, 90)
    assert larger.landmarks.name == "robot 2"


def test_a_false_alignment_that_a_loop_speaks_against_moves_nothing():
    team = Team()
    pairs = [*team.pairs[:2], team.pair(0, 2), team.pair(1, 3), *team.pairs[2:]]
    pairs.append(team.pair(0, 3, false=True))
    fusion = fused_by_kalman(team.maps, pairs)
    assert fusion.edge_status == (EdgeStatus.CONFIRMED,) * 5 + (
        EdgeStatus.BRIDGE,
        EdgeStatus.CONTRADICTED,
    )
    assert np.abs(team.errors(fusion.fused[0])).max() < 0.3
    cautious = MergeParameters(team=TeamParameters(Unconfirmed.DROP))
    dropped = fused_by_kalman(team.maps, pairs, cautious).fused[0]
    assert dropped.left_out == (("robot 4", "no other alignment confirms its own"),)
