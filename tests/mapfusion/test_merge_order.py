"""The order in which maps are given changes nothing but the frame."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import FUSERS, AlignedPair, MergeParameters, make_fuser
from mapfusion.fusion.merge import merge
from mapfusion.fusion.team_graph import TeamParameters, Unconfirmed
from mapfusion.geometry import se2
from tests.mapfusion.robots_of_one_world import Robots
from tests.mapfusion.same_fusion import assert_same_map, assert_same_points, clusters

N_ROBOTS = 6
# m and rad: the iterations of joint fusion end a thirtieth of a sigma before they stand still
JOINT_WITHIN = 3e-3


class Team(Robots):
    """Six robots with drift; half of the landmarks are left to the second pass.

    Pairs are off by what their covariance says, one of them by metres, and two robots met nobody
    else. Gates therefore decide closely, and what is fused first matters.
    """

    def __init__(self, seed):
        starts = [0, 25, 50, 70, 300, 330]
        super().__init__([slice(s, s + 70) for s in starts], drift_m=0.1, seed=seed)
        rng = np.random.default_rng(seed)
        self.pairs = []
        for a, b in itertools.combinations(range(N_ROBOTS), 2):
            _, at_a, at_b = np.intersect1d(self.rows[a], self.rows[b], return_indices=True)
            if len(at_a):
                self.pairs.append(self.pair(a, b, at_a, at_b, rng))
        false = self.pairs[2].alignment  # of the first and the fourth robot, or of the second
        self.pairs[2] = replace(self.pairs[2], alignment=replace(false, T_a_b=false.T_a_b + 2.0))

    def pair(self, a, b, at_a, at_b, rng):
        T = se2.between(self.T_world_map[a], self.T_world_map[b])
        T = T + rng.normal(0, [0.05, 0.05, 0.005])
        alignment = replace(
            self.alignments[0],
            T_a_b=T,
            covariance=np.diag([0.05, 0.05, 0.005]) ** 2,
            inlier=rng.uniform(size=len(at_a)) < 0.5,
        )
        unlike = rng.uniform(0, 0.2, len(at_a)).round(1)  # many are equally alike
        return AlignedPair(
            a, b, alignment, Correspondences(at_a, at_b, unlike), -float(rng.integers(9))
        )

    def merged(self, order, parameters, fuser=None):
        """Merged with the maps in another order, and the alignments in yet another."""
        at = {k: place for place, k in enumerate(order)}
        pairs = [replace(pair, a=at[pair.a], b=at[pair.b]) for pair in self.pairs]
        turned = [*pairs[order[0] :], *pairs[: order[0]]]
        fusion = merge([self.maps[k] for k in order], turned, parameters, fuser)
        place = dict(zip(((pair.a, pair.b) for pair in turned), fusion.edge_status, strict=True))
        told = {(p.a, p.b): place[at[p.a], at[p.b]] for p in self.pairs}
        return fusion, told


@pytest.mark.parametrize("fuser", FUSERS)
@pytest.mark.parametrize(("seed", "unconfirmed"), [*enumerate([*Unconfirmed, *Unconfirmed])])
def test_permuted_maps_fuse_to_the_same(seed, unconfirmed, fuser):
    team, rng = Team(seed), np.random.default_rng(100 + seed)
    parameters = MergeParameters(team=TeamParameters(unconfirmed))
    first, told = team.merged(range(N_ROBOTS), parameters, make_fuser(fuser))
    for _ in range(5):
        order = rng.permutation(N_ROBOTS).tolist()
        other, also_told = team.merged(order, parameters, make_fuser(fuser))
        assert also_told == told
        assert len(other.fused) == len(first.fused)
        for one, two in zip(first.fused, other.fused, strict=True):
            if fuser in ("joint", "batch"):  # without logs these are the same
                assert_same_points(one, two, order, JOINT_WITHIN)
            else:
                assert_same_map(one, two, order)


def test_the_worlds_make_it_hard():
    """Otherwise the test above would hold of any merge: maps of several sets, and a false pair."""
    first, told = Team(0).merged(range(N_ROBOTS), MergeParameters())
    assert len(first.fused) == 2
    assert len(set(told.values())) > 1
    assert any(len(cluster) > 2 for cluster in clusters(first.fused[0], range(N_ROBOTS)))


def test_nothing_merged_is_the_first_map_given():
    team = Team(0)
    team.pairs = []
    order = [3, 0, 1, 2, 4, 5]
    fusion, _ = team.merged(order, MergeParameters())
    (alone,) = fusion.fused
    assert alone.members.tolist() == [0]
    assert alone.landmarks.name == "robot 3"
