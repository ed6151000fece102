"""Merge of a team's maps: select alignments, then fuse each connected component."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.align.alignment import Status
from mapfusion.align.covariance import with_common_motion
from mapfusion.align.frames import (
    Overlap,
    in_local_frame,
    level_heights,
    moved_motion,
    origin_of,
)
from mapfusion.descriptors import require_one_kind
from mapfusion.fusion.fusers import (
    AlignedPair,
    Component,
    FusedMap,
    Fuser,
    Fusion,
    MergeParameters,
    make_fuser,
    name_order,
)
from mapfusion.fusion.pose_graph import AlignmentEdges
from mapfusion.fusion.team_graph import EdgeStatus, TeamParameters, team_graph
from mapfusion.geometry.numerics import Float, require_shape
from mapfusion.landmark_map import LandmarkMap
from mapfusion.smoother.smooth import AssociatedLog

DEFAULTS = MergeParameters()


@dataclass(frozen=True)
class ConnectedMaps:
    """Connected components of a team's maps.

    Attributes:
        components: components of at least two maps, largest first; if no maps are connected, a
            component with the first map only.
        edge_status: status of the alignment of each pair.
    """

    components: tuple[Component, ...]
    edge_status: tuple[EdgeStatus, ...]

    def fused_by(
        self,
        fuser: Fuser,
        parameters: MergeParameters,
        recordings: Sequence[AssociatedLog | None] = (),
    ) -> Fusion:
        """Fuse the maps of each component.

        Args:
            fuser: fusion method.
            parameters: parameters of the merge.
            recordings: logs of the maps, if these are smoothed, for fusers that smooth again.
        """
        components = [replace(each, recordings=tuple(recordings)) for each in self.components]
        return Fusion(tuple(fuser.fuse(each, parameters) for each in components), self.edge_status)


def merge(
    maps: Sequence[LandmarkMap],
    pairs: Sequence[AlignedPair],
    parameters: MergeParameters = DEFAULTS,
    fuser: Fuser | None = None,
) -> Fusion:
    """Fuse the maps that accepted alignments connect.

    Maps far from their origins are fused in local frames, and the height offsets of alignments are
    subtracted (`align.frames`). The result is in the frame of the first map.

    The order of maps and pairs affects only the frames, and the choice between equally good
    results.

    Args:
        maps: M maps, at least two.
        pairs: alignments, at most one for two maps. Two maps with an ambiguous alignment have one
            entry for each alternative. Rejected alignments are not used. An alternative is used if
            alignments of other maps confirm it alone.
        parameters: parameters of the merge.
        fuser: fusion method; None: `joint`.

    Raises:
        ValueError: the pairs do not fit the maps, or there are fewer than two maps.
        InputError: the descriptors are of different kinds.
    """
    _require_valid_pairs(maps, pairs)
    require_one_kind([(each.called, each.descriptor_kind) for each in maps])
    origins, height = [origin_of(each) for each in maps], np.zeros(len(maps))
    by_heights = [p for p in pairs if p.alignment.ok and p.alignment.heights is not None]
    offset = [p.alignment.heights.used_offset_m for p in by_heights]  # type: ignore[union-attr]
    if np.any(offset):
        sigma = np.array([p.alignment.heights.sigma_m for p in by_heights])  # type: ignore[union-attr]
        of_pair = np.array([(p.a, p.b) for p in by_heights])
        height = level_heights(len(maps), of_pair, np.array(offset), sigma)
    local = [in_local_frame(*each) for each in zip(maps, origins, height.tolist(), strict=True)]
    pairs = [_in_local_frames(pair, origins) for pair in pairs]
    fusion = connect(local, pairs, parameters.team).fused_by(fuser or make_fuser(), parameters)
    fused = (_in_given_frames(each, local, origins, height) for each in fusion.fused)
    return replace(fusion, fused=tuple(fused))


def _in_local_frames(pair: AlignedPair, origins: Sequence[Float]) -> AlignedPair:
    """Return an alignment between local frames of its maps."""
    a, b, alignment = origins[pair.a], origins[pair.b], pair.alignment
    if not (a.any() or b.any()) or not np.isfinite(alignment.T_a_b).all():
        return pair
    if alignment.overlap is not None:  # more precise than the covariance at a far origin
        T_a_b, covariance = alignment.overlap.motion(a, b)
    else:
        T_a_b, covariance = moved_motion(alignment.T_a_b, alignment.covariance, -a, -b)
    return replace(pair, alignment=replace(alignment, T_a_b=T_a_b, covariance=covariance))


def _in_given_frames(
    fused: FusedMap, local: Sequence[LandmarkMap], origins: Sequence[Float], height_m: Float
) -> FusedMap:
    """Return a fused map in the given frame of its first map, with covariances at the middles."""
    first = fused.members[0]
    T, covariance = fused.T_first_map.copy(), fused.motion_covariance.copy()
    at_middle = covariance.copy()
    for k in fused.members:
        if len(local[k]):
            at_middle[k] = Overlap.of(T[k], covariance[k], local[k].position_m).covariance
        if origins[first].any() or origins[k].any():
            T[k], covariance[k] = moved_motion(T[k], covariance[k], origins[first], origins[k])
    T[first] = 0.0
    heights = np.where(np.isnan(T[:, 0]), np.nan, height_m[first] - height_m)
    paths = tuple(path + np.append(origins[first], 0.0) for path in fused.paths)
    return replace(
        fused,
        landmarks=in_local_frame(fused.landmarks, -origins[first], -float(height_m[first])),
        T_first_map=T,
        motion_covariance=covariance,
        paths=paths,
        middle_covariance=at_middle,
        height_m=heights,
    )


def connect(
    maps: Sequence[LandmarkMap],
    pairs: Sequence[AlignedPair],
    parameters: TeamParameters = DEFAULTS.team,
) -> ConnectedMaps:
    """Select consistent alignments (`team_graph`) and compute the poses of connected maps.

    Args:
        maps: M maps, at least two.
        pairs: alignments; see `merge`.
        parameters: parameters of the selection.

    Raises:
        ValueError: the pairs do not fit the maps, or there are fewer than two maps.
        InputError: the descriptors are of different kinds.
    """
    _require_valid_pairs(maps, pairs)
    require_one_kind([(each.called, each.descriptor_kind) for each in maps])
    # Sort maps by name, so that the result does not depend on their order.
    rank = np.empty(len(maps), dtype=np.int64)
    by_rank = np.array(sorted(range(len(maps)), key=lambda k: name_order(maps[k].name)))
    rank[by_rank] = np.arange(len(maps))
    order = sorted(range(len(pairs)), key=lambda e: sorted((rank[pairs[e].a], rank[pairs[e].b])))
    accepted = [e for e in order if pairs[e].alignment.ok]
    ambiguous = [e for e in order if pairs[e].alignment.status is Status.AMBIGUOUS]
    edges, alternatives = (
        _alignment_edges(maps, [pairs[e] for e in rows], rank) for rows in (accepted, ambiguous)
    )
    graph = team_graph(edges, parameters, by_rank, alternatives)
    status_of = dict(zip([*accepted, *ambiguous], graph.edge_status, strict=True))
    status = tuple(status_of.get(e, EdgeStatus.REFUSED) for e in range(len(pairs)))
    used = [pairs[e] for e in order if status[e] in (EdgeStatus.CONFIRMED, EdgeStatus.BRIDGE)]

    component = graph.component[rank]
    several = np.flatnonzero(np.bincount(component) > 1)
    components = []
    for name in several if len(several) else component[:1]:
        members = np.flatnonzero(component == name)
        used_pairs = tuple(pair for pair in used if component[pair.a] == name)
        left_out = _left_out(maps, members, pairs, status)
        T, covariance = np.full((len(maps), 3), np.nan), np.full((len(maps), 3, 3), np.nan)
        T[members] = graph.T_root_robot[rank[members]]
        covariance[members] = graph.covariance[rank[members]]
        components.append(Component(tuple(maps), members, used_pairs, T, covariance, left_out))
    return ConnectedMaps(tuple(components), status)


def _alignment_edges(
    maps: Sequence[LandmarkMap], pairs: Sequence[AlignedPair], rank: np.ndarray
) -> AlignmentEdges:
    """Return the alignments as edges between the ranks of their maps."""
    covariance = [
        with_common_motion(pair.alignment, maps[pair.a].position_m[pair.inliers.index_a, :2])
        for pair in pairs
    ]
    return AlignmentEdges(
        len(maps),
        rank[np.array([(pair.a, pair.b) for pair in pairs], dtype=np.int64).reshape(-1, 2)],
        np.array([pair.alignment.T_a_b for pair in pairs]).reshape(-1, 3),
        np.array(covariance).reshape(-1, 3, 3),
        np.array([pair.log10_false_alarms for pair in pairs], dtype=np.float64),
    )


def _left_out(
    maps: Sequence[LandmarkMap],
    members: np.ndarray,
    pairs: Sequence[AlignedPair],
    status: Sequence[EdgeStatus],
) -> tuple[tuple[str, str], ...]:
    """Return the name of each map that is no member, with the reason."""
    inside, reasons = set(members.tolist()), []
    for k in sorted(set(range(len(maps))) - inside):
        pair_of = {
            each: pair
            for pair, each in zip(reversed(pairs), reversed(status), strict=True)
            if (pair.a == k and pair.b in inside) or (pair.b == k and pair.a in inside)
        }
        if EdgeStatus.AMBIGUOUS in pair_of or EdgeStatus.CONTRADICTED in pair_of:
            reason = "the team's alignments contradict each other about it"
        elif EdgeStatus.UNCONFIRMED in pair_of:
            reason = "no other alignment confirms its own"
        elif pair_of:
            reason = pair_of[EdgeStatus.REFUSED].alignment.reason
        else:
            reason = "no alignment connects it"
        reasons.append((maps[k].name, reason))
    return tuple(reasons)


def _require_valid_pairs(maps: Sequence[LandmarkMap], pairs: Sequence[AlignedPair]) -> None:
    """Raise ValueError if the pairs do not fit the maps."""
    if len(maps) < 2:
        raise ValueError(f"maps: {len(maps)} given, at least 2 are needed")
    seen_pairs: set[frozenset[int]] = set()
    for k, pair in enumerate(pairs):
        pair_set = frozenset((pair.a, pair.b))
        if len(pair_set) < 2 or not 0 <= min(pair_set) <= max(pair_set) < len(maps):
            raise ValueError(f"pairs[{k}]: {pair.a} and {pair.b} are no two of {len(maps)} maps")
        if pair_set in seen_pairs and pair.alignment.status is not Status.AMBIGUOUS:
            raise ValueError(f"pairs[{k}]: {pair.a} and {pair.b} are given twice")
        seen_pairs.add(pair_set)
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
