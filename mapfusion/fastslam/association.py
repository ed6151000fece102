"""Data association per particle: match observations to landmarks.

In one frame, a particle assigns at most one landmark to an observation, and at most one observation
to a landmark.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.landmark_arrays import Estimates, boxes_overlap, slots_near
from mapfusion.fastslam.measurement import DROPPED, NEW, MapObservations, innovation, quadratic_form
from mapfusion.fastslam.particles import ParticleMaps
from mapfusion.geometry.numerics import Float, kernel

_DESCRIPTOR_PART = 16  # entries of a descriptor between two tests of the distance so far


class Association(StrEnum):
    """Criterion that selects among the landmarks inside the gate."""

    DESCRIPTOR = "descriptor"  # the nearest descriptor under a threshold
    LABEL = "label"  # known identity; outside the gate the observation is dropped
    GATE = "gate"  # the nearest by Mahalanobis distance


class Pairs(NamedTuple):
    """Candidate pairs of an observation and a slot, the best first."""

    observation: np.ndarray  # (P,)
    slot: np.ndarray  # (P,)


def candidate_pairs(
    maps: ParticleMaps,
    seen: MapObservations,
    gate: float,
    descriptor: np.ndarray | None = None,
    descriptor_threshold: float = np.inf,
) -> Pairs:
    """Return pairs whose gates can overlap in some particle.

    With descriptors (K, D) of the observations, only pairs with a descriptor distance below the
    threshold are returned, sorted by distance. Equal distances are ordered by observation and by
    the age of the landmark.
    """
    if descriptor is None:
        descriptor = np.empty((len(seen.point_m), 0), dtype=np.float32)
    # Boxes (K, 4) that enclose each observation and its gate in all particles. They are computed by
    # coordinate (2, K, M), since NumPy is slow along an axis before a short one.
    point = np.ascontiguousarray(seen.point_m[:, :, :2].transpose(2, 0, 1))
    spread = np.stack([seen.covariance_m2[:, :, 0], seen.covariance_m2[:, :, 3]])  # xx and yy
    margin = np.sqrt(gate * spread.max(axis=2, initial=0.0))
    bounds = np.concatenate([point.min(axis=2) - margin, point.max(axis=2) + margin])
    boxes = np.ascontiguousarray(bounds.T)
    around = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
    observation, slot, distance = _pairs_of_boxes(
        maps.slots.box_m,
        maps.slots.descriptor,
        slots_near(maps.slots, around),
        boxes,
        np.ascontiguousarray(descriptor, dtype=np.float32),
        np.float32(descriptor_threshold),
    )
    order = np.lexsort((maps.slots.source[slot], observation, distance))
    return Pairs(observation[order], slot[order])


def label_pairs(slot_of_label: Mapping[int, int], label: np.ndarray) -> tuple[Pairs, np.ndarray]:
    """Return pairs of observations and slots with the same label.

    All particles start a label's landmark together, so each label has one slot. Only the first
    observation of a new label starts a landmark.

    Args:
        slot_of_label: slot of each known label.
        label: (K,) of the observations.

    Returns:
        The pairs, and (K,) bool: True for an observation that may start a landmark.
    """
    slot = np.array([slot_of_label.get(name, -1) for name in label.tolist()], dtype=np.int64)
    has_slot = np.flatnonzero(slot >= 0)
    first = np.zeros(len(label), dtype=bool)
    first[np.unique(label, return_index=True)[1]] = True
    return Pairs(has_slot, slot[has_slot]), first & (slot < 0)


@kernel(error_model="numpy")
def _pairs_of_boxes(
    slot_boxes: Float,
    slot_descriptors: np.ndarray,
    slots: np.ndarray,
    boxes: Float,
    descriptors: np.ndarray,
    threshold: np.float32,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return observations, slots and descriptor distances (P,) of overlapping boxes."""
    observation = np.empty(len(boxes) * len(slots), np.int64)
    slot = np.empty(len(observation), np.int64)
    distance = np.empty(len(observation), np.float32)
    max_squares = np.float32(1.001) * threshold * threshold  # rounding is below a thousandth
    length = descriptors.shape[1]
    n = 0
    for k in range(len(boxes)):
        for s in slots:
            if not boxes_overlap(slot_boxes, s, boxes[k]):
                continue
            # Most distances are far above the threshold: part of the sum is enough to reject them.
            squares = np.float32(0.0)
            for first in range(0, length, _DESCRIPTOR_PART):
                for i in range(first, min(first + _DESCRIPTOR_PART, length)):
                    squares += (descriptors[k, i] - slot_descriptors[s, i]) ** 2
                if squares > max_squares:
                    break
            if squares > max_squares:
                continue
            root = np.sqrt(squares)
            if root < threshold:
                observation[n], slot[n], distance[n] = k, s, root
                n += 1
    return observation[:n], slot[:n], distance[:n]


