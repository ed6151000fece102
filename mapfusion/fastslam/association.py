"""Which landmark an observation shows, decided in each particle for itself.

An observation takes at most one landmark in a frame, and a landmark at most one observation.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.landmarks import Estimates, Slots, boxes_overlap
from mapfusion.fastslam.measurement import DROPPED, NEW, MapObservations, innovation, quadratic_form
from mapfusion.fastslam.particles import ParticleMaps
from mapfusion.geometry.numerics import Float, kernel

_PART = 16  # entries of a descriptor that are compared at a time


class Association(StrEnum):
    """What decides among the landmarks inside the gate."""

    DESCRIPTOR = "descriptor"  # the nearest descriptor under a threshold
    LABEL = "label"  # known identity; outside the gate the observation is dropped
    GATE = "gate"  # the nearest by Mahalanobis distance


class Pairs(NamedTuple):
    """Observations and slots that may belong together, the best first."""

    observation: np.ndarray  # (P,)
    slot: np.ndarray  # (P,)


def observation_boxes(seen: MapObservations, gate: float) -> Float:
    """Boxes (K, 4) of observations and their gates over all particles."""
    # by coordinate (2, K, M), since NumPy is slow along an axis before a short one
    point = np.ascontiguousarray(seen.point_m[:, :, :2].transpose(2, 0, 1))
    spread = np.stack([seen.covariance_m2[:, :, 0], seen.covariance_m2[:, :, 3]])  # xx and yy
    margin = np.sqrt(gate * spread.max(axis=2, initial=0.0))
    boxes = np.concatenate([point.min(axis=2) - margin, point.max(axis=2) + margin])
    return np.ascontiguousarray(boxes.T)


def candidate_pairs(
    maps: ParticleMaps,
    seen: MapObservations,
    gate: float,
    descriptor: np.ndarray | None = None,
    descriptor_threshold: float = np.inf,
) -> Pairs:
    """Pairs whose gates can touch in some particle.

    With descriptors (K, 64) of the observations only those nearer than the threshold, the nearest
    first. Equal distances are ordered by observation and by the age of the landmark.
    """
    if descriptor is None:
        descriptor = np.empty((len(seen.point_m), 0), dtype=np.float32)
    boxes = observation_boxes(seen, gate)
    around = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
    observation, slot, distance = _touching(
        maps.slots.box_m,
        maps.slots.descriptor,
        maps.near(around),
        boxes,
        np.ascontiguousarray(descriptor, dtype=np.float32),
        np.float32(descriptor_threshold),
    )
    order = np.lexsort((maps.slots.source[slot], observation, distance))
    return Pairs(observation[order], slot[order])


def label_pairs(slot_of_label: Mapping[int, int], label: np.ndarray) -> tuple[Pairs, np.ndarray]:
    """Observations with the slots of their labels (K,), and which may start a landmark (K,).

    All particles start a label's landmark together, so one slot holds it. Only the first
    observation of a new label starts one.
    """
    slot = np.array([slot_of_label.get(name, -1) for name in label.tolist()], dtype=np.int64)
    known = np.flatnonzero(slot >= 0)
    first = np.zeros(len(label), dtype=bool)
    first[np.unique(label, return_index=True)[1]] = True
    return Pairs(known, slot[known]), first & (slot < 0)


@kernel(error_model="numpy")
def _touching(
    box_of: Float,
    descriptor_of: np.ndarray,
    names: np.ndarray,
    boxes: Float,
    descriptor: np.ndarray,
    threshold: np.float32,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    observation = np.empty(len(boxes) * len(names), np.int64)
    slot = np.empty(len(observation), np.int64)
    distance = np.empty(len(observation), np.float32)
    n = 0
    for k in range(len(boxes)):
        for s in names:
            if not boxes_overlap(box_of, s, boxes[k]):
                continue
            apart = _unlikeness(descriptor, k, descriptor_of, s, threshold)
            if apart < threshold:
                observation[n], slot[n], distance[n] = k, s, apart
                n += 1
    return observation[:n], slot[:n], distance[:n]


@kernel(error_model="numpy")
def _unlikeness(
    descriptor: np.ndarray, k: int, known: np.ndarray, s: int, threshold: np.float32
) -> np.float32:
    """Distance of row k of one table from row s of the other; infinite if beyond the threshold.

    Most are far beyond it, which a part of their squares tells.
    """
    enough = np.float32(1.001) * threshold * threshold  # rounding is far below a thousandth
    squares = np.float32(0.0)
    for first in range(0, descriptor.shape[1], _PART):
        for i in range(first, min(first + _PART, descriptor.shape[1])):
            squares += (descriptor[k, i] - known[s, i]) ** 2
        if squares > enough:
            return np.float32(np.inf)
    return np.sqrt(squares)


def associate(
    maps: ParticleMaps,
    pairs: Pairs,
    seen: MapObservations,
    may_create: np.ndarray,
    gate: float,
    planar: bool,
    nearest: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Decide, in each particle, which landmark each observation shows.

    Args:
        maps: the particles' landmarks; those of `pairs` are brought up to date.
        pairs: candidates, the best first.
        seen: K observations in M maps.
        may_create: (K,) whether an observation that matches nothing starts a landmark.
        gate: largest squared Mahalanobis distance of a match.
        planar: two degrees of freedom.
        nearest: take pairs by Mahalanobis distance instead of in their order.

    Returns:
        (K, M) int64 slot, NEW or DROPPED; and the slots that were chosen, ascending.
    """
    used, place = _distinct(pairs.slot)
    alive = maps.bring_up_to_date(used)
    if not alive.all():
        pairs, place = Pairs(*(values[alive[place]] for values in pairs)), place[alive[place]]
    chosen = np.empty(seen.point_m.shape[:2], dtype=np.int64)
    chosen[:] = np.where(may_create, NEW, DROPPED)[:, None]
    taken = np.zeros((len(used), seen.point_m.shape[1]), dtype=bool)
    take = _take_nearest if nearest else _take_in_order
    take(maps.slots.own, maps.slots.row, pairs, place, taken, seen, gate, planar, chosen)
    return chosen, used[taken.any(axis=1)]


