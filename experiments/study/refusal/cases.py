"""Pairs of maps with and without common ground, and kinds that most worlds do not give.

APART: of two worlds; no landmark is common, whatever the walls' geometry.
COMMON: of one world, at every evaluated iteration.
FEW: a COMMON pair of which only the 20 true correspondences around one landmark are left: the
    first corner of common ground, as hard as the bar for missed merges allows.
REPEATED: an APART pair, but a poster of world a hangs in world b too: the landmarks of a disc of
    common ground, as the partner robot saw them, put at a random place of map b.
"""

from dataclasses import dataclass, replace

import numpy as np

from experiments.judge.criteria import MERGEABLE_PAIRS
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.truth import common_landmarks, true_pairs
from mapfusion import se2
from mapfusion.align.correspondences import Correspondences, MatchParameters, match
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

APART, COMMON = "apart", "common"
FEW, REPEATED = "few", "repeated"
POSTER_RADII_M = (0.5, 1.0, 2.0)  # of a poster, a mural, and half a wall


@dataclass(frozen=True)
class Case:
    """Two maps with their correspondences, and what is true of them.

    Attributes:
        ground: APART, COMMON, FEW or REPEATED.
        n_common: landmarks of both maps that are one point of the world.
        T_true: (3,) NaN without a common world.
        poster_radius_m: NaN without a poster.
    """

    ground: str
    map_a: LandmarkMap
    map_b: LandmarkMap
    pairs: Correspondences
    is_true: np.ndarray
    n_common: int
    T_true: Float
    poster_radius_m: float = np.nan


def apart(map_a: LandmarkMap, map_b: LandmarkMap, matching: MatchParameters) -> Case:
    """Maps of two worlds."""
    pairs = match(map_a, map_b, matching)
    return Case(APART, map_a, map_b, pairs, np.zeros(len(pairs), bool), 0, np.full(3, np.nan))


def common(
    a: EvaluatedRobot, b: EvaluatedRobot, iteration: int, matching: MatchParameters, radius_m: float
) -> Case:
    """Maps of one world (which may have nothing in common yet)."""
    (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
    pairs = match(map_a, map_b, matching)
    is_true = true_pairs(points_a, points_b, pairs.index_a, pairs.index_b, radius_m)
    n_common = common_landmarks(points_a, points_b, radius_m)
    T_true = se2.between(a.path.T_world_map, b.path.T_world_map)
    return Case(COMMON, map_a, map_b, pairs, is_true, n_common, T_true)


def few(case: Case, rng: np.random.Generator) -> Case | None:
    """A common case with 20 true correspondences left, about one of them; None with fewer."""
    true = np.flatnonzero(case.is_true)
    if len(true) <= MERGEABLE_PAIRS:
        return None
    position = case.map_a.position_m[case.pairs.index_a[true]]
    distance = np.linalg.norm(position - position[rng.integers(len(true))], axis=1)
    nearest = true[np.argsort(distance, kind="stable")[:MERGEABLE_PAIRS]]
    kept = np.sort(np.concatenate([np.flatnonzero(~case.is_true), nearest]))
    return replace(case, ground=FEW, pairs=case.pairs[kept], is_true=case.is_true[kept])


def repeated(
    source: Case,
    other: LandmarkMap,
    radius_m: float,
    matching: MatchParameters,
    rng: np.random.Generator,
) -> Case | None:
    """Map a of a common case against another world's map in which a poster of map b hangs.

    None where the common case has no true correspondence to take the poster from.
    """
    true = np.flatnonzero(source.is_true)
    if not len(true) or not len(other):
        return None
    centre = source.map_b.position_m[source.pairs.index_b[rng.choice(true)]]
    apart_m = np.linalg.norm(source.map_b.position_m - centre, axis=1)
    poster = source.map_b[np.flatnonzero(apart_m <= radius_m)]
    hook = other.position_m[rng.integers(len(other))]
    turn = rng.uniform(-np.pi, np.pi)
    T_other_b = np.array([*(hook[:2] - se2.rotation(turn) @ centre[:2]), turn])
    hung = replace(
        poster,
        position_m=se2.transform_points(T_other_b, poster.position_m),
        covariance_m2=se2.transform_covariances(T_other_b, poster.covariance_m2),
    )
    columns = ("position_m", "covariance_m2", "count", "source_observation", "descriptor")
    both = {name: np.concatenate([getattr(other, name), getattr(hung, name)]) for name in columns}
    viewing = None
    if other.viewing is not None and hung.viewing is not None:
        viewing = other.viewing.joined(hung.viewing, turn)
    case = apart(source.map_a, replace(other, viewing=viewing, **both), matching)
    return replace(case, ground=REPEATED, poster_radius_m=radius_m)
