"""Particle maps in shared storage, so that resampling copies none of them, and particle paths.

A resampling only notes who descends from whom (`genealogy.py`); the row of a slot is brought up to
date when it comes into view. Slots that no surviving particle has are freed, and so is the row of a
slot that all particles have from one ancestor. So a map out of view takes one estimate a landmark
once the particles' lines have met, and a step costs what is in view.
"""

import math

import numpy as np

from mapfusion.fastslam.landmarks import (
    BLOCK,
    COMMON,
    FREE,
    NOWHERE,
    Estimates,
    Slots,
    allocate,
    grow,
    slots_near,
    transform_boxes,
    update_block_boxes,
    update_boxes,
)
from mapfusion.fastslam.measurement import NEW, MapObservations
from mapfusion.fastslam.resampling import MEMORY, Genealogy
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import compose
from mapfusion.robot_log import Observations

_ALONG_AXES = np.array([0, 3, 5])  # of the upper entries of a covariance
_FIRST_SLOTS, _FIRST_ROWS = 4 * BLOCK, 64
# In so many resamplings all rows are visited once, wherever their landmarks lie. Two visits of a
# row are then less than twice this apart, which is what the genealogy remembers.
_ROUND = MEMORY // 2


class ParticleMaps:
    """Landmarks of M particles.

    `gate` is the squared Mahalanobis distance that a match may have.
    """

    def __init__(self, n_particles: int, gate: float) -> None:
        self.slots = allocate(_FIRST_SLOTS, _FIRST_ROWS, n_particles)
        self.n_landmarks = np.zeros(n_particles, dtype=np.int64)
        self._gate = gate
        self._genealogy = Genealogy(n_particles)
        self._used_slots, self._used_rows = _Pool(), _Pool()
        self._n_visited = 0

    @property
    def n_slots(self) -> int:
        """Slots in use."""
        return len(self._used_slots)

    @property
    def n_rows(self) -> int:
        """Those of them that have a row."""
        return len(self._used_rows)

    def near(self, box_m: Float) -> np.ndarray:
        """Slots whose box touches `box_m` (4,); they may be out of date."""
        return slots_near(self.slots, box_m)

    def bring_up_to_date(self, which: np.ndarray) -> np.ndarray:
        """Write the rows of slots for the present generation; free those that nobody has.

        Returns:
            (n,) bool, which of them are still in use.
        """
        genealogy = self._genealogy
        self._give_rows(which[self.slots.generation[which] == COMMON])
        slots = self.slots
        alive = _inherit(
            slots.own,
            slots.common,
            slots.row,
            slots.generation,
            which,
            genealogy.ancestors,
            genealogy.generation,
        )
        if not alive.all():
            dead = which[~alive]
            self._free_rows(dead, FREE)
            self.slots.box_m[dead] = NOWHERE
            self._used_slots.give_back(dead)
        return alive

    def moved(self, which: np.ndarray) -> None:
        """Tell that landmarks of these slots, up to date, have changed: they may lie elsewhere."""
        update_boxes(self.slots, which, self._gate)

    def widen(self, which: np.ndarray, variance_m2: float) -> None:
        """Add to the covariances of these slots' landmarks, along each axis."""
        which = which[self.bring_up_to_date(which)]
        with np.errstate(invalid="ignore"):  # what particles without the landmark have there
            own = self.slots.own.covariance_m2
            own[self.slots.row[which, None], :, _ALONG_AXES] += variance_m2
        self.moved(which)

    def bend(self, T_map_bent: Float) -> None:
        """Move the landmarks of all slots (S,) by motions of the plane (S, 3), in every particle.

        The motions are small: covariances keep their directions.
        """
        slots = self.slots
        which = np.flatnonzero(slots.generation != FREE)
        x, y, angle = T_map_bent[which].T
        turn = np.array([[math.cos(each), math.sin(each)] for each in angle]).reshape(-1, 2)
        is_common = slots.generation[which] == COMMON
        for means, rows, moved in (
            (slots.common.mean_m, which[is_common], is_common),
            (slots.own.mean_m, slots.row[which[~is_common]], ~is_common),
        ):
            (cos, sin), at = turn[moved].T[:, :, None], means[rows]
            means[rows, :, 0] = cos * at[:, :, 0] - sin * at[:, :, 1] + x[moved, None]
            means[rows, :, 1] = sin * at[:, :, 0] + cos * at[:, :, 1] + y[moved, None]
        transform_boxes(slots, which, turn, np.stack([x, y], axis=1))
        update_block_boxes(slots, np.arange(len(slots.block_box_m)))

    def create(
        self,
        chosen: np.ndarray,
        seen: MapObservations,
        observations: Observations,
        first_source: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Start a slot for each observation that is NEW in some particle.

        `first_source` is the running number of the first observation. Returns the new slots (n,),
        and the rows of their observations.
        """
        rows = np.flatnonzero(np.any(chosen == NEW, axis=1))
        if len(rows) == 0:
            return rows, rows
        created = self._used_slots.take(len(rows))
        self.slots = grow(self.slots, self._used_slots.n_ever, 0)
        self._give_rows(created)
        slots = self.slots
        slots.generation[created] = self._genealogy.generation
        slots.source[created] = first_source + rows
        if observations.descriptor is not None:
            slots.descriptor[created] = observations.descriptor[rows]
        if observations.label is not None:
            slots.label[created] = observations.label[rows]
        new, own_rows = chosen[rows] == NEW, slots.row[created]
        slots.own.count[own_rows], slots.own.mean_m[own_rows] = new, seen.point_m[rows]
        slots.own.covariance_m2[own_rows] = seen.covariance_m2[rows]
        self.n_landmarks += np.count_nonzero(new, axis=0)
        self.moved(created)
        return created, rows

    def resampled(self, ancestors: np.ndarray) -> None:
        """Go on with the children of `ancestors` (M,)."""
        self._genealogy.resampled(ancestors)
        self.n_landmarks = self.n_landmarks[ancestors]
        self._visit_some()

    def of_particle(self, particle: int, min_count: int) -> tuple[np.ndarray, Estimates]:
        """Slots (n,) of one particle's landmarks, by age, and what it knows of them (n, ...)."""
        slots, genealogy = self.slots, self._genealogy
        used = np.flatnonzero(slots.generation != FREE)
        used = used[np.argsort(slots.source[used])]
        has_row = slots.generation[used] != COMMON
        rowed = used[has_row]
        column = genealogy.ancestors[slots.generation[rowed] % MEMORY, particle]
        known = Estimates(*(values[used, 0] for values in slots.common))
        for values, own in zip(known, slots.own, strict=True):
            values[has_row] = own[slots.row[rowed], column]
        has = known.count >= max(min_count, 1)
        return used[has], Estimates(*(values[has] for values in known))

    def _visit_some(self) -> None:
        """Bring the next rows up to date, so that a round takes exactly _ROUND resamplings.

        Rows in which all particles have the same are freed.
        """
        left = _ROUND - (self._genealogy.generation - 1) % _ROUND
        stop = self._n_visited + -(-(self._used_rows.n_ever - self._n_visited) // left)
        which = self.slots.slot_of_row[self._n_visited : stop]
        which = which[which != FREE]
        which = which[self.bring_up_to_date(which)]
        self._free_rows(which[_settle(self.slots, which)], COMMON)
        self.moved(which)
        self._n_visited = 0 if left == 1 else stop

    def _give_rows(self, which: np.ndarray) -> None:
        """Rows for slots that have none; what is in them means nothing."""
        rows = self._used_rows.take(len(which))
        self.slots = grow(self.slots, 0, self._used_rows.n_ever)
        self.slots.row[which] = rows
        self.slots.slot_of_row[rows] = which

    def _free_rows(self, which: np.ndarray, generation: int) -> None:
        """Take the rows of slots away; what their `generation` says of them from now on."""
        rows = self.slots.row[which]
        self._used_rows.give_back(rows)
        self.slots.slot_of_row[rows] = FREE
        self.slots.generation[which] = generation


class _Pool:
    """Which of the numbers 0, 1, 2, ... are in use; the last to be given back is taken first."""

    def __init__(self) -> None:
        self.n_ever = 0  # all that were ever in use lie below
        self._free: list[int] = []

    def __len__(self) -> int:
        return self.n_ever - len(self._free)

    def take(self, n: int) -> np.ndarray:
        """(n,) int64 numbers, in use from now on."""
        again = [self._free.pop() for _ in range(min(n, len(self._free)))]
        first, self.n_ever = self.n_ever, self.n_ever + n - len(again)
        return np.array([*again, *range(first, self.n_ever)], dtype=np.int64)

    def give_back(self, numbers: np.ndarray) -> None:
        """These are in use no longer."""
        self._free.extend(numbers.tolist())


@kernel
def _inherit(
    own: Estimates,
    common: Estimates,
    row_of: np.ndarray,
    generation_of: np.ndarray,
    which: np.ndarray,
    ancestors: np.ndarray,
    generation: int,
) -> np.ndarray:
    """Write the rows of slots `which` (n,) for a generation; for each whether any particle has it.

    The first four are of slots: all of them would take long to compile.
    """
    n_particles = own.count.shape[1]
    alive = np.zeros(len(which), np.bool_)
    old_mean, old_covariance = np.empty((n_particles, 3)), np.empty((n_particles, 6))
    old_count = np.empty(n_particles, np.int32)
    for i in range(len(which)):
        s = int(which[i])
        r = int(row_of[s])
        written = generation_of[s]
        generation_of[s] = generation
        mean, covariance, count = own.mean_m[r], own.covariance_m2[r], own.count[r]
        if written == generation:
            alive[i] = True
        elif written == COMMON:
            alive[i] = True
            for m in range(n_particles):
                count[m] = common.count[s, 0]
                for k in range(3):
                    mean[m, k] = common.mean_m[s, 0, k]
                for k in range(6):
                    covariance[m, k] = common.covariance_m2[s, 0, k]
        else:
            for m in range(n_particles):
                old_count[m] = count[m]
                for k in range(3):
                    old_mean[m, k] = mean[m, k]
                for k in range(6):
                    old_covariance[m, k] = covariance[m, k]
            for m in range(n_particles):
                parent = ancestors[written % len(ancestors), m]
                count[m] = old_count[parent]
                for k in range(3):
                    mean[m, k] = old_mean[parent, k]
                for k in range(6):
                    covariance[m, k] = old_covariance[parent, k]
                alive[i] |= count[m] > 0
    return alive


def _settle(slots: Slots, which: np.ndarray) -> np.ndarray:
    """Note what is common to all particles; for each slot whether all is."""
    same = np.ones(len(which), dtype=np.bool_)
    for common, own in zip(slots.common, slots.own, strict=True):
        rows = own[slots.row[which]]
        common[which, 0] = rows[:, 0]
        same &= np.all(rows == rows[:, :1], axis=tuple(range(1, rows.ndim)))
    return same


# Steps between two prunings, at least; as many as half of what the last one looked through, so that
# a step's share of them does not grow.
_PRUNED_EVERY = 256


class PathHistory:
    """Poses, ancestors and associations, a list entry a step.

    Of a step only those particles are kept from which some particle of today descends: at first all
    M, and one alone from where the lines of all have met.
    """

    def __init__(self) -> None:
        self._poses: list[Float] = []
        self._ancestors: list[np.ndarray] = []  # of the next step's particles, or of today's
        self._sources: list[np.ndarray] = []
        self._bent = np.empty((0, 3))  # motion of the map since each step, for the first steps
        self._n_pruned = 0
        self._next_pruning = _PRUNED_EVERY

    def add(self, T_map_robot: Float, source: np.ndarray) -> None:
        """One step: poses (M, 3) before resampling, and what each observation went into (K, M)."""
        self._poses.append(T_map_robot.copy())
        self._ancestors.append(np.arange(len(T_map_robot), dtype=np.int32))
        self._sources.append(source)
        if len(self._poses) == self._next_pruning:
            self._prune()

    def resampled(self, ancestors: np.ndarray) -> None:
        """After the last step, particle m became a child of ancestors[m] (M,)."""
        self._ancestors[-1] = ancestors

    def bent(self, T_map_bent: Float) -> None:
        """Every particle's poses (steps, 3) so far move by these motions of the map."""
        known = np.zeros((len(T_map_bent), 3))
        known[: len(self._bent)] = self._bent
        self._bent = compose(T_map_bent, known)

    def path(self, particle: int) -> Float:
        """Poses (steps, 3) of a particle of today and its ancestors, before each resampling."""
        line = self._line(particle)
        own = [poses[m] for poses, m in zip(self._poses, line, strict=True)]
        path = np.array(own).reshape(-1, 3)
        n_bent = len(self._bent)
        return np.concatenate([compose(self._bent, path[:n_bent]), path[n_bent:]])

    def associations(self, particle: int) -> np.ndarray:
        """(n,) int64 source of the landmark each observation went into, -1 where it was dropped."""
        line = self._line(particle)
        own = [source[:, m] for source, m in zip(self._sources, line, strict=True)]
        return np.concatenate([np.empty(0, dtype=np.int64), *own])

    @property
    def n_kept(self) -> int:
        """Particles that are kept, over all steps."""
        return sum(map(len, self._poses))

    def _line(self, particle: int) -> list[int]:
        """Where a particle of today and its ancestors are kept, step by step."""
        line = []
        for ancestors in reversed(self._ancestors):
            particle = int(ancestors[particle])
            line.append(particle)
        return line[::-1]

    def _prune(self) -> None:
        """Forget those whose line has died out."""
        step = len(self._poses) - 1
        while step >= 0:
            kept, place = np.unique(self._ancestors[step], return_inverse=True)
            all_live = len(kept) == len(self._poses[step])
            if all_live and step < self._n_pruned:
                break  # as it was after the last pruning, and so are those before it
            if not all_live:
                self._ancestors[step] = place.astype(np.int32)
                self._poses[step] = self._poses[step][kept]
                self._sources[step] = self._sources[step][:, kept]
                if step > 0:
                    self._ancestors[step - 1] = self._ancestors[step - 1][kept]
            step -= 1
        n_looked_through = len(self._poses) - 1 - step
        self._n_pruned = len(self._poses)
        self._next_pruning = self._n_pruned + max(_PRUNED_EVERY, n_looked_through // 2)