def _distinct(slot: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `np.unique` with the inverse; that takes three times as long of some hundred."""
    order = np.argsort(slot)
    ordered = slot[order]
    first = np.ones(len(slot), dtype=bool)
    np.not_equal(ordered[1:], ordered[:-1], out=first[1:])
    place = np.empty(len(slot), dtype=np.int64)
    place[order] = np.cumsum(first) - 1
    return ordered[first], place


@kernel(error_model="numpy")
def _distance(seen: MapObservations, k: int, own: Estimates, r: int, m: int, planar: bool) -> float:
    difference, inverse, _ = innovation(seen, k, own, r, m, planar)
    return quadratic_form(difference, inverse)


@kernel(error_model="numpy")
def _take_in_order(
    own: Estimates,
    row_of: np.ndarray,
    pairs: Pairs,
    place: np.ndarray,
    taken: np.ndarray,
    seen: MapObservations,
    gate: float,
    planar: bool,
    chosen: np.ndarray,
) -> None:
    for i in range(len(place)):
        k, s, j = pairs.observation[i], pairs.slot[i], place[i]
        r = int(row_of[s])
        for m in range(chosen.shape[1]):
            if chosen[k, m] >= 0 or taken[j, m] or own.count[r, m] == 0:
                continue
            if _distance(seen, k, own, r, m, planar) <= gate:
                chosen[k, m] = s
                taken[j, m] = True


@kernel(error_model="numpy")
def _sort_inside(distance: Float, gate: float, order: np.ndarray) -> int:
    """Write the pairs inside the gate into `order`, nearest first, the first on a tie; how many.

    Each is put where it belongs: a particle has about as many as there are observations.
    """
    n = 0
    for i in range(len(distance)):
        if distance[i] <= gate:
            place = n
            while place > 0 and distance[order[place - 1]] > distance[i]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = i
            n += 1
    return n


@kernel(error_model="numpy")
def _take_nearest(
    own: Estimates,
    row_of: np.ndarray,
    pairs: Pairs,
    place: np.ndarray,
    taken: np.ndarray,
    seen: MapObservations,
    gate: float,
    planar: bool,
    chosen: np.ndarray,
) -> None:
    n_particles = chosen.shape[1]
    distance = np.full((n_particles, len(place)), np.inf)
    for i in range(len(place)):
        k, r = pairs.observation[i], int(row_of[pairs.slot[i]])
        for m in range(n_particles):
            if own.count[r, m] > 0:
                distance[m, i] = _distance(seen, k, own, r, m, planar)
    nearest_first = np.empty(len(place), np.int64)
    for m in range(n_particles):
        for i in nearest_first[: _sort_inside(distance[m], gate, nearest_first)]:
            k, j = pairs.observation[i], place[i]
            if chosen[k, m] < 0 and not taken[j, m]:
                chosen[k, m] = pairs.slot[i]
                taken[j, m] = True


def observation_sources(slots: Slots, chosen: np.ndarray, first_source: int) -> np.ndarray:
    """(K, M) int32 source of the landmark that each observation went into, -1 if it was dropped.

    `first_source` is the running number of the first observation.
    """
    own = first_source + np.arange(len(chosen))[:, None]
    source = np.where(chosen == NEW, own, slots.source[chosen])
    return np.where(chosen == DROPPED, -1, source).astype(np.int32)
