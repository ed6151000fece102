"""Landmark arrays of all particles, and spatial search.

A slot holds one landmark, created by one observation. All particles share its descriptor and label,
which never change. If particles have different estimates of a landmark, its slot has a row of M
estimates. If all particles descend from the one that saw it last, they share a common estimate.

All observations of a track show the same point, which has an offset from the landmark. The landmark
is therefore less certain than the point, and so is the point of its next track.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from mapfusion.tables import NO_LABEL

FREE = -1  # generation of an unused slot, and slot of an unused row
COMMON = -2  # generation of a slot without a row: all particles share its common estimate
NOWHERE = (np.inf, np.inf, -np.inf, -np.inf)  # empty box: overlaps none
# Number of slots in a block, which has a box of its own. A search tests the boxes of all blocks,
# then the slots of the blocks found. Slots of similar age lie close together, so this size keeps
# the search fast even among 10^6 slots.
BLOCK = 64
# Number of particles that kernels process together as a vector: large enough for SIMD instructions,
# small enough that the data stay in the processor's cache. The default number of particles is a
# multiple.
LANES = 40


class Estimates(NamedTuple):
    """State of N landmarks in M particles."""

    mean_m: np.ndarray  # (N, M, 3)
    covariance_m2: np.ndarray  # (N, M, 6) upper entries
    count: np.ndarray  # (N, M) int32 observations; 0: the particle does not have it


class Slots(NamedTuple):
    """Arrays of S slots and R rows of M particles; entries of free slots and rows are undefined."""

    by_particle: Estimates  # (R, M, ...)
    slot_of_row: np.ndarray  # (R,); FREE
    common: Estimates  # (S, 1, ...)
    generation: np.ndarray  # (S,) in which the row was written, or FREE or COMMON
    row: np.ndarray  # (S,)
    source: np.ndarray  # (S,) number of the observation that created it
    last_frame: np.ndarray  # (S,) last frame that showed it in any particle
    box_m: np.ndarray  # (S, 4) min_x, min_y, max_x, max_y of mean and gate over all particles
    block_box_m: np.ndarray  # (S / BLOCK, 4) around the boxes of BLOCK slots
    descriptor: np.ndarray  # (S, D) float32; (S, 0) without descriptors
    label: np.ndarray  # (S,) int32


def allocate(capacity: int, n_rows: int, n_particles: int, length: int = 0) -> Slots:
    """Return free slots (their number is a multiple of BLOCK) and free rows.

    `length` is that of the descriptors; 0 without any.
    """
    return Slots(
        _estimates(n_rows, n_particles),
        np.full(n_rows, FREE, dtype=np.int64),
        _estimates(capacity, 1),
        np.full(capacity, FREE, dtype=np.int64),
        np.empty(capacity, dtype=np.int64),
        np.empty(capacity, dtype=np.int64),
        np.zeros(capacity, dtype=np.int64),
        np.tile(NOWHERE, (capacity, 1)),
        np.tile(NOWHERE, (capacity // BLOCK, 1)),
        np.full((capacity, length), np.nan, dtype=np.float32),
        np.full(capacity, NO_LABEL, dtype=np.int32),
    )


def grow(slots: Slots, n_slots: int, n_rows: int) -> Slots:
    """Return the slots with room for at least `n_slots` and `n_rows`; full arrays are doubled."""
    n_particles = slots.by_particle.count.shape[1]
    if n_slots > len(slots.label):
        length = slots.descriptor.shape[1]
        wider = allocate(_doubled(len(slots.label), n_slots), 0, n_particles, length)
        for new, old in zip([*wider.common, *wider[3:]], [*slots.common, *slots[3:]], strict=True):
            new[: len(old)] = old
        slots = wider._replace(by_particle=slots.by_particle, slot_of_row=slots.slot_of_row)
    if n_rows > len(slots.slot_of_row):
        capacity = _doubled(len(slots.slot_of_row), n_rows)
        grown = _estimates(capacity, n_particles)
        slot_of_row = np.full(capacity, FREE, dtype=np.int64)
        for new, old in zip(
            [*grown, slot_of_row], [*slots.by_particle, slots.slot_of_row], strict=True
        ):
            new[: len(old)] = old
        slots = slots._replace(by_particle=grown, slot_of_row=slot_of_row)
    return slots


def _estimates(n: int, m: int) -> Estimates:
    return Estimates(np.empty((n, m, 3)), np.empty((n, m, 6)), np.empty((n, m), dtype=np.int32))


def _doubled(capacity: int, needed: int) -> int:
    while capacity < needed:
        capacity *= 2
    return capacity


_ALONG_PLANE = (0, 3)  # xx and yy among a covariance's upper entries


def update_boxes(slots: Slots, indices: np.ndarray, gate: float) -> None:
    """Compute the bounding boxes of landmarks and of their blocks.

    Args:
        slots: landmark arrays, whose boxes are changed.
        indices: (n,) slots, whose rows are of the present generation.
        gate: largest squared Mahalanobis distance of a match.
    """
    is_common = slots.generation[indices] == COMMON
    common, rowed = indices[is_common], indices[~is_common]
    low, high, spread = (np.empty((2, len(indices))) for _ in range(3))  # along x and y
    by_particle, rows = slots.by_particle, slots.row[rowed]
    has_landmark = by_particle.count[rows] > 0
    for axis, variance in enumerate(_ALONG_PLANE):
        low[axis, is_common] = high[axis, is_common] = slots.common.mean_m[common, 0, axis]
        spread[axis, is_common] = slots.common.covariance_m2[common, 0, variance]
        mean, mean_variance = (
            by_particle.mean_m[rows, :, axis],
            by_particle.covariance_m2[rows, :, variance],
        )
        low[axis, ~is_common] = np.where(has_landmark, mean, np.inf).min(axis=1)
        high[axis, ~is_common] = np.where(has_landmark, mean, -np.inf).max(axis=1)
        spread[axis, ~is_common] = np.where(has_landmark, mean_variance, 0.0).max(axis=1)
    # Inside the gate, |dx| <= sqrt(gate (Sigma_xx + R_xx)) <= sqrt(gate Sigma_xx) +
    # sqrt(gate R_xx). The first term is the landmark's margin, the second the observation's.
    margin = np.sqrt(gate * spread)
    slots.box_m[indices, :2] = (low - margin).T
    slots.box_m[indices, 2:] = (high + margin).T
    update_block_boxes(slots, np.unique(indices // BLOCK))


def transform_boxes(slots: Slots, slot_indices: np.ndarray, turn: Float, shift: Float) -> None:
    """Move the boxes of slots (n,) by rigid motions of the plane and enclose the result.

    A motion rotates by an angle with cosine and sine `turn` (n, 2), then shifts by `shift` (n, 2).
    """
    cos, sin = turn.T
    low, high = slots.box_m[slot_indices, :2], slots.box_m[slot_indices, 2:]
    (x, y), (half_x, half_y) = (0.5 * (low + high)).T, (0.5 * (high - low)).T
    wide = np.stack([abs(cos) * half_x + abs(sin) * half_y, abs(sin) * half_x + abs(cos) * half_y])
    middle = np.stack([cos * x - sin * y + shift[:, 0], sin * x + cos * y + shift[:, 1]])
    slots.box_m[slot_indices] = np.concatenate([middle - wide, middle + wide]).T


def update_block_boxes(slots: Slots, blocks: np.ndarray) -> None:
    """Compute the boxes of blocks (n,) from the boxes of their slots."""
    boxes = slots.box_m.reshape(-1, BLOCK, 4)[blocks]
    for side, outermost in enumerate((np.min, np.min, np.max, np.max)):
        slots.block_box_m[blocks, side] = outermost(boxes[:, :, side], axis=1)


@kernel
def boxes_overlap(boxes: Float, i: int, box: Float) -> bool:
    """Return True if row i of boxes (N, 4) overlaps a box (4,)."""
    x = (boxes[i, 0] <= box[2]) & (boxes[i, 2] >= box[0])
    y = (boxes[i, 1] <= box[3]) & (boxes[i, 3] >= box[1])
    return x & y


def slots_near(slots: Slots, box: Float) -> np.ndarray:
    """Return slots, ascending, whose boxes overlap a box (4,)."""
    blocks = _overlapping(slots.block_box_m, box)
    candidates = (blocks[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    return candidates[_overlapping(slots.box_m[candidates], box)]


def _overlapping(boxes: Float, box: Float) -> np.ndarray:
    """Return the rows of boxes (N, 4) that overlap a box (4,)."""
    return np.flatnonzero(np.all((boxes[:, :2] <= box[2:]) & (boxes[:, 2:] >= box[:2]), axis=1))


class ActiveTracks:
    """Slots of the tracks that the last frame showed."""

    def __init__(self) -> None:
        self._track = self._slot = self._source = np.empty(0, dtype=np.int64)

    @property
    def slots(self) -> np.ndarray:
        """Slots (n,) of these tracks."""
        return self._slot

    def slots_of_ended_tracks(self, track: np.ndarray | None, slots: Slots) -> np.ndarray:
        """Return the landmarks whose track is not continued in a frame.

        Args:
            track: (K,) tracks of the frame's observations, or None.
            slots: landmark arrays of all particles.

        Returns:
            (n,) distinct slots, which are indices of landmarks in `slots`.
        """
        if track is not None and len(track):
            current_tracks = np.sort(track)
            index = np.minimum(
                np.searchsorted(current_tracks, self._track), len(current_tracks) - 1
            )
            has_ended = current_tracks[index] != self._track
        else:
            has_ended = np.ones(len(self._track), dtype=bool)
        # A landmark that no particle has is freed; its slot may hold another landmark by now.
        has_ended &= slots.generation[self._slot] != FREE
        has_ended &= slots.source[self._slot] == self._source
        return np.unique(self._slot[has_ended])

    def update(
        self, track: np.ndarray | None, chosen: np.ndarray, created: np.ndarray, slots: Slots
    ) -> None:
        """Store the slots of a frame's tracks.

        Args:
            track: (K,) tracks of the frame's observations, or None.
            chosen: (K, M) slots; negative if there is none.
            created: (n, 2) observations that created a slot, and the slot.
            slots: the landmarks.
        """
        if track is None:
            self._track = self._slot = self._source = np.empty(0, dtype=np.int64)
            return
        # distinct pairs (n, 2) of observation and slot, in the order of first appearance
        row, particle = np.nonzero(chosen >= 0)
        slot = chosen[row, particle].astype(np.int64)
        _, first = np.unique(row * (slot.max(initial=0) + 1) + slot, return_index=True)
        first.sort()
        matched = np.stack([row[first], slot[first]], axis=1)
        pairs = np.concatenate([matched, created])
        self._track, self._slot = track[pairs[:, 0]], pairs[:, 1]
        self._source = slots.source[self._slot]
