"""The landmarks of all particles: what the kernels read and write.

A slot is one landmark that one observation gave rise to. Particles share its descriptor and label,
which never change. Where they estimate it differently, it has a row of M estimates; where all
descend from the particle that saw it last, one estimate stands for all.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.kernels import kernel
from mapfusion.looks import DESCRIPTOR_LENGTH, NO_LABEL

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
