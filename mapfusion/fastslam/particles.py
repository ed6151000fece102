"""Maps and paths of all particles in shared storage.

A resampling copies no maps; it only extends the genealogy. The row of a slot is brought up to date
when its landmark comes into view. A slot is freed when no surviving particle has its landmark. A
row is freed when all particles inherited it from one ancestor. Hence a landmark out of view takes
one estimate once the particles have a common ancestor, and the cost of a step depends on the
landmarks in view.
"""

import math
from collections.abc import Sequence

import numpy as np

from mapfusion.fastslam.landmark_arrays import (
    BLOCK,
    COMMON,
    FREE,
    NOWHERE,
    Estimates,
    allocate,
    grow,
    transform_boxes,
    update_block_boxes,
    update_boxes,
)
from mapfusion.fastslam.measurement import NEW, MapObservations
from mapfusion.fastslam.resampling import MEMORY, Genealogy
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import compose
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import Observations

_ALONG_AXES = np.array([0, 3, 5])  # of the upper entries of a covariance
_FIRST_SLOTS, _FIRST_ROWS = 4 * BLOCK, 64
# Number of resamplings in which all rows are brought up to date once. Two updates of a row are then
# less than twice this number apart, within the memory of the genealogy.
_UPDATE_PERIOD = MEMORY // 2


