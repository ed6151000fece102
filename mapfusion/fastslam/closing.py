"""Closing loops: what landmarks say that come into view again after a while."""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.bends import SPACING, Bends
from mapfusion.fastslam.sensor import Sightings, innovation, quadratic_form
from mapfusion.fastslam.slots import Slots
from mapfusion.fastslam.update import NEW
from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from mapfusion.symmetric import cholesky, solve_lower, solve_upper

_ROUNDS = 3  # Gauss-Newton steps, as in the proposal
# Landmarks that went out of view together and come back together, for a loop: a false pair or two
# among fewer would bend the path.
_LEAST = 3


class Seen(NamedTuple):
    """What one particle takes a frame for: K observations at the pose that odometry predicts.

    Attributes:
        chosen: (K,) slots, NEW or DROPPED.
        sightings: of all particles.
        particle: which one this is.
        gate: largest squared Mahalanobis distance of a match.
        planar: two degrees of freedom.
    """

    chosen: np.ndarray
    sightings: Sightings
    particle: int
    gate: float
    planar: bool


def motion_by_odometry(T_map_predicted: Float, turn: float, sigma: Float) -> Float:
    """(3, 3) motion of the plane by each standard deviation of the odometry.

    The disturbance shifts the robot in the frame it had before it turned by `turn`, and turns it
    about where it stands at the predicted pose (3,).
    """
    x, y, heading = T_map_predicted
    cos, sin = np.cos(heading - turn), np.sin(heading - turn)
    return np.array([[cos, -sin, y], [sin, cos, -x], [0.0, 0.0, 1.0]]) * sigma


def close_loops(
    bends: Bends, slots: Slots, frame: Seen, by_odometry: Float, probability: float
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
    back = bends.frame + 1 - last > SPACING
    n_free = np.count_nonzero(frame.chosen == NEW) + np.count_nonzero(back)
    motion = np.zeros(3)
    covariance, _, _ = _steps(slots, frame, rows[~back], by_odometry, motion, _ROUNDS)
    drift = n_free / max(len(frame.chosen), 1) * covariance
    rows, last = rows[back], last[back]
    if len(rows) < _LEAST:
        return drift
    group_of = last // SPACING  # what went out of view at about the same time
    groups, size = np.unique(group_of, return_counts=True)
    own = [group_of == group for group in groups[size >= _LEAST]]
    if not own:
        return drift
    said = [_steps(slots, frame, rows[each], by_odometry, motion.copy(), 1) for each in own]
    information, pull = (np.array([each[k] for each in said]) for k in (1, 2))
    when = np.array([last[members].mean() for members in own])
    bends.closed(when, information, pull, covariance, probability)
    return drift


@kernel(error_model="numpy")
def _steps(
    slots: Slots, frame: Seen, rows: np.ndarray, by_odometry: Float, motion: Float, rounds: int
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
    information, pull, covariance = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    eta, right, root, half = np.zeros(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for _ in range(rounds):
        _put_evidence(slots, frame, rows, motion, information, pull)
        for i in range(3):
            right[i] = -eta[i]
            for j in range(3):
                root[i, j] = 1.0 if i == j else 0.0
                for a in range(3):
                    for b in range(3):
                        root[i, j] += by_odometry[a, i] * information[a, b] * by_odometry[b, j]
            for a in range(3):
                right[i] += by_odometry[a, i] * pull[a]
        cholesky(root, 0.0)
        solve_lower(root, right)
        solve_upper(root, right)
        for a in range(3):
            eta[a] += right[a]
        for a in range(3):
            motion[a] = _dot(by_odometry, a, eta[0], eta[1], eta[2])
    # the precision of eta is root root^T, so the motion's covariance is the square of this
    for a in range(3):
        for i in range(3):
            right[i] = by_odometry[a, i]
        solve_lower(root, right)
        for i in range(3):
            half[a, i] = right[i]
    for a in range(3):
        for b in range(3):
            covariance[a, b] = _dot(half, a, half[b, 0], half[b, 1], half[b, 2])
    return covariance, information, pull


@kernel_part(error_model="numpy")
def _dot(A: Float, row: int, x: float, y: float, z: float) -> float:
    return A[row, 0] * x + A[row, 1] * y + A[row, 2] * z


@kernel_part(error_model="numpy")
def _put_evidence(
    slots: Slots, frame: Seen, rows: np.ndarray, motion: Float, information: Float, pull: Float
) -> None:
    """What observations say about a further motion after `motion`, weighed as in the proposal."""
    seen, m, own = frame.sightings, frame.particle, slots.own
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    px = py = pt = xx = xy = yy = xt = yt = tt = 0.0
    for k in rows:
        r = int(slots.row[frame.chosen[k]])
        difference, inverse, _ = innovation(seen, k, own, r, m, frame.planar)
        ixx, ixy, ixz, iyy, iyz, _ = inverse
        at_x, at_y = seen.point_m[k, m, 0], seen.point_m[k, m, 1]
        x, y = cos * at_x - sin * at_y + motion[0], sin * at_x + cos * at_y + motion[1]
        dx, dy, dz = difference[0] + x - at_x, difference[1] + y - at_y, difference[2]
        weight = 1.0 / (1.0 + quadratic_form((dx, dy, dz), inverse) / frame.gate)
        fx = -weight * (ixx * dx + ixy * dy + ixz * dz)
        fy = -weight * (ixy * dx + iyy * dy + iyz * dz)
        ixx, ixy, iyy = weight * ixx, weight * ixy, weight * iyy
        # a turn moves the point by (-y, x)
        ax, ay = ixy * x - ixx * y, iyy * x - ixy * y
        px, py, pt = px + fx, py + fy, pt + (x * fy - y * fx)
        xx, xy, yy = xx + ixx, xy + ixy, yy + iyy
        xt, yt, tt = xt + ax, yt + ay, tt + (x * ay - y * ax)
    pull[0], pull[1], pull[2] = px, py, pt
    information[0, 0], information[1, 1], information[2, 2] = xx, yy, tt
    information[0, 1] = information[1, 0] = xy
    information[0, 2] = information[2, 0] = xt
    information[1, 2] = information[2, 1] = yt
