"""Loop closing: correct the path when landmarks come into view again.

Particles that were resampled share their past, and no weight mends what it errs by. That is a walk:
while the robot goes on, the map to come slowly turns and shifts against the one there is. A bend is
such a motion of the plane, (x, y, angle) about the map's origin, where small ones add. At each knot
of the path it is unknown, and when landmarks from before are seen again, the difference of two of
them is observed. What the path then does between is the mean of a Gaussian given that observation:
a proposal for a block of past states that knows the observation at its end (Doucet, Briers, Senecal
2006), for a chain of poses in closed form (Dubbelman, Browning 2015), here with any number of
loops, one inside the other.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.landmarks import Slots
from mapfusion.fastslam.measurement import NEW, MapObservations, quadratic_form
from mapfusion.geometry.numerics import (
    Float,
    chi_square_bound,
    cholesky,
    cofactors,
    solve_lower,
    solve_upper,
    source_of,
)

# Frames between two knots at first. A landmark that has been out of view for less has lost its
# track, and what the path did meanwhile is in the landmarks that stayed.
KNOT_SPACING = 20
# Knots that are kept; with more, every second one goes. A drive seldom closes more loops at once
# than these tell apart, and closing one takes the square of their number.
_MOST_KNOTS = 64
# Directions of a group of sightings that say less than this share of what the best one says, say
# nothing: one point does not tell how the plane turns about it.
_SAYS_NOTHING = 1e-9
# Bends are put off until one moves the robot by this much: moving a map costs as much as a frame.
_WORTH_M = 1e-3


class DriftModel:
    """The bends at K knots and now, jointly Gaussian; each mean is zero once the path has bent."""

    def __init__(self) -> None:
        self.frame = -1  # the last that went by
        self._knots = np.zeros(1, dtype=np.int64)  # their frames, ascending
        self._spacing = KNOT_SPACING
        self._covariance = np.zeros((6, 6))  # of the first knot and of now, which are the map's
        self._due = np.zeros(6)  # what the path has yet to be bent by

    def went_on(self, covariance: Float) -> None:
        """The next frame; `covariance` (3, 3) of what the path may have bent by since the last."""
        if self.frame - self._knots[-1] >= self._spacing:
            self._add_knot()
        self.frame += 1
        self._covariance[-3:, -3:] += covariance

    def closed(
        self, frame: np.ndarray, information: Float, pull: Float, now: Float, probability: float
    ) -> None:
        """Landmarks from before are seen again: where does this bend the path?

        Args:
            frame: (G,) that showed each group of them last.
            information: (G, 3, 3) of each about the motion that would put the robot right.
            pull: (G, 3) gradient of its log likelihood: information times that motion.
            now: (3, 3) covariance of the pose, as a motion, given what has stayed in view.
            probability: share of true closures that are believed (chi-square quantile).
        """
        value, vector = np.linalg.eigh(information)
        group, told = np.nonzero(value > _SAYS_NOTHING * value[:, -1:])
        root = np.sqrt(value[group, told])
        direction = vector[group, :, told]  # (n, 3)
        seen = np.sum(direction * pull[group], axis=1) / root  # of unit variance
        rows = root[:, None] * direction
        knot, share = self._between(frame[group])
        n, each = len(self._knots) + 1, np.arange(len(rows))
        slope = np.zeros((len(rows), n, 3))
        slope[:, -1] = rows
        slope[each, knot] -= (1 - share)[:, None] * rows
        slope[each, knot + 1] -= share[:, None] * rows
        slope = slope.reshape(len(rows), 3 * n)
        spread = self._covariance @ slope.T
        noise = np.eye(len(rows)) + rows @ now @ rows.T
        news = seen - slope @ self._due
        solved = np.linalg.solve(slope @ spread + noise, np.column_stack([news, spread.T]))
        if news @ solved[:, 0] > chi_square_bound(probability, len(news)):
            return
        covariance = self._covariance - spread @ solved[:, 1:]
        self._covariance = 0.5 * (covariance + covariance.T)
        self._due = self._due + spread @ solved[:, 0]

    def due(self, place: Float) -> Float | None:
        """Bends (K + 1, 3) of knots and now that the path has yet to take, and takes with this.

        None as long as none of them would move a point at `place` (2,) by a millimetre.
        """
        bends = self._due.reshape(-1, 3)
        shift = bends[:, :2] + bends[:, 2:] * [-place[1], place[0]]
        if np.max(np.sum(shift**2, axis=1)) < _WORTH_M**2:
            return None
        self._due = np.zeros_like(self._due)
        return bends

    def at(self, bends: Float, frame: np.ndarray) -> Float:
        """Bends (n, 3) at frames (n,), given those of knots and now."""
        knot, share = self._between(frame)
        return bends[knot] + share[:, None] * (bends[knot + 1] - bends[knot])

    def _between(self, frame: np.ndarray) -> tuple[np.ndarray, Float]:
        """(n,) knot before each frame, and how far on the way to the next one, or to now, it is."""
        when = np.append(self._knots, self.frame)
        knot = np.clip(np.searchsorted(when, frame, side="right") - 1, 0, len(when) - 2)
        return knot, (frame - when[knot]) / (when[knot + 1] - when[knot])

    def _add_knot(self) -> None:
        self._knots = np.append(self._knots, self.frame)
        kept = np.arange(len(self._knots) + 1)
        if len(self._knots) > _MOST_KNOTS:
            self._spacing *= 2
            kept = np.append(kept[:-1:2], kept[-1])
        # what is now stands for the new knot and goes on
        state = (3 * np.minimum(kept, len(self._knots) - 1)[:, None] + np.arange(3)).ravel()
        self._covariance = self._covariance[np.ix_(state, state)]
        self._due = self._due[state]
        self._knots = self._knots[kept[:-1]]


_ROUNDS = 3  # Gauss-Newton steps, as in the proposal
# Landmarks that went out of view together and come back together, for a loop: a false pair or two
# among fewer would bend the path.
_LEAST = 3


class FrameAssociation(NamedTuple):
    """What one particle takes a frame for: K observations at the pose that odometry predicts.

    Attributes:
        chosen: (K,) slots, NEW or DROPPED.
        sightings: of all particles.
        particle: which one this is.
        gate: largest squared Mahalanobis distance of a match.
        planar: two degrees of freedom.
    """

    chosen: np.ndarray
    sightings: MapObservations
    particle: int
    gate: float
    planar: bool


def odometry_noise_factor(T_map_predicted: Float, turn: float, sigma: Float) -> Float:
    """(3, 3) motion of the plane by each standard deviation of the odometry.

    The disturbance shifts the robot in the frame it had before it turned by `turn`, and turns it
    about where it stands at the predicted pose (3,).
    """
    x, y, heading = T_map_predicted
    cos, sin = np.cos(heading - turn), np.sin(heading - turn)
    return np.array([[cos, -sin, y], [sin, cos, -x], [0.0, 0.0, 1.0]]) * sigma


def close_loops(
    bends: DriftModel, slots: Slots, frame: FrameAssociation, by_odometry: Float, probability: float
) -> Float:
    """Learn how the path has bent up to the frame before, if landmarks come back into view.

    The pose that odometry and the landmarks in view tell is set against those that come back.

    Args:
        bends: of the path before this frame.
        slots: landmarks, of which those chosen are up to date.
        frame: what a particle sees.
        by_odometry: (3, 3) motion of the plane by each standard deviation of the odometry.
        probability: share of true closures that are believed.

    Returns:
        (3, 3) covariance of what the path may bend by in this frame: as much as the pose is unsure,
        times the share of the frame that hangs on no landmark seen shortly before. Where all
        landmarks stay in view nothing drifts, and where all are exchanged the path goes on with
        this pose's whole error.
    """
    rows = np.flatnonzero(frame.chosen >= 0)
    last = slots.last_frame[frame.chosen[rows]]
    back = bends.frame + 1 - last > KNOT_SPACING
    n_free = np.count_nonzero(frame.chosen == NEW) + np.count_nonzero(back)
    motion = np.zeros(3)
    covariance, _, _ = _steps(slots, frame, rows[~back], by_odometry, motion, _ROUNDS)
    drift = n_free / max(len(frame.chosen), 1) * covariance
    rows, last = rows[back], last[back]
    if len(rows) < _LEAST:
        return drift
    group_of = last // KNOT_SPACING  # what went out of view at about the same time
    groups, size = np.unique(group_of, return_counts=True)
    own = [group_of == group for group in groups[size >= _LEAST]]
    if not own:
        return drift
    said = [_steps(slots, frame, rows[each], by_odometry, motion.copy(), 1) for each in own]
    information, pull = (np.array([each[k] for each in said]) for k in (1, 2))
    when = np.array([last[members].mean() for members in own])
    bends.closed(when, information, pull, covariance, probability)
    return drift


def _steps(
    slots: Slots,
    frame: FrameAssociation,
    rows: np.ndarray,
    by_odometry: Float,
    motion: Float,
    rounds: int,
) -> tuple[Float, Float, Float]:
    """Put the predicted pose right by Gauss-Newton steps.

    Args:
        slots: the landmarks.
        frame: what a particle sees.
        rows: (n,) observations that count.
        by_odometry: (3, 3) motion of the plane by each standard deviation of the odometry.
        motion: (3,) of the plane from where the steps begin; changed. It is (0, 0, 0) unless only
            what the observations say there is wanted.
        rounds: how many steps, at least one.

    Returns:
        (3, 3) the motion's covariance; and of where the last step began what the observations say
        about a further motion: (3, 3) information, and (3,) gradient of the log likelihood.
    """
    A, eta = by_odometry, np.zeros(3)
    root, information, pull = np.eye(3), np.empty((3, 3)), np.empty(3)
    for _ in range(rounds):
        information, pull = _evidence(slots, frame, rows, motion)
        terms = A[:, None, :, None] * information[:, :, None, None] * A[None, :, None, :]
        root = _sum_in_order(np.eye(3), terms.reshape(9, 3, 3))
        step = _sum_in_order(-eta, A * pull[:, None])
        cholesky(root, 0.0)
        solve_lower(root, step)
        solve_upper(root, step)
        eta += step
        motion[:] = A[:, 0] * eta[0] + A[:, 1] * eta[1] + A[:, 2] * eta[2]
    # the precision of eta is root root^T, so the motion's covariance is the square of this
    half = A.copy()
    for row in half:
        solve_lower(root, row)
    x, y, z = half.T
    return x[:, None] * x + y[:, None] * y + z[:, None] * z, information, pull


def _sum_in_order(first: Float, others: Float) -> Float:
    """Return the sum of an array (...) and others (n, ...), added one after the other."""
    return np.cumsum(np.concatenate([first[None], others]), axis=0)[-1]


def _evidence(
    slots: Slots, frame: FrameAssociation, rows: np.ndarray, motion: Float
) -> tuple[Float, Float]:
    """What observations say about a further motion after `motion`, weighed as in the proposal.

    Returns:
        (3, 3) information, and (3,) gradient of the log likelihood.
    """
    seen, m, own, r = frame.sightings, frame.particle, slots.own, slots.row[frame.chosen[rows]]
    point, off = seen.point_m[rows, m], seen.point_m[rows, m] - own.mean_m[r, m]
    Z = own.covariance_m2[r, m] + seen.covariance_m2[rows, m]
    if frame.planar:  # see `innovation`
        off[:, 2] = Z[:, 2] = Z[:, 4] = 0.0
        Z[:, 5] = 1.0
    *adjugate, determinant = source_of(cofactors)(*Z.T)
    inverse = 1.0 / determinant * np.array(adjugate)
    ixx, ixy, ixz, iyy, iyz, _ = inverse
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    at_x, at_y, _ = point.T
    x, y = cos * at_x - sin * at_y + motion[0], sin * at_x + cos * at_y + motion[1]
    dx, dy, dz = off[:, 0] + x - at_x, off[:, 1] + y - at_y, off[:, 2]
    weight = 1.0 / (1.0 + source_of(quadratic_form)((dx, dy, dz), inverse) / frame.gate)
    fx = -weight * (ixx * dx + ixy * dy + ixz * dz)
    fy = -weight * (ixy * dx + iyy * dy + iyz * dz)
    ixx, ixy, iyy = weight * ixx, weight * ixy, weight * iyy
    # a turn moves the point by (-y, x)
    ax, ay = ixy * x - ixx * y, iyy * x - ixy * y
    terms = np.stack([fx, fy, x * fy - y * fx, ixx, ixy, iyy, ax, ay, x * ay - y * ax], axis=1)
    *pull, xx, xy, yy, xt, yt, tt = _sum_in_order(np.zeros(9), terms)
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]]), np.array(pull)
