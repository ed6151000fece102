"""Merge of a team's maps: select alignments, then fuse each connected component."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.align.alignment import Status
from mapfusion.align.drift import whole_map_covariance
from mapfusion.fusion.fused_map import AlignedPair, Component, Fusion, MergeParameters, name_order
from mapfusion.fusion.fusers import Fuser, make_fuser
from mapfusion.fusion.pose_graph import AlignmentEdges
from mapfusion.fusion.team_graph import EdgeStatus, TeamGraph, TeamParameters, team_graph
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import require_shape
from mapfusion.smoother.joint_smoothing import AssociatedLog

DEFAULTS = MergeParameters()


@dataclass(frozen=True)
class ConnectedMaps:
    """Maps of a team, and what its alignments say together.

    Attributes:
        components: maps that believed alignments connect, those of the most maps first. Maps that
            nothing connects are none; if that is so of all, the first is there alone.
        place: of each pair, what the team's others say of its alignment.
    """

    components: tuple[Component, ...]
    place: tuple[EdgeStatus, ...]

    def fused_by(
        self,
        fuser: Fuser,
        parameters: MergeParameters,
        smoothed: Sequence[LandmarkMap] | None = None,
        recordings: Sequence[AssociatedLog | None] = (),
    ) -> Fusion:
        """Each component made one map.

        Args:
            fuser: what makes it.
            parameters: its settings.
            smoothed: the same robots' maps by the smoother, for fusers that take these.
            recordings: what each of these was smoothed from, for fusers that smooth again.
        """
        given = [replace(each, recordings=tuple(recordings)) for each in self.components]
        if fuser.smoothed and smoothed is not None:
            given = [component.on(smoothed) for component in given]
        return Fusion(tuple(fuser.fuse(each, parameters) for each in given), self.place)


def merge(
    maps: Sequence[LandmarkMap],
    pairs: Sequence[AlignedPair],
    parameters: MergeParameters = DEFAULTS,
    fuser: Fuser | None = None,
) -> Fusion:
    """Fuse two or more maps, as far as alignments connect them.

    The order in which maps and pairs are given decides on frames alone, and where two answers are
    equally good.

    Args:
        maps: M of them.
        pairs: each two of them at most once; of ambiguous ones as many as there are alternatives.
            Alignments that were not accepted are left out, but for an alternative that those of
            other maps tell from its rivals.
        parameters: how to merge.
        fuser: what makes connected maps one; the `joint` one if None.

    Raises:
        ValueError: pairs that do not fit the maps, or fewer than two maps.
    """
    return connect(maps, pairs, parameters.team).fused_by(fuser or make_fuser(), parameters)


def connect(
    maps: Sequence[LandmarkMap],
    pairs: Sequence[AlignedPair],
    parameters: TeamParameters = DEFAULTS.team,
) -> ConnectedMaps:
    """Judge all accepted alignments together (`mapfusion/team`), and place the maps by them.

    Raises:
        ValueError: pairs that do not fit the maps, or fewer than two maps.
    """
    _require_fitting(maps, pairs)
    rank = _ranks(maps)
    order = sorted(range(len(pairs)), key=lambda e: sorted((rank[pairs[e].a], rank[pairs[e].b])))
    accepted = [e for e in order if pairs[e].alignment.ok]
    ambiguous_edges = [e for e in order if pairs[e].alignment.status is Status.AMBIGUOUS]
    by_itself, left_open = ([pairs[e] for e in some] for some in (accepted, ambiguous_edges))
    graph = _graph(maps, by_itself, left_open, rank, parameters)
    said = dict(zip([*accepted, *ambiguous_edges], graph.place, strict=True))
    place = tuple(said.get(e, EdgeStatus.REFUSED) for e in range(len(pairs)))
    believed = [pairs[e] for e in order if place[e] in (EdgeStatus.CONFIRMED, EdgeStatus.BRIDGE)]
    several = np.flatnonzero(np.bincount(graph.component) > 1)
    components = []
    for name in several if len(several) else graph.component[:1]:
        members = np.flatnonzero(graph.component == name)
        own = tuple(pair for pair in believed if graph.component[pair.a] == name)
        left_out = _left_out(maps, members, pairs, place)
        T, covariance = _of_members(graph, members)
        components.append(Component(tuple(maps), members, own, T, covariance, left_out))
    return ConnectedMaps(tuple(components), place)


def _of_members(graph: TeamGraph, members: np.ndarray) -> tuple[Float, Float]:
    """Motions (M, 3) with their covariances (M, 3, 3), NaN for all but the members."""
    T, covariance = np.full_like(graph.T_root_robot, np.nan), np.full_like(graph.covariance, np.nan)
    T[members], covariance[members] = graph.T_root_robot[members], graph.covariance[members]
    return T, covariance


def _ranks(maps: Sequence[LandmarkMap]) -> np.ndarray:
    """(M,) place of each map in the order of their names; of one name, that of the maps."""
    rank = np.empty(len(maps), dtype=np.int64)
    rank[sorted(range(len(maps)), key=lambda k: name_order(maps[k].name))] = np.arange(len(maps))
    return rank


def _graph(
    maps: Sequence[LandmarkMap],
    accepted: Sequence[AlignedPair],
    alternatives: Sequence[AlignedPair],
    rank: np.ndarray,
    parameters: TeamParameters,
) -> TeamGraph:
    """All alignments judged together, robots by their rank; each component's root is its first."""
    by_rank = np.argsort(rank)
    both = (_relations(maps, some) for some in (accepted, alternatives))
    ranked, ambiguous_edges = (replace(each, robots=rank[each.robots]) for each in both)
    graph = team_graph(ranked, parameters, by_rank, ambiguous_edges)
    return TeamGraph(
        graph.component[rank], graph.T_root_robot[rank], graph.covariance[rank], graph.place
    )


