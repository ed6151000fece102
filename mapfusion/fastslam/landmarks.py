"""Landmark arrays of all particles, and the search among them.

A slot is one landmark that one observation gave rise to. Particles share its descriptor and label,
which never change. Where they estimate it differently, it has a row of M estimates; where all
descend from the particle that saw it last, one estimate stands for all.

All observations of a track are of one point, which lies somewhat beside the landmark: what is sure
about the one is less so about the other, and about the point that the next track will be of.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from mapfusion.tables import DESCRIPTOR_LENGTH, NO_LABEL

FREE = -1  # the generation of a slot in no use, and the slot of a row in no use
COMMON = -2  # the generation of a slot without a row: all particles have its common estimate
NOWHERE = (np.inf, np.inf, -np.inf, -np.inf)  # a box that touches none
# Slots that share a box: a search looks at all blocks, and at the slots of those that touch. Slots
# of like age lie near each other, so with this many a search among 10^6 costs little beside a step.
BLOCK = 64
# Particles that kernels take together, a number of each in a row: many enough that arithmetic on
# rows is worth its start, few enough that what they see stays near the processor. The usual number
# of particles is a multiple.
LANES = 40


class Estimates(NamedTuple):
    """Of N landmarks in M particles."""

    mean_m: np.ndarray  # (N, M, 3)
    covariance_m2: np.ndarray  # (N, M, 6) upper entries
    count: np.ndarray  # (N, M) int32 observations; 0: the particle does not have it


class Slots(NamedTuple):
    """S slots, and R rows of M particles. What belongs to free slots and rows means nothing."""

    own: Estimates  # (R, M, ...)
    slot_of_row: np.ndarray  # (R,); FREE
    common: Estimates  # (S, 1, ...)
    generation: np.ndarray  # (S,) in which the row was written; FREE; COMMON
    row: np.ndarray  # (S,)
    source: np.ndarray  # (S,) the observation it came from
    last_frame: np.ndarray  # (S,) that showed it, in whatever particle
    box_m: np.ndarray  # (S, 4) min_x, min_y, max_x, max_y of mean and gate over all particles
    block_box_m: np.ndarray  # (S / BLOCK, 4) around the boxes of BLOCK slots
    descriptor: np.ndarray  # (S, 64) float32
    label: np.ndarray  # (S,) int32


def allocate(capacity: int, n_rows: int, n_particles: int) -> Slots:
    """Free slots, a multiple of BLOCK, and free rows."""
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
        np.full((capacity, DESCRIPTOR_LENGTH), np.nan, dtype=np.float32),
        np.full(capacity, NO_LABEL, dtype=np.int32),
    )


def grow(slots: Slots, n_slots: int, n_rows: int) -> Slots:
    """The same slots and rows, with room for at least so many; what has none is doubled."""
    n_particles = slots.own.count.shape[1]
    if n_slots > len(slots.label):
        wider = allocate(_doubled(len(slots.label), n_slots), 0, n_particles)
        for new, old in zip([*wider.common, *wider[3:]], [*slots.common, *slots[3:]], strict=True):
            new[: len(old)] = old
        slots = wider._replace(own=slots.own, slot_of_row=slots.slot_of_row)
    if n_rows > len(slots.slot_of_row):
        capacity = _doubled(len(slots.slot_of_row), n_rows)
        own = _estimates(capacity, n_particles)
        slot_of_row = np.full(capacity, FREE, dtype=np.int64)
        for new, old in zip([*own, slot_of_row], [*slots.own, slots.slot_of_row], strict=True):
            new[: len(old)] = old
        slots = slots._replace(own=own, slot_of_row=slot_of_row)
    return slots


def _estimates(n: int, m: int) -> Estimates:
    return Estimates(np.empty((n, m, 3)), np.empty((n, m, 6)), np.empty((n, m), dtype=np.int32))


def _doubled(capacity: int, needed: int) -> int:
    while capacity < needed:
        capacity *= 2
    return capacity


_ALONG_PLANE = (0, 3)  # xx and yy among a covariance's upper entries


def update_boxes(slots: Slots, which: np.ndarray, gate: float) -> None:
    """Write the boxes of slots (n,) that are up to date, and of their blocks."""
    is_common = slots.generation[which] == COMMON
    common, rowed = which[is_common], which[~is_common]
    low, high, spread = (np.empty((2, len(which))) for _ in range(3))  # along x and y
    own, rows = slots.own, slots.row[rowed]
    has = own.count[rows] > 0
    for axis, variance in enumerate(_ALONG_PLANE):
        low[axis, is_common] = high[axis, is_common] = slots.common.mean_m[common, 0, axis]
        spread[axis, is_common] = slots.common.covariance_m2[common, 0, variance]
        mean, of_mean = own.mean_m[rows, :, axis], own.covariance_m2[rows, :, variance]
        low[axis, ~is_common] = np.where(has, mean, np.inf).min(axis=1)
        high[axis, ~is_common] = np.where(has, mean, -np.inf).max(axis=1)
        spread[axis, ~is_common] = np.where(has, of_mean, 0.0).max(axis=1)
    # Inside the gate |dx| <= sqrt(gate (Sigma_xx + R_xx)), at most the sum of both roots: one is
    # the landmark's margin, the other the observation's.
    margin = np.sqrt(gate * spread)
    slots.box_m[which, :2], slots.box_m[which, 2:] = (low - margin).T, (high + margin).T
    update_block_boxes(slots, np.unique(which // BLOCK))


def transform_boxes(slots: Slots, which: np.ndarray, turn: Float, shift: Float) -> None:
    """Put boxes of slots (n,) around what is in them after motions of the plane.

    A motion turns by the cosines and sines `turn` (n, 2) and then shifts by `shift` (n, 2).
    """
    cos, sin = turn.T
    low, high = slots.box_m[which, :2], slots.box_m[which, 2:]
    (x, y), (half_x, half_y) = (0.5 * (low + high)).T, (0.5 * (high - low)).T
    wide = np.stack([abs(cos) * half_x + abs(sin) * half_y, abs(sin) * half_x + abs(cos) * half_y])
    middle = np.stack([cos * x - sin * y + shift[:, 0], sin * x + cos * y + shift[:, 1]])
    slots.box_m[which] = np.concatenate([middle - wide, middle + wide]).T


def update_block_boxes(slots: Slots, blocks: np.ndarray) -> None:
    """Write the boxes of blocks (n,) around those of their slots."""
    boxes = slots.box_m.reshape(-1, BLOCK, 4)[blocks]
    for side, outermost in enumerate((np.min, np.min, np.max, np.max)):
        slots.block_box_m[blocks, side] = outermost(boxes[:, :, side], axis=1)


@kernel
def boxes_overlap(boxes: Float, i: int, box: Float) -> bool:
    """Return True if row i of boxes (N, 4) and a box (4,) have a point in common."""
    x = (boxes[i, 0] <= box[2]) & (boxes[i, 2] >= box[0])
    y = (boxes[i, 1] <= box[3]) & (boxes[i, 3] >= box[1])
    return x & y


def slots_near(slots: Slots, box: Float) -> np.ndarray:
    """Slots, ascending, whose boxes touch a box (4,)."""
    blocks = _touching(slots.block_box_m, box)
    of_blocks = (blocks[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    return of_blocks[_touching(slots.box_m[of_blocks], box)]


def _touching(boxes: Float, box: Float) -> np.ndarray:
    """Rows of the boxes (N, 4) that have a point in common with a box (4,)."""
    return np.flatnonzero(np.all((boxes[:, :2] <= box[2:]) & (boxes[:, 2:] >= box[:2]), axis=1))


class ActiveTracks:
    """The slots of each track that the last frame held."""

    def __init__(self) -> None:
        self._track = self._slot = self._source = np.empty(0, dtype=np.int64)

    def ended(self, track: np.ndarray | None, slots: Slots) -> np.ndarray:
        """Slots (n,) of tracks that go on in none of this frame's observations (K,); once each."""
        if track is not None and len(track):
            known = np.sort(track)
            place = np.minimum(np.searchsorted(known, self._track), len(known) - 1)
            over = known[place] != self._track
        else:
            over = np.ones(len(self._track), dtype=bool)
        # A landmark that no particle has any more is gone, and its slot may be another's by now.
        over &= slots.generation[self._slot] != FREE
        over &= slots.source[self._slot] == self._source
        return np.unique(self._slot[over])

    def went_into(
        self, track: np.ndarray | None, chosen: np.ndarray, created: np.ndarray, slots: Slots
    ) -> None:
        """Keep the slots of a frame.

        Args:
            track: (K,) of its observations.
            chosen: (K, M) the slots, or something negative.
            created: (n, 2) rows of observations that began a slot, and the slot.
            slots: the landmarks.
        """
        if track is None:
            self._track = self._slot = self._source = np.empty(0, dtype=np.int64)
            return
        pairs = np.concatenate([_distinct(chosen), created])
        self._track, self._slot = track[pairs[:, 0]], pairs[:, 1]
        self._source = slots.source[self._slot]


def _distinct(chosen: np.ndarray) -> np.ndarray:
    """Rows and slots (n, 2) of `chosen` (K, M), each once and in the order of first appearance."""
    row, particle = np.nonzero(chosen >= 0)
    slot = chosen[row, particle].astype(np.int64)
    _, first = np.unique(row * (slot.max(initial=0) + 1) + slot, return_index=True)
    first.sort()
    return np.stack([row[first], slot[first]], axis=1)
