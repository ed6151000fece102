"""Closing loops: what landmarks say that come into view again after a while."""

from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.bends import SPACING, Bends
from mapfusion.fastslam.sensor import Sightings, innovation, quadratic_form
from mapfusion.fastslam.slots import Slots
from mapfusion.fastslam.update import NEW
from mapfusion.kernels import kernel
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
    motion, covariance = _pose_in_view(slots, frame, rows[~back], by_odometry)
    drift = n_free / max(len(frame.chosen), 1) * covariance
    rows, last = rows[back], last[back]
    if len(rows) < _LEAST:
        return drift
    group_of = last // SPACING  # what went out of view at about the same time
    groups, size = np.unique(group_of, return_counts=True)
    own = [group_of == group for group in groups[size >= _LEAST]]
    if not own:
        return drift
    information, pull = np.zeros((len(own), 3, 3)), np.zeros((len(own), 3))
    for g, members in enumerate(own):
        _add_evidence(slots, frame, rows[members], motion, information[g], pull[g])
    when = np.array([last[members].mean() for members in own])
    bends.closed(when, information, pull, covariance, probability)
    return drift


@kernel(error_model="numpy")
def _pose_in_view(
    slots: Slots, frame: Seen, rows: np.ndarray, by_odometry: Float
) -> tuple[Float, Float]:
    """Motion (3,) of the plane that puts the predicted pose right, and its covariance (3, 3)."""
    information, pull = np.empty((3, 3)), np.empty(3)
    eta, motion, root = np.zeros(3), np.zeros(3), np.empty((3, 3))
    for _ in range(_ROUNDS):
        information[:], pull[:] = 0.0, 0.0
        _add_evidence(slots, frame, rows, motion, information, pull)
        right = -eta
        for i in range(3):
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
        eta += right
        for a in range(3):
            motion[a] = (by_odometry[a] * eta).sum()
    # the precision of eta is root root^T, so the motion's covariance is the square of this
    half = by_odometry.copy()
    for a in range(3):
        solve_lower(root, half[a])
    covariance = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            covariance[a, b] = (half[a] * half[b]).sum()
    return motion, covariance


@kernel(error_model="numpy")
def _add_evidence(
    slots: Slots, frame: Seen, rows: np.ndarray, motion: Float, information: Float, pull: Float
) -> None:
    """Add what observations say about a further motion after `motion`, weighed as in the proposal.

    Information (3, 3), and gradient (3,) of the log likelihood.
    """
    seen, m = frame.sightings, frame.particle
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    for k in rows:
        r = int(slots.row[frame.chosen[k]])
        difference, inverse, _ = innovation(seen, k, slots.own, r, m, frame.planar)
        ixx, ixy, ixz, iyy, iyz, _ = inverse
        px, py = seen.point_m[k, m, 0], seen.point_m[k, m, 1]
        x, y = cos * px - sin * py + motion[0], sin * px + cos * py + motion[1]
        dx, dy, dz = difference[0] + x - px, difference[1] + y - py, difference[2]
        weight = 1.0 / (1.0 + quadratic_form((dx, dy, dz), inverse) / frame.gate)
        fx = -weight * (ixx * dx + ixy * dy + ixz * dz)
        fy = -weight * (ixy * dx + iyy * dy + iyz * dz)
        ixx, ixy, iyy = weight * ixx, weight * ixy, weight * iyy
        # a turn moves the point by (-y, x)
        ax, ay = ixy * x - ixx * y, iyy * x - ixy * y
        pull[0] += fx
        pull[1] += fy
        pull[2] += x * fy - y * fx
        information[0, 0] += ixx
        information[0, 1] += ixy
        information[1, 0] += ixy
        information[1, 1] += iyy
        information[0, 2] += ax
        information[2, 0] += ax
        information[1, 2] += ay
        information[2, 1] += ay
        information[2, 2] += x * ay - y * ax