class ParticleMaps:
    """Landmarks of M particles.

    Args:
        n_particles: M.
        gate: largest squared Mahalanobis distance of a match.
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
        """Number of slots in use."""
        return len(self._used_slots)

    @property
    def n_rows(self) -> int:
        """Number of slots that have a row."""
        return len(self._used_rows)

    def bring_up_to_date(self, slot_indices: np.ndarray) -> np.ndarray:
        """Update the rows of slots (n,) to the present generation; free slots without a particle.

        Returns:
            (n,) bool, True for a slot that is still in use.
        """
        genealogy = self._genealogy
        self._assign_rows(slot_indices[self.slots.generation[slot_indices] == COMMON])
        slots = self.slots
        alive = _inherit_rows(
            slots.by_particle,
            slots.common,
            slots.row,
            slots.generation,
            slot_indices,
            genealogy.ancestors,
            genealogy.generation,
        )
        if not alive.all():
            dead = slot_indices[~alive]
            self._free_rows(dead, FREE)
            self.slots.box_m[dead] = NOWHERE
            self._used_slots.release(dead)
        return alive

    def update_boxes(self, slot_indices: np.ndarray) -> None:
        """Compute the bounding boxes of slots (n,), whose rows are of the present generation."""
        update_boxes(self.slots, slot_indices, self._gate)

    def inflate(self, slot_indices: np.ndarray, variance_m2: float) -> None:
        """Add a variance to the x, y and z covariance entries of the landmarks of slots (n,)."""
        slot_indices = slot_indices[self.bring_up_to_date(slot_indices)]
        with np.errstate(invalid="ignore"):  # undefined values of particles without the landmark
            covariance_m2 = self.slots.by_particle.covariance_m2
            covariance_m2[self.slots.row[slot_indices, None], :, _ALONG_AXES] += variance_m2
        self.update_boxes(slot_indices)

    def transform(self, T_map_old: Float) -> None:
        """Move the landmarks of all slots (S,) by motions of the plane (S, 3), in every particle.

        The motions are small, so covariances are not rotated.
        """
        slots = self.slots
        slot_indices = np.flatnonzero(slots.generation != FREE)
        x, y, angle = T_map_old[slot_indices].T
        turn = np.array([[math.cos(a), math.sin(a)] for a in angle]).reshape(-1, 2)
        is_common = slots.generation[slot_indices] == COMMON
        for means, rows, moved in (
            (slots.common.mean_m, slot_indices[is_common], is_common),
            (slots.by_particle.mean_m, slots.row[slot_indices[~is_common]], ~is_common),
        ):
            (cos, sin), mean_m = turn[moved].T[:, :, None], means[rows]
            means[rows, :, 0] = cos * mean_m[:, :, 0] - sin * mean_m[:, :, 1] + x[moved, None]
            means[rows, :, 1] = sin * mean_m[:, :, 0] + cos * mean_m[:, :, 1] + y[moved, None]
        transform_boxes(slots, slot_indices, turn, np.stack([x, y], axis=1))
        update_block_boxes(slots, np.arange(len(slots.block_box_m)))

    def create(
        self,
        chosen: np.ndarray,
        map_observations: MapObservations,
        observations: Observations,
        first_source: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Create a slot for each observation that is NEW in some particle.

        Args:
            chosen: (K, M) slot, NEW or DROPPED.
            map_observations: K observations in M maps.
            observations: the same observations, for their descriptors and labels.
            first_source: running number of the first observation.

        Returns:
            (n,) new slots, and (n,) rows of their observations.
        """
        rows = np.flatnonzero(np.any(chosen == NEW, axis=1))
        if len(rows) == 0:
            return rows, rows
        created = self._used_slots.take(len(rows))
        self.slots = grow(self.slots, self._used_slots.n_ever, 0)
        self._assign_rows(created)
        slots = self.slots
        slots.generation[created] = self._genealogy.generation
        slots.source[created] = first_source + rows
        if observations.descriptor is not None:
            self._describe(observations.descriptor.shape[1])
            slots = self.slots
            slots.descriptor[created] = observations.descriptor[rows]
        if observations.label is not None:
            slots.label[created] = observations.label[rows]
        new, own_rows = chosen[rows] == NEW, slots.row[created]
        slots.by_particle.count[own_rows], slots.by_particle.mean_m[own_rows] = (
            new,
            map_observations.point_m[rows],
        )
        slots.by_particle.covariance_m2[own_rows] = map_observations.covariance_m2[rows]
        self.n_landmarks += np.count_nonzero(new, axis=0)
        self.update_boxes(created)
        return created, rows

    def add_common(
        self, landmarks: LandmarkMap, source: np.ndarray, last_frame: np.ndarray
    ) -> np.ndarray:
        """Add landmarks that all particles share.

        Args:
            landmarks: N landmarks.
            source: (N,) numbers that identify the landmarks.
            last_frame: (N,) last frame that showed each landmark.

        Returns:
            (N,) their slots.
        """
        n = len(landmarks)
        slot_indices = self._used_slots.take(n)
        self.slots = grow(self.slots, self._used_slots.n_ever, 0)
        if landmarks.descriptor is not None:
            self._describe(landmarks.descriptor.shape[1])
            self.slots.descriptor[slot_indices] = landmarks.descriptor
        slots = self.slots
        slots.generation[slot_indices] = COMMON
        slots.common.mean_m[slot_indices, 0] = landmarks.position_m
        upper = landmarks.covariance_m2[:, *np.triu_indices(3)]
        slots.common.covariance_m2[slot_indices, 0] = upper
        slots.common.count[slot_indices, 0] = landmarks.count
        slots.source[slot_indices], slots.last_frame[slot_indices] = source, last_frame
        if landmarks.label is not None:
            slots.label[slot_indices] = landmarks.label
        self.n_landmarks += n
        self.update_boxes(slot_indices)
        return slot_indices

    def _describe(self, length: int) -> None:
        """Make room for descriptors of a length, if there is none yet."""
        if self.slots.descriptor.shape[1] != length:
            descriptor = np.full((len(self.slots.label), length), np.nan, dtype=np.float32)
            self.slots = self.slots._replace(descriptor=descriptor)

    def resample(self, ancestors: np.ndarray) -> None:
        """Replace the particles by children of `ancestors` (M,), and update some rows.

        Each call updates the next part of the rows, so that _UPDATE_PERIOD resamplings update all
        rows. Rows with equal estimates in all particles are freed.
        """
        self._genealogy.resample(ancestors)
        self.n_landmarks = self.n_landmarks[ancestors]
        n_remaining = _UPDATE_PERIOD - (self._genealogy.generation - 1) % _UPDATE_PERIOD
        stop = self._n_visited + -(-(self._used_rows.n_ever - self._n_visited) // n_remaining)
        slot_indices = self.slots.slot_of_row[self._n_visited : stop]
        slot_indices = slot_indices[slot_indices != FREE]
        slot_indices = slot_indices[self.bring_up_to_date(slot_indices)]
        is_equal = np.ones(len(slot_indices), dtype=np.bool_)
        for common_values, row_values in zip(
            self.slots.common, self.slots.by_particle, strict=True
        ):
            rows = row_values[self.slots.row[slot_indices]]
            common_values[slot_indices, 0] = rows[:, 0]
            is_equal &= np.all(rows == rows[:, :1], axis=tuple(range(1, rows.ndim)))
        self._free_rows(slot_indices[is_equal], COMMON)
        self.update_boxes(slot_indices)
        self._n_visited = 0 if n_remaining == 1 else stop

    def landmarks_of(self, particle: int, min_count: int) -> tuple[np.ndarray, Estimates]:
        """Return slots (n,) and estimates (n, ...) of one particle's landmarks, by age."""
        slots, genealogy = self.slots, self._genealogy
        used = np.flatnonzero(slots.generation != FREE)
        used = used[np.argsort(slots.source[used])]
        has_row = slots.generation[used] != COMMON
        rowed = used[has_row]
        column = genealogy.ancestors[slots.generation[rowed] % MEMORY, particle]
        estimates = Estimates(*(values[used, 0] for values in slots.common))
        for values, row_values in zip(estimates, slots.by_particle, strict=True):
            values[has_row] = row_values[slots.row[rowed], column]
        has = estimates.count >= max(min_count, 1)
        return used[has], Estimates(*(values[has] for values in estimates))

    def _assign_rows(self, slot_indices: np.ndarray) -> None:
        """Assign rows with undefined content to slots that have none."""
        rows = self._used_rows.take(len(slot_indices))
        self.slots = grow(self.slots, 0, self._used_rows.n_ever)
        self.slots.row[slot_indices] = rows
        self.slots.slot_of_row[rows] = slot_indices

    def _free_rows(self, slot_indices: np.ndarray, generation: int) -> None:
        """Free the rows of slots, and set the `generation` of these slots to FREE or COMMON."""
        rows = self.slots.row[slot_indices]
        self._used_rows.release(rows)
        self.slots.slot_of_row[rows] = FREE
        self.slots.generation[slot_indices] = generation


class _Pool:
    """Pool of the numbers 0, 1, 2, ...; the number released last is taken first."""

    def __init__(self) -> None:
        self.n_ever = 0  # all numbers used so far are smaller
        self._free: list[int] = []

    def __len__(self) -> int:
        return self.n_ever - len(self._free)

    def take(self, n: int) -> np.ndarray:
        """Return (n,) int64 numbers, which are in use until they are released."""
        reused = [self._free.pop() for _ in range(min(n, len(self._free)))]
        first, self.n_ever = self.n_ever, self.n_ever + n - len(reused)
        return np.array([*reused, *range(first, self.n_ever)], dtype=np.int64)

    def release(self, numbers: np.ndarray) -> None:
        """Release numbers."""
        self._free.extend(numbers.tolist())


@kernel
def _inherit_rows(
    by_particle: Estimates,
    common: Estimates,
    row_of: np.ndarray,
    generation_of: np.ndarray,
    slot_indices: np.ndarray,
    ancestors: np.ndarray,
    generation: int,
) -> np.ndarray:
    """Update the rows of slots to a generation.

    Args:
        by_particle: estimates of the rows, `Slots.by_particle`; all of `Slots` would take long to
            compile.
        common: common estimates, `Slots.common`.
        row_of: (S,) row of each slot, `Slots.row`.
        generation_of: (S,) generation of each slot, `Slots.generation`; updated.
        slot_indices: (n,) slots.
        ancestors: ancestors of the particles, `Genealogy.ancestors`.
        generation: the present generation.

    Returns:
        (n,) bool, True if any particle has the landmark.
    """
    n_particles = by_particle.count.shape[1]
    alive = np.zeros(len(slot_indices), np.bool_)
    old_mean, old_covariance = np.empty((n_particles, 3)), np.empty((n_particles, 6))
    old_count = np.empty(n_particles, np.int32)
    for i in range(len(slot_indices)):
        s = int(slot_indices[i])
        r = int(row_of[s])
        written = generation_of[s]
        generation_of[s] = generation
        mean, covariance, count = (
            by_particle.mean_m[r],
            by_particle.covariance_m2[r],
            by_particle.count[r],
        )
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


# Smallest number of steps between two prunings. The interval grows to half the number of steps that
# the last pruning examined, so that the average cost per step stays constant.
_PRUNING_INTERVAL = 256


class PathHistory:
    """Poses, ancestors and associations of each step.

    A pruning removes the particles of a step that have no descendants. Before the last common
    ancestor, one particle per step remains.
    """

    def __init__(self) -> None:
        self._poses: list[Float] = []
        self._ancestors: list[np.ndarray] = []  # of the next step's particles, or the present ones
        self._sources: list[np.ndarray] = []
        self._correction = np.empty((0, 3))  # correction of each step, for the first steps
        self._n_pruned = 0
        self._next_pruning = _PRUNING_INTERVAL

    @classmethod
    def of_path(
        cls, T_map_robot: Float, sources: Sequence[np.ndarray], n_particles: int
    ) -> "PathHistory":
        """Return the history of particles that share their past.

        Args:
            T_map_robot: (steps, 3) their path.
            sources: (K,) sources of the observations of each step.
            n_particles: number of present particles.
        """
        history, n = cls(), len(T_map_robot)
        history._poses = list(T_map_robot[:, None])
        history._sources = [source[:, None].astype(np.int32) for source in sources]
        history._ancestors = [np.zeros(1, dtype=np.int32) for _ in range(n - 1)]
        history._ancestors.append(np.zeros(n_particles, dtype=np.int32))
        history._n_pruned, history._next_pruning = n, n + _PRUNING_INTERVAL
        return history

    def add(self, T_map_robot: Float, source: np.ndarray) -> None:
        """Add a step: poses (M, 3) before resampling, and sources (K, M) of the observations."""
        self._poses.append(T_map_robot.copy())
        self._ancestors.append(np.arange(len(T_map_robot), dtype=np.int32))
        self._sources.append(source)
        if len(self._poses) < self._next_pruning:
            return
        # Remove particles without descendants.
        step = len(self._poses) - 1
        while step >= 0:
            kept, index_in_kept = np.unique(self._ancestors[step], return_inverse=True)
            all_kept = len(kept) == len(self._poses[step])
            if all_kept and step < self._n_pruned:
                break  # unchanged since the last pruning, and so are all earlier steps
            if not all_kept:
                self._ancestors[step] = index_in_kept.astype(np.int32)
                self._poses[step] = self._poses[step][kept]
                self._sources[step] = self._sources[step][:, kept]
                if step > 0:
                    self._ancestors[step - 1] = self._ancestors[step - 1][kept]
            step -= 1
        n_examined = len(self._poses) - 1 - step
        self._n_pruned = len(self._poses)
        self._next_pruning = self._n_pruned + max(_PRUNING_INTERVAL, n_examined // 2)

    def resample(self, ancestors: np.ndarray) -> None:
        """Record that particle m became a child of ancestors[m] (M,) after the last step."""
        self._ancestors[-1] = ancestors

    def correct(self, T_map_old: Float) -> None:
        """Move the poses of all particles by motions of the map (steps, 3), one for each step."""
        previous_correction = np.zeros((len(T_map_old), 3))
        previous_correction[: len(self._correction)] = self._correction
        self._correction = compose(T_map_old, previous_correction)

    def path(self, particle: int) -> Float:
        """Return the poses (steps, 3) of a present particle and its ancestors."""
        ancestor_indices = self._ancestor_indices(particle)
        ancestor_poses = [poses[m] for poses, m in zip(self._poses, ancestor_indices, strict=True)]
        path = np.array(ancestor_poses).reshape(-1, 3)
        n_corrected = len(self._correction)
        return np.concatenate([compose(self._correction, path[:n_corrected]), path[n_corrected:]])

    def associations(self, particle: int) -> np.ndarray:
        """Return the source (n,) int64 of each observation's landmark, -1 for dropped ones."""
        ancestor_indices = self._ancestor_indices(particle)
        ancestor_sources = [
            source[:, m] for source, m in zip(self._sources, ancestor_indices, strict=True)
        ]
        return np.concatenate([np.empty(0, dtype=np.int64), *ancestor_sources])

    def last_associations(self, particle: int) -> np.ndarray:
        """Return the source (K,) of each landmark in the last step, -1 for dropped observations."""
        return self._sources[-1][:, self._ancestors[-1][particle]]

    @property
    def n_kept(self) -> int:
        """Number of stored particles, summed over all steps."""
        return sum(map(len, self._poses))

    def _ancestor_indices(self, particle: int) -> list[int]:
        """Return the index of a present particle's ancestor in each step."""
        indices = []
        for ancestors in reversed(self._ancestors):
            particle = int(ancestors[particle])
            indices.append(particle)
        return indices[::-1]