def _relations(maps: Sequence[LandmarkMap], accepted: Sequence[AlignedPair]) -> AlignmentEdges:
    covariance = [
        whole_map_covariance(
            pair.alignment.T_a_b,
            pair.alignment.covariance,
            pair.alignment.drift_sigma_m,
            maps[pair.a].position_m[pair.inliers.index_a, :2],
        )
        for pair in accepted
    ]
    return AlignmentEdges(
        len(maps),
        np.array([(pair.a, pair.b) for pair in accepted], dtype=np.int64).reshape(-1, 2),
        np.array([pair.alignment.T_a_b for pair in accepted]).reshape(-1, 3),
        np.array(covariance).reshape(-1, 3, 3),
        np.array([pair.log10_false_alarms for pair in accepted], dtype=np.float64),
    )


def _left_out(
    maps: Sequence[LandmarkMap],
    members: np.ndarray,
    pairs: Sequence[AlignedPair],
    place: Sequence[EdgeStatus],
) -> tuple[tuple[str, str], ...]:
    """Name of each other map, in their order, with the reason."""
    inside, why = set(members.tolist()), []
    for k in sorted(set(range(len(maps))) - inside):
        told = {
            said: pair
            for pair, said in zip(reversed(pairs), reversed(place), strict=True)
            if (pair.a == k and pair.b in inside) or (pair.b == k and pair.a in inside)
        }
        if EdgeStatus.AMBIGUOUS in told or EdgeStatus.CONTRADICTED in told:
            reason = "the team's alignments contradict each other about it"
        elif EdgeStatus.UNCONFIRMED in told:
            reason = "no other alignment confirms its own"
        elif told:
            reason = told[EdgeStatus.REFUSED].alignment.reason
        else:
            reason = "no alignment connects it"
        why.append((maps[k].name, reason))
    return tuple(why)


def _require_fitting(maps: Sequence[LandmarkMap], pairs: Sequence[AlignedPair]) -> None:
    if len(maps) < 2:
        raise ValueError(f"maps: {len(maps)} given, at least 2 are needed")
    met: set[frozenset[int]] = set()
    for k, pair in enumerate(pairs):
        both = frozenset((pair.a, pair.b))
        if len(both) < 2 or not 0 <= min(both) <= max(both) < len(maps):
            raise ValueError(f"pairs[{k}]: {pair.a} and {pair.b} are no two of {len(maps)} maps")
        if both in met and pair.alignment.status is not Status.AMBIGUOUS:
            raise ValueError(f"pairs[{k}]: {pair.a} and {pair.b} are given twice")
        met.add(both)
        require_shape(
            f"pairs[{k}].alignment.inlier", pair.alignment.inlier, (len(pair.correspondences),)
        )
        for name, index, landmarks in (
            ("index_a", pair.inliers.index_a, maps[pair.a]),
            ("index_b", pair.inliers.index_b, maps[pair.b]),
        ):
            if len(np.unique(index)) < len(index):
                raise ValueError(f"pairs[{k}].{name}: inliers are not one to one")
            if len(index) and not 0 <= index.min() <= index.max() < len(landmarks):
                raise ValueError(f"pairs[{k}].{name}: lies outside its map")
