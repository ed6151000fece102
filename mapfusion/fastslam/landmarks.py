"""Landmark arrays of all particles, and the search among them.

A slot is one landmark that one observation gave rise to. Particles share its descriptor and label,
which never change. Where they estimate it differently, it has a row of M estimates; where all
descend from the particle that saw it last, one estimate stands for all.

All observations of a track are of one point, which lies somewhat beside the landmark: what is sure
about the one is less so about the other, and about the point that the next track will be of.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, inner_kernel, kernel, kernel_part
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


def with_room(slots: Slots, n_slots: int, n_rows: int) -> Slots:
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


@kernel
def copy_estimate(old: Estimates, n: int, m: int, new: Estimates, i: int, j: int) -> None:
    """Write what particle m has of landmark n to another place."""
    new.count[i, j] = old.count[n, m]
    for k in range(3):
        new.mean_m[i, j, k] = old.mean_m[n, m, k]
    for k in range(6):
        new.covariance_m2[i, j, k] = old.covariance_m2[n, m, k]


def _doubled(capacity: int, needed: int) -> int:
    while capacity < needed:
        capacity *= 2
    return capacity


@kernel
def bound(slots: Slots, which: np.ndarray, gate: float) -> None:
    """Write the boxes of slots that are up to date, and of their blocks."""
    for s in which:
        box, spread_x, spread_y = slots.box_m[s], 0.0, 0.0
        if slots.generation[s] == COMMON:
            box[0] = box[2] = slots.common.mean_m[s, 0, 0]
            box[1] = box[3] = slots.common.mean_m[s, 0, 1]
            spread_x = slots.common.covariance_m2[s, 0, 0]
            spread_y = slots.common.covariance_m2[s, 0, 3]
        else:
            box[:2], box[2:] = np.inf, -np.inf
            r = slots.row[s]
            for m in range(slots.own.count.shape[1]):
                if slots.own.count[r, m] == 0:
                    continue
                x, y = slots.own.mean_m[r, m, 0], slots.own.mean_m[r, m, 1]
                box[0], box[1] = min(box[0], x), min(box[1], y)
                box[2], box[3] = max(box[2], x), max(box[3], y)
                spread_x = max(spread_x, slots.own.covariance_m2[r, m, 0])
                spread_y = max(spread_y, slots.own.covariance_m2[r, m, 3])
        # Inside the gate |dx| <= sqrt(gate (Sigma_xx + R_xx)), at most the sum of both roots: one
        # is the landmark's margin, the other the observation's.
        margin_x, margin_y = np.sqrt(gate * spread_x), np.sqrt(gate * spread_y)
        box[0], box[1] = box[0] - margin_x, box[1] - margin_y
        box[2], box[3] = box[2] + margin_x, box[3] + margin_y
    last = -1
    for s in which:
        if s // BLOCK != last:
            last = s // BLOCK
            bound_block(slots, last)


@kernel_part
def bend_box(slots: Slots, s: int, motion: Float) -> None:
    """Put a box around what is in it after a motion (3,) of the plane."""
    box = slots.box_m[s]
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    x, y = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    half_x, half_y = 0.5 * (box[2] - box[0]), 0.5 * (box[3] - box[1])
    wide_x = abs(cos) * half_x + abs(sin) * half_y
    wide_y = abs(sin) * half_x + abs(cos) * half_y
    x, y = cos * x - sin * y + motion[0], sin * x + cos * y + motion[1]
    box[0], box[1], box[2], box[3] = x - wide_x, y - wide_y, x + wide_x, y + wide_y


@kernel
def bound_block(slots: Slots, block: int) -> None:
    """Write the box of a block around those of its slots."""
    around = slots.block_box_m[block]
    around[:2], around[2:] = np.inf, -np.inf
    for s in range(block * BLOCK, (block + 1) * BLOCK):
        around[0] = min(around[0], slots.box_m[s, 0])
        around[1] = min(around[1], slots.box_m[s, 1])
        around[2] = max(around[2], slots.box_m[s, 2])
        around[3] = max(around[3], slots.box_m[s, 3])


@inner_kernel
def touches(boxes: Float, i: int, box: Float) -> bool:
    """Whether row i of boxes (N, 4) and a box (4,) have a point in common."""
    x = (boxes[i, 0] <= box[2]) & (boxes[i, 2] >= box[0])
    y = (boxes[i, 1] <= box[3]) & (boxes[i, 3] >= box[1])
    return x & y


@kernel
def near(slots: Slots, box: Float) -> np.ndarray:
    """Slots, ascending, whose boxes touch a box (4,)."""
    blocks = np.empty(len(slots.block_box_m), np.int64)
    n_blocks = n = 0
    for block in range(len(blocks)):
        if touches(slots.block_box_m, block, box):
            blocks[n_blocks] = block
            n_blocks += 1
    found = np.empty(n_blocks * BLOCK, np.int64)
    for block in blocks[:n_blocks]:
        for s in range(block * BLOCK, (block + 1) * BLOCK):
            if touches(slots.box_m, s, box):
                found[n] = s
                n += 1
    return found[:n]


class Tracked:
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


@kernel
def _distinct(chosen: np.ndarray) -> np.ndarray:
    """Rows and slots (n, 2) of `chosen` (K, M), each once: most particles choose the same slot."""
    pairs = np.empty((chosen.size, 2), dtype=np.int64)
    n = 0
    for k in range(chosen.shape[0]):
        first = n
        for m in range(chosen.shape[1]):
            s = chosen[k, m]
            if s < 0:
                continue
            known = False
            for i in range(first, n):
                known = known or pairs[i, 1] == s
            if not known:
                pairs[n, 0], pairs[n, 1] = k, s
                n += 1
    return pairs[:n].copy()
