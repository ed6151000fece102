"""The maps of M particles, laid out so that a resampling copies none of them.

A slot is one landmark that one observation gave rise to, with the estimates of all particles that
have it side by side. Particles share descriptor and label, which never change. A resampling only
notes who descends from whom (`genealogy.py`); a slot is brought up to date when it comes into view.
Slots that no surviving particle has are freed.
"""

import numpy as np
from numba import njit

from mapfusion.fastslam.genealogy import MEMORY, Genealogy
from mapfusion.fastslam.sensor import Sightings
from mapfusion.fastslam.slots import NEVER, Slots, allocate
from mapfusion.fastslam.update import NEW
from mapfusion.robot_log import Observations
from mapfusion.se2 import Float

_FIRST_CAPACITY = 256
_NOWHERE = (np.inf, np.inf, -np.inf, -np.inf)  # a box that touches none
# In so many resamplings all slots are visited once, wherever they lie. Two visits of a slot are
# then less than twice this apart, which is what the genealogy remembers.
_ROUND = MEMORY // 2


class ParticleMaps:
    """Landmarks of M particles.

    `gate` is the squared Mahalanobis distance that a match may have.
    """

    def __init__(self, n_particles: int, gate: float) -> None:
        self.slots = allocate(_FIRST_CAPACITY, n_particles)
        self.n_landmarks = np.zeros(n_particles, dtype=np.int64)
        self._gate = gate
        self._genealogy = Genealogy(n_particles)
        self._free: list[int] = []
        self._n_used = 0
        self._n_visited = 0

    @property
    def n_slots(self) -> int:
        """Slots in use."""
        return self._n_used - len(self._free)

    def near(self, box_m: Float) -> np.ndarray:
        """Slots whose box touches `box_m` (4,); they may be out of date."""
        return _near(self.slots.box_m[: self._n_used], box_m)

    def bring_up_to_date(self, which: np.ndarray) -> np.ndarray:
        """Write the particle axis of slots for the present generation; free those nobody has.

        Returns:
            (n,) bool, which of them are still in use.
        """
        genealogy = self._genealogy
        alive = _inherit(self.slots, which, genealogy.ancestors, genealogy.generation)
        if not alive.all():
            dead = which[~alive]
            self.slots.generation[dead] = NEVER
            self.slots.box_m[dead] = _NOWHERE
            self._free.extend(dead.tolist())
        return alive

    def moved(self, which: np.ndarray) -> None:
        """Tell that landmarks of these slots, up to date, have changed: they may lie elsewhere."""
        _bound(self.slots, which, self._gate)

    def widen(self, which: np.ndarray, variance_m2: float) -> None:
        """Add to the covariances of these slots' landmarks, along each axis."""
        which = which[self.bring_up_to_date(which)]
        with np.errstate(invalid="ignore"):  # what particles without the landmark have there
            for axis in (0, 3, 5):
                self.slots.covariance_m2[which, :, axis] += variance_m2
        self.moved(which)

    def create(
        self, chosen: np.ndarray, seen: Sightings, observations: Observations, first_source: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Start a slot for each observation that is NEW in some particle.

        `first_source` is the running number of the first observation. Returns the new slots (n,),
        and the rows of their observations.
        """
        rows = np.flatnonzero(np.any(chosen == NEW, axis=1))
        created = np.array([self._take_slot() for _ in rows], dtype=np.int64)
        slots = self.slots
        slots.generation[created] = self._genealogy.generation
        slots.source[created] = first_source + rows
        if observations.descriptor is not None:
            slots.descriptor[created] = observations.descriptor[rows]
        if observations.label is not None:
            slots.label[created] = observations.label[rows]
        _initialise(slots, created, rows, chosen, seen, self.n_landmarks)
        self.moved(created)
        return created, rows

    def resampled(self, ancestors: np.ndarray) -> None:
        """Go on with the children of `ancestors` (M,)."""
        self._genealogy.resampled(ancestors)
        self.n_landmarks = self.n_landmarks[ancestors]
        self._visit_some()

    def of_particle(self, particle: int, min_count: int) -> tuple[np.ndarray, np.ndarray]:
        """Slots (n,) of one particle's landmarks, by age, and whose column to read them in (n,)."""
        slots, genealogy = self.slots, self._genealogy
        used = np.flatnonzero(slots.generation[: self._n_used] != NEVER)
        column = genealogy.ancestors[slots.generation[used] % MEMORY, particle]
        has = slots.count[used, column] >= max(min_count, 1)
        by_age = np.argsort(slots.source[used[has]])
        return used[has][by_age], column[has][by_age]

    def _visit_some(self) -> None:
        """Bring the next slots up to date, so that a round takes exactly _ROUND resamplings."""
        left = _ROUND - (self._genealogy.generation - 1) % _ROUND
        stop = self._n_visited + -(-(self._n_used - self._n_visited) // left)
        which = np.arange(self._n_visited, stop)
        which = which[self.slots.generation[which] != NEVER]
        which = which[self.bring_up_to_date(which)]
        self.moved(which)
        self._n_visited = 0 if left == 1 else stop

    def _take_slot(self) -> int:
        if self._free:
            return self._free.pop()
        if self._n_used == len(self.slots.source):
            self._grow()
        self._n_used += 1
        return self._n_used - 1

    def _grow(self) -> None:
        old = self.slots
        capacity, n_particles = old.count.shape
        self.slots = allocate(2 * capacity, n_particles)
        for new_column, old_column in zip(self.slots, old, strict=True):
            new_column[:capacity] = old_column


@njit(cache=True)
def _inherit(slots: Slots, which: np.ndarray, ancestors: np.ndarray, generation: int) -> np.ndarray:
    n_particles = slots.count.shape[1]
    alive = np.zeros(len(which), dtype=np.bool_)
    mean = np.empty((n_particles, 3))
    covariance = np.empty((n_particles, 6))
    count = np.empty(n_particles, dtype=np.int32)
    for i in range(len(which)):
        s = which[i]
        if slots.generation[s] == generation:
            alive[i] = True
            continue
        parents = ancestors[slots.generation[s] % len(ancestors)]
        slots.generation[s] = generation
        mean[:], covariance[:], count[:] = slots.mean_m[s], slots.covariance_m2[s], slots.count[s]
        for m in range(n_particles):
            parent = parents[m]
            slots.count[s, m] = count[parent]
            if count[parent] > 0:
                alive[i] = True
                for k in range(3):
                    slots.mean_m[s, m, k] = mean[parent, k]
                for k in range(6):
                    slots.covariance_m2[s, m, k] = covariance[parent, k]
    return alive


@njit(cache=True)
def _initialise(
    slots: Slots,
    created: np.ndarray,
    rows: np.ndarray,
    chosen: np.ndarray,
    seen: Sightings,
    n_landmarks: np.ndarray,
) -> None:
    for i in range(len(created)):
        s, k = created[i], rows[i]
        for m in range(len(n_landmarks)):
            if chosen[k, m] != NEW:
                slots.count[s, m] = 0
                continue
            slots.count[s, m] = 1
            slots.mean_m[s, m] = seen.point_m[k, m]
            slots.covariance_m2[s, m] = seen.covariance_m2[k, m]
            n_landmarks[m] += 1


@njit(cache=True)
def _near(boxes: Float, box: Float) -> np.ndarray:
    """Rows of boxes (N, 4) that touch a box; looking at all costs little beside a step."""
    touches = np.empty(len(boxes), dtype=np.bool_)
    for s in range(len(boxes)):
        x = (boxes[s, 0] <= box[2]) & (boxes[s, 2] >= box[0])
        y = (boxes[s, 1] <= box[3]) & (boxes[s, 3] >= box[1])
        touches[s] = x & y
    return np.flatnonzero(touches)


@njit(cache=True)
def _bound(slots: Slots, which: np.ndarray, gate: float) -> None:
    for s in which:
        box = slots.box_m[s]
        box[:2], box[2:] = np.inf, -np.inf
        spread_x = spread_y = 0.0
        for m in range(slots.count.shape[1]):
            if slots.count[s, m] == 0:
                continue
            x, y = slots.mean_m[s, m, 0], slots.mean_m[s, m, 1]
            box[0], box[1] = min(box[0], x), min(box[1], y)
            box[2], box[3] = max(box[2], x), max(box[3], y)
            spread_x = max(spread_x, slots.covariance_m2[s, m, 0])
            spread_y = max(spread_y, slots.covariance_m2[s, m, 3])
        # Inside the gate |dx| <= sqrt(gate (Sigma_xx + R_xx)), at most the sum of both roots: one
        # is the landmark's margin, the other the observation's.
        box[0] -= np.sqrt(gate * spread_x)
        box[2] += np.sqrt(gate * spread_x)
        box[1] -= np.sqrt(gate * spread_y)
        box[3] += np.sqrt(gate * spread_y)