def associate(
    maps: ParticleMaps,
    pairs: Pairs,
    seen: MapObservations,
    may_create: np.ndarray,
    gate: float,
    planar: bool,
    nearest: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Assign a landmark to each observation in each particle.

    Args:
        maps: the particles' landmarks; this call updates the rows of `pairs`.
        pairs: candidates, the best first.
        seen: K observations in M maps.
        may_create: (K,) bool; True if an observation without a match starts a landmark.
        gate: largest squared Mahalanobis distance of a match.
        planar: two degrees of freedom.
        nearest: take pairs by Mahalanobis distance instead of in their order.

    Returns:
        (K, M) int64 slot, NEW or DROPPED; and the assigned slots, ascending.
    """
    # `np.unique` with its inverse takes three times as long for some hundred slots
    order = np.argsort(pairs.slot)
    ordered = pairs.slot[order]
    first = np.ones(len(order), dtype=bool)
    np.not_equal(ordered[1:], ordered[:-1], out=first[1:])
    used = ordered[first]
    slot_position = np.empty(len(order), dtype=np.int64)  # of each pair's slot in `used`
    slot_position[order] = np.cumsum(first) - 1

    alive = maps.bring_up_to_date(used)
    if not alive.all():
        pairs, slot_position = (
            Pairs(*(values[alive[slot_position]] for values in pairs)),
            slot_position[alive[slot_position]],
        )
    chosen = np.empty(seen.point_m.shape[:2], dtype=np.int64)
    chosen[:] = np.where(may_create, NEW, DROPPED)[:, None]
    is_taken = np.zeros((len(used), seen.point_m.shape[1]), dtype=bool)
    assign = _assign_nearest if nearest else _assign_in_order
    assign(
        maps.slots.by_particle,
        maps.slots.row,
        pairs,
        slot_position,
        is_taken,
        seen,
        gate,
        planar,
        chosen,
    )
    return chosen, used[is_taken.any(axis=1)]


@kernel(error_model="numpy")
def _distance(
    seen: MapObservations, k: int, by_particle: Estimates, r: int, m: int, planar: bool
) -> float:
    """Return the squared Mahalanobis distance of observation k from row r in particle m."""
    difference, inverse, _ = innovation(seen, k, by_particle, r, m, planar)
    return quadratic_form(difference, inverse)


@kernel(error_model="numpy")
def _assign_in_order(
    by_particle: Estimates,
    row_of: np.ndarray,
    pairs: Pairs,
    slot_position: np.ndarray,
    is_taken: np.ndarray,
    seen: MapObservations,
    gate: float,
    planar: bool,
    chosen: np.ndarray,
) -> None:
    """Write matches into `chosen` and `is_taken`, greedily in the order of the pairs."""
    for i in range(len(slot_position)):
        k, s, j = pairs.observation[i], pairs.slot[i], slot_position[i]
        r = int(row_of[s])
        for m in range(chosen.shape[1]):
            if chosen[k, m] >= 0 or is_taken[j, m] or by_particle.count[r, m] == 0:
                continue
            if _distance(seen, k, by_particle, r, m, planar) <= gate:
                chosen[k, m] = s
                is_taken[j, m] = True


@kernel(error_model="numpy")
def _assign_nearest(
    by_particle: Estimates,
    row_of: np.ndarray,
    pairs: Pairs,
    slot_position: np.ndarray,
    is_taken: np.ndarray,
    seen: MapObservations,
    gate: float,
    planar: bool,
    chosen: np.ndarray,
) -> None:
    """Write matches into `chosen` and `is_taken`, greedily by Mahalanobis distance."""
    n_particles = chosen.shape[1]
    distances = np.full((n_particles, len(slot_position)), np.inf)
    for i in range(len(slot_position)):
        k, r = pairs.observation[i], int(row_of[pairs.slot[i]])
        for m in range(n_particles):
            if by_particle.count[r, m] > 0:
                distances[m, i] = _distance(seen, k, by_particle, r, m, planar)
    order = np.empty(len(slot_position), np.int64)
    for m in range(n_particles):
        # Stable insertion sort of the pairs inside the gate: there are few in one particle.
        distance, n = distances[m], 0
        for i in range(len(distance)):
            if distance[i] <= gate:
                at = n
                while at > 0 and distance[order[at - 1]] > distance[i]:
                    order[at] = order[at - 1]
                    at -= 1
                order[at] = i
                n += 1
        for i in order[:n]:
            k, j = pairs.observation[i], slot_position[i]
            if chosen[k, m] < 0 and not is_taken[j, m]:
                chosen[k, m] = pairs.slot[i]
                is_taken[j, m] = True
