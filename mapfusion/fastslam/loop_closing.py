"""Loop closing: correct the path and the map when landmarks come into view again.

After resampling, all particles share their past path, and reweighting cannot correct its error.
This error is modelled as drift: a random walk of small motions of the plane, (x, y, angle) about
the map's origin, by which the map turns and shifts as the robot goes on. Small motions add. The
drift is a state at each knot of the path. When landmarks come into view again, the difference of
the drift between two times is observed, and the whole path is corrected by the mean of the drift
given this observation. This is a proposal for a block of past states that uses the observation at
its end (Doucet, Briers, Senecal 2006). Dubbelman and Browning (2015) give the closed form for a
chain of poses; this module handles any number of nested loops.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.landmark_arrays import Slots
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

# Frames between two knots at first. A landmark that was out of view for fewer frames still counts
# as in view: the drift since then is small.
KNOT_SPACING = 20
# Number of knots above which every second one is removed. Few drives close more nested loops, and
# the cost of a closure grows with the square of this number.
_MAX_KNOTS = 64
# Directions whose information is below this share of the largest are not observed: for instance,
# one point does not observe the rotation about itself.
_MIN_INFORMATION = 1e-9
# Smallest correction of the robot's position that is applied: moving the map costs about one step.
_MIN_CORRECTION_M = 1e-3


def between_knots(knots: np.ndarray, frame: np.ndarray) -> Float:
    """Return the weights (n, K) of linear interpolation between K knots at frames (n,)."""
    knot = np.clip(np.searchsorted(knots, frame, side="right") - 1, 0, len(knots) - 2)
    share = (frame - knots[knot]) / (knots[knot + 1] - knots[knot])
    weight, each = np.zeros((len(frame), len(knots))), np.arange(len(frame))
    weight[each, knot], weight[each, knot + 1] = 1 - share, share
    return weight


class DriftModel:
    """Joint Gaussian of the drift at K knots of the path and at the present frame.

    Attributes:
        frame: number of the last frame; -1 before the first.
    """

    def __init__(self) -> None:
        self.frame = -1
        self._knots = np.zeros(1, dtype=np.int64)  # frame numbers, ascending
        self._spacing = KNOT_SPACING
        self._covariance = np.zeros((6, 6))  # of the first knot and the present frame
        self._pending = np.zeros(6)  # mean of the drift that has not yet been corrected

    @classmethod
    def at_knots(cls, frame: int, knots: np.ndarray, covariance: Float) -> "DriftModel":
        """Return the model of a known drift.

        Args:
            frame: the present frame.
            knots: (K,) frames of the knots, ascending, all before the present frame.
            covariance: (3K + 3, 3K + 3) covariance of the drift at the knots and at present.
        """
        model = cls()
        model.frame, model._knots, model._covariance = frame, knots, covariance.copy()
        model._pending = np.zeros(len(covariance))
        return model

    def covariances(self, frame: np.ndarray) -> Float:
        """Return the covariances (n, 3, 3) of the drift at frames (n,)."""
        weight = between_knots(np.append(self._knots, self.frame), frame)
        n = len(self._knots) + 1
        blocks = self._covariance.reshape(n, 3, n, 3)
        return np.einsum("nk,kilj,nl->nij", weight, blocks, weight, optimize=True)

    def add_frame(self, covariance: Float) -> None:
        """Add a frame, in which the drift grows with a covariance (3, 3)."""
        if self.frame - self._knots[-1] >= self._spacing:
            self._knots = np.append(self._knots, self.frame)
            kept_knots = np.arange(len(self._knots) + 1)
            if len(self._knots) > _MAX_KNOTS:
                self._spacing *= 2
                kept_knots = np.append(kept_knots[:-1:2], kept_knots[-1])
            # The new knot starts as a copy of the present state.
            state = (
                3 * np.minimum(kept_knots, len(self._knots) - 1)[:, None] + np.arange(3)
            ).ravel()
            self._covariance = self._covariance[np.ix_(state, state)]
            self._pending = self._pending[state]
            self._knots = self._knots[kept_knots[:-1]]
        self.frame += 1
        self._covariance[-3:, -3:] += covariance

    def add_closure(
        self, frame: np.ndarray, information: Float, pull: Float, now: Float, probability: float
    ) -> None:
        """Update the drift with G groups of landmarks that have come into view again.

        A closure outside the chi-square gate is ignored.

        Args:
            frame: (G,) frame that last showed each group.
            information: (G, 3, 3) information of each group about the motion of the plane that
                corrects the present pose.
            pull: (G, 3) gradient of the log likelihood, the information times that motion.
            now: (3, 3) covariance of the present pose, as a motion of the plane, given the
                landmarks that stayed in view.
            probability: share of true closures inside the gate (chi-square quantile).
        """
        # Whiten: one scalar observation of unit variance for each observed direction.
        value, vector = np.linalg.eigh(information)
        group, observed = np.nonzero(value > _MIN_INFORMATION * value[:, -1:])
        root = np.sqrt(value[group, observed])
        direction = vector[group, :, observed]  # (n, 3)
        seen = np.sum(direction * pull[group], axis=1) / root
        rows = root[:, None] * direction

        # Jacobian: the drift at the present frame minus the drift when the group was last seen.
        knot, share = self._between(frame[group])
        n, each = len(self._knots) + 1, np.arange(len(rows))
        jacobian = np.zeros((len(rows), n, 3))
        jacobian[:, -1] = rows
        jacobian[each, knot] -= (1 - share)[:, None] * rows
        jacobian[each, knot + 1] -= share[:, None] * rows
        jacobian = jacobian.reshape(len(rows), 3 * n)

        # Kalman update
        cross = self._covariance @ jacobian.T
        noise = np.eye(len(rows)) + rows @ now @ rows.T
        innovation = seen - jacobian @ self._pending
        right = np.column_stack([innovation, cross.T])
        solved = np.linalg.solve(jacobian @ cross + noise, right)
        if innovation @ solved[:, 0] > chi_square_bound(probability, len(innovation)):
            return
        covariance = self._covariance - cross @ solved[:, 1:]
        self._covariance = 0.5 * (covariance + covariance.T)
        self._pending = self._pending + cross @ solved[:, 0]

    def take_correction(self, position: Float) -> Float | None:
        """Return the pending correction (K + 1, 3) of the knots and the present frame, once.

        Return None, and keep the correction, if it moves a point at `position` (2,) by less than a
        millimetre.
        """
        correction = self._pending.reshape(-1, 3)
        shift = correction[:, :2] + correction[:, 2:] * [-position[1], position[0]]
        if np.max(np.sum(shift**2, axis=1)) < _MIN_CORRECTION_M**2:
            return None
        self._pending = np.zeros_like(self._pending)
        return correction

    def interpolate(self, correction: Float, frame: np.ndarray) -> Float:
        """Return corrections (n, 3) at frames (n,), given those of the knots and the present."""
        knot, share = self._between(frame)
        return correction[knot] + share[:, None] * (correction[knot + 1] - correction[knot])

    def _between(self, frame: np.ndarray) -> tuple[np.ndarray, Float]:
        """Return the knot (n,) before each frame, and the fraction of the way to the next one."""
        when = np.append(self._knots, self.frame)
        knot = np.clip(np.searchsorted(when, frame, side="right") - 1, 0, len(when) - 2)
        return knot, (frame - when[knot]) / (when[knot + 1] - when[knot])


_ITERATIONS = 3  # Gauss-Newton steps, as in the proposal
# Smallest group of landmarks that closes a loop: in a smaller one, one or two false matches would
# distort the path.
_MIN_GROUP = 3


class FrameAssociation(NamedTuple):
    """Associations of one particle: K observations at the pose predicted by odometry.

    Attributes:
        chosen: (K,) slots, NEW or DROPPED.
        sightings: observations of all particles.
        particle: index of the particle.
        gate: largest squared Mahalanobis distance of a match.
        planar: two degrees of freedom.
    """

    chosen: np.ndarray
    sightings: MapObservations
    particle: int
    gate: float
    planar: bool


def odometry_noise_factor(T_map_predicted: Float, turn: float, sigma: Float) -> Float:
    """Return a factor A (3, 3) of the odometry's covariance A A^T as a motion of the plane.

    Column i is the motion for an odometry error of one standard deviation in component i. The error
    shifts the robot along the axes of the frame before the turn, and turns the robot about its
    position.

    Args:
        T_map_predicted: (3,) pose predicted by odometry.
        turn: heading increment of the odometry, in radians.
        sigma: (3,) standard deviations of the odometry.
    """
    x, y, heading = T_map_predicted
    cos, sin = np.cos(heading - turn), np.sin(heading - turn)
    return np.array([[cos, -sin, y], [sin, cos, -x], [0.0, 0.0, 1.0]]) * sigma


def close_loops(
    drift_model: DriftModel,
    slots: Slots,
    frame: FrameAssociation,
    noise_factor: Float,
    probability: float,
) -> Float:
    """Update the drift up to the frame before if landmarks come into view again.

    The pose estimated from odometry and the landmarks in view is compared with the landmarks that
    come into view again.

    Args:
        drift_model: drift of the path before this frame; updated.
        slots: landmarks; those of `frame.chosen` are up to date.
        frame: associations of one particle.
        noise_factor: (3, 3) of the odometry, from `odometry_noise_factor`.
        probability: share of true closures inside the gate.

    Returns:
        (3, 3) covariance by which the drift grows in this frame: the covariance of the pose, times
        the share of the observations that match no landmark in view. There is no drift while all
        landmarks stay in view.
    """
    rows = np.flatnonzero(frame.chosen >= 0)
    last = slots.last_frame[frame.chosen[rows]]
    returned = drift_model.frame + 1 - last > KNOT_SPACING
    n_unanchored = np.count_nonzero(frame.chosen == NEW) + np.count_nonzero(returned)
    motion = np.zeros(3)
    covariance, _, _ = _gauss_newton(
        slots, frame, rows[~returned], noise_factor, motion, _ITERATIONS
    )
    drift = n_unanchored / max(len(frame.chosen), 1) * covariance
    rows, last = rows[returned], last[returned]
    if len(rows) < _MIN_GROUP:
        return drift
    group_of = last // KNOT_SPACING  # landmarks that went out of view at about the same time
    groups, size = np.unique(group_of, return_counts=True)
    members = [group_of == group for group in groups[size >= _MIN_GROUP]]
    if not members:
        return drift
    steps = [
        _gauss_newton(slots, frame, rows[each], noise_factor, motion.copy(), 1) for each in members
    ]
    information, pull = (np.array([step[k] for step in steps]) for k in (1, 2))
    when = np.array([last[each].mean() for each in members])
    drift_model.add_closure(when, information, pull, covariance, probability)
    return drift


def _gauss_newton(
    slots: Slots,
    frame: FrameAssociation,
    rows: np.ndarray,
    noise_factor: Float,
    motion: Float,
    iterations: int,
) -> tuple[Float, Float, Float]:
    """Correct the predicted pose by Gauss-Newton steps.

    Args:
        slots: the landmarks.
        frame: associations of one particle.
        rows: (n,) observations to use.
        noise_factor: (3, 3) of the odometry, from `odometry_noise_factor`.
        motion: (3,) start of the motion of the plane; updated in place. Unless it is zero, only the
            returned information and gradient are meaningful.
        iterations: number of steps, at least one.

    Returns:
        (3, 3) covariance of the motion; (3, 3) information and (3,) gradient of the log likelihood
        of the observations at the start of the last step.
    """
    A, eta = noise_factor, np.zeros(3)
    root, information, pull = np.eye(3), np.empty((3, 3)), np.empty(3)
    for _ in range(iterations):
        information, pull = _information_and_gradient(slots, frame, rows, motion)
        terms = A[:, None, :, None] * information[:, :, None, None] * A[None, :, None, :]
        root = _sum_in_order(np.eye(3), terms.reshape(9, 3, 3))
        step = _sum_in_order(-eta, A * pull[:, None])
        cholesky(root, 0.0)
        solve_lower(root, step)
        solve_upper(root, step)
        eta += step
        motion[:] = A[:, 0] * eta[0] + A[:, 1] * eta[1] + A[:, 2] * eta[2]
    # The precision of eta is L L^T; the covariance of the motion is B B^T with B = A L^-T.
    half = A.copy()
    for row in half:
        solve_lower(root, row)
    x, y, z = half.T
    return x[:, None] * x + y[:, None] * y + z[:, None] * z, information, pull


def _sum_in_order(first: Float, others: Float) -> Float:
    """Return the sum of an array (...) and others (n, ...), added one after the other."""
    return np.cumsum(np.concatenate([first[None], others]), axis=0)[-1]


def _information_and_gradient(
    slots: Slots, frame: FrameAssociation, rows: np.ndarray, motion: Float
) -> tuple[Float, Float]:
    """Linearise the log likelihood of observations at a motion of the plane.

    Observations have Cauchy weights, as in the proposal.

    Returns:
        (3, 3) information, and (3,) gradient of the log likelihood.
    """
    seen, m, by_particle, r = (
        frame.sightings,
        frame.particle,
        slots.by_particle,
        slots.row[frame.chosen[rows]],
    )
    point, off = seen.point_m[rows, m], seen.point_m[rows, m] - by_particle.mean_m[r, m]
    Z = by_particle.covariance_m2[r, m] + seen.covariance_m2[rows, m]
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
    # the derivative of the point by the angle is (-y, x)
    ax, ay = ixy * x - ixx * y, iyy * x - ixy * y
    terms = np.stack([fx, fy, x * fy - y * fx, ixx, ixy, iyy, ax, ay, x * ay - y * ax], axis=1)
    *pull, xx, xy, yy, xt, yt, tt = _sum_in_order(np.zeros(9), terms)
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]]), np.array(pull)
