"""Visual odometry: robust rigid motion of a stereo camera between two frames.

Some links between frames are false: a corner may jump along an edge, lie on an occlusion boundary,
or belong to a moving object. Their descriptors are as similar as those of correct links, but their
errors are much larger, and few of them are enough to rotate a map. In a static world all correct
links agree on one rigid motion. This module estimates the motion and its covariance, and rejects
the links that contradict it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.attitude import Attitude
from mapfusion.camera import StereoCamera
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import (
    Float,
    chi_square_bound,
    cholesky,
    cofactors,
    copy_lower,
    kernel,
    solve_lower,
    solve_upper,
)
from mapfusion.geometry.se3 import inverse

MIN_LINKS = 4  # three links determine a motion; a false link shows among four at the earliest
# Tolerances added to the noise of the points, from far above the noise to zero.
_TOLERANCES_M = (1.0, 0.25, 0.06, 0.015, 0.004, 0.001, 0.0)
_ALL_AFTER = 3  # index of the tolerance from which each start uses all links
_STEPS = 2  # Gauss-Newton steps per tolerance; the estimate of the tolerance before is near
_PARTS = 3  # near, middle and far links; three of the four starts leave one part out
_SIZE = 6  # degrees of freedom: translation and rotation
# Damping, as a share of the diagonal of the normal matrix: unobservable directions (a rotation
# about the line through all points) keep their value. Rounding errors are far below this share.
_DAMPING = 1e-10


@dataclass(frozen=True)
class RigidMotion:
    """Rigid motion of a camera or body between two frames.

    Attributes:
        T_before_after: shape (4, 4).
        covariance: covariance of the error, shape (6, 6): translation along the axes of the frame
            before, then rotation about these axes through the origin. Scaled up if the residuals
            exceed the covariances of the points.
        n_links: number of links that agree with the motion.
    """

    T_before_after: Float
    covariance: Float
    n_links: int

    def of_body(self, T_body_camera: Float) -> "RigidMotion":
        """Return the motion of a body that the camera is fixed to at `T_body_camera` (4, 4)."""
        T = T_body_camera @ self.T_before_after @ inverse(T_body_camera)
        R, arm = T_body_camera[:3, :3], T[:3, :3] @ T_body_camera[:3, 3]
        # a rotation error w of the camera moves the body by arm x w
        jacobian = np.zeros((6, 6))
        jacobian[:3, :3] = jacobian[3:, 3:] = R
        jacobian[:3, 3:] = np.cross(arm, np.eye(3)).T @ R
        return RigidMotion(T, jacobian @ self.covariance @ jacobian.T, self.n_links)


def estimate_rigid_motion(
    p_before_m: Float,
    covariance_before_m2: Float,
    p_after_m: Float,
    covariance_after_m2: Float,
    probability: float,
) -> tuple[np.ndarray, RigidMotion | None]:
    """Estimate the rigid motion on which most links agree.

    Iterated least squares over the links inside the gate (graduated non-convexity). A tolerance
    added to all covariances falls from far above the noise to zero. At first all links have equal
    weights, at last each link has the weight of its own covariance. A single start may fail beside
    a moving object: a few very precise near points dominate where a distant wall does not
    distinguish rotation from translation. So there are four starts, with all links and without the
    near, the middle and the far third. The result with most links is returned.

    Args:
        p_before_m: points in the robot frame before, shape (N, 3).
        covariance_before_m2: their covariances, shape (N, 3, 3).
        p_after_m: the same points in the robot frame after, shape (N, 3).
        covariance_after_m2: their covariances, shape (N, 3, 3).
        probability: share of the correct links inside the gate.

    Returns:
        Mask of the links that agree with the motion, shape (N,) bool, and the motion. The motion is
        None for fewer than four links, with all True, and if fewer than four links agree.
    """
    n = len(p_before_m)
    if n < MIN_LINKS:
        return np.ones(n, dtype=bool), None
    gate = chi_square_bound(probability, 3)
    start = initial_subsets(p_before_m)
    points = (p_before_m, covariance_before_m2, p_after_m, covariance_after_m2)
    agree, T, square, normal = _fit_motions(start, *points, gate)
    best = int(np.argmax(agree.sum(axis=1)))
    best_links = agree[best]
    n_links = int(best_links.sum())
    if n_links < MIN_LINKS:
        return best_links, None
    # The gate lowers the median of the squared Mahalanobis distances by less than one percent.
    ranked = np.sort(square[best][best_links])
    median = (ranked[(n_links - 1) // 2] + ranked[n_links // 2]) / 2
    excess = max(median / chi_square_bound(0.5, 3), 1.0)
    covariance = excess * np.linalg.inv(normal[best])
    return best_links, RigidMotion(T[best], (covariance + covariance.T) / 2, n_links)


def initial_subsets(p_before_m: Float) -> np.ndarray:
    """Return the links of each start, shape (4, N) bool: all, and without a third by distance."""
    n = len(p_before_m)
    by_distance = np.argsort(np.linalg.norm(p_before_m, axis=1), kind="stable")
    part = np.empty(n, dtype=np.int64)
    part[by_distance] = np.arange(n) * _PARTS // n
    return np.not_equal(part, np.array([-1, *range(_PARTS)])[:, None])


@kernel(error_model="numpy")
def _fit_motions(
    start: np.ndarray, p_before: Float, S_before: Float, p_after: Float, S_after: Float, gate: float
) -> tuple[np.ndarray, Float, Float, Float]:
    """Fit a motion to the links of each start.

    Args:
        start: links of each start, shape (B, N) bool.
        p_before: points, shape (N, 3).
        S_before: covariances, shape (N, 3, 3).
        p_after: points, shape (N, 3).
        S_after: covariances, shape (N, 3, 3).
        gate: largest squared Mahalanobis distance of a link that agrees.

    Returns:
        Links that agree with the motion, shape (B, N) bool; motions, shape (B, 4, 4); squared
        Mahalanobis distances, shape (B, N); and damped normal matrices, shape (B, 6, 6).
    """
    n_starts, n = start.shape
    agree, T, square = start.copy(), np.zeros((n_starts, 4, 4)), np.empty((n_starts, n))
    normal = np.empty((n_starts, _SIZE, _SIZE))
    lever, residual, information = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 6))
    step, factor = np.zeros(_SIZE), np.empty((_SIZE, _SIZE))
    for b in range(n_starts):
        for k in range(4):
            T[b, k, k] = 1.0
        for i in range(len(_TOLERANCES_M)):
            variance = _TOLERANCES_M[i] ** 2
            for _ in range(_STEPS):
                # Rotated points (N, 3), the lever arms, and residuals (N, 3).
                own_T = T[b]
                for j in range(len(residual)):
                    x, y, z = p_after[j, 0], p_after[j, 1], p_after[j, 2]
                    for k in range(3):
                        lever[j, k] = own_T[k, 0] * x + own_T[k, 1] * y + own_T[k, 2] * z
                        residual[j, k] = p_before[j, k] - lever[j, k] - own_T[k, 3]
                _information_matrices(T[b], variance, S_before, S_after, information)
                # J^T I J (6, 6) and J^T I r (6,) over the links in use, J = (1, -[lever]x).
                used = agree[b]
                own_normal = normal[b]
                own_normal[:], step[:] = 0.0, 0.0
                for j in range(len(used)):
                    if not used[j]:
                        continue
                    xx, xy, xz = information[j, 0], information[j, 1], information[j, 2]
                    yy, yz, zz = information[j, 3], information[j, 4], information[j, 5]
                    x, y, z = lever[j, 0], lever[j, 1], lever[j, 2]
                    # I J of the rotation, column by column: about x, y and z
                    u0, u1, u2 = xz * y - xy * z, yz * y - yy * z, zz * y - yz * z
                    v0, v1, v2 = xx * z - xz * x, xy * z - yz * x, xz * z - zz * x
                    w0, w1, w2 = xy * x - xx * y, yy * x - xy * y, yz * x - xz * y
                    own_normal[0, 0] += xx
                    own_normal[1, 0] += xy
                    own_normal[1, 1] += yy
                    own_normal[2, 0] += xz
                    own_normal[2, 1] += yz
                    own_normal[2, 2] += zz
                    own_normal[3, 0] += u0
                    own_normal[3, 1] += u1
                    own_normal[3, 2] += u2
                    own_normal[4, 0] += v0
                    own_normal[4, 1] += v1
                    own_normal[4, 2] += v2
                    own_normal[5, 0] += w0
                    own_normal[5, 1] += w1
                    own_normal[5, 2] += w2
                    own_normal[3, 3] += u2 * y - u1 * z
                    own_normal[4, 3] += u0 * z - u2 * x
                    own_normal[4, 4] += v0 * z - v2 * x
                    own_normal[5, 3] += u1 * x - u0 * y
                    own_normal[5, 4] += v1 * x - v0 * y
                    own_normal[5, 5] += w1 * x - w0 * y
                    rx, ry, rz = residual[j, 0], residual[j, 1], residual[j, 2]
                    step[0] += xx * rx + xy * ry + xz * rz
                    step[1] += xy * rx + yy * ry + yz * rz
                    step[2] += xz * rx + yz * ry + zz * rz
                    step[3] += u0 * rx + u1 * ry + u2 * rz
                    step[4] += v0 * rx + v1 * ry + v2 * rz
                    step[5] += w0 * rx + w1 * ry + w2 * rz
                for r in range(_SIZE):
                    for c in range(r):
                        own_normal[c, r] = own_normal[r, c]
                    own_normal[r, r] *= 1 + _DAMPING
                copy_lower(normal[b], factor)
                if cholesky(factor, 0.0):
                    solve_lower(factor, step)
                    solve_upper(factor, step)
                else:  # no link is in use
                    step[:] = 0.0
                _apply_step(T[b], step)
            # Squared Mahalanobis distances after the step.
            for j in range(n):
                xx, xy, xz = information[j, 0], information[j, 1], information[j, 2]
                yy, yz, zz = information[j, 3], information[j, 4], information[j, 5]
                x = residual[j, 0] - step[0] - (step[4] * lever[j, 2] - step[5] * lever[j, 1])
                y = residual[j, 1] - step[1] - (step[5] * lever[j, 0] - step[3] * lever[j, 2])
                z = residual[j, 2] - step[2] - (step[3] * lever[j, 1] - step[4] * lever[j, 0])
                square[b, j] = (
                    xx * x * x
                    + yy * y * y
                    + zz * z * z
                    + 2 * (xy * x * y + xz * x * z + yz * y * z)
                )
                agree[b, j] = square[b, j] <= gate and (i >= _ALL_AFTER or start[b, j])
    return agree, T, square, normal


@kernel(error_model="numpy")
def _information_matrices(
    T: Float, variance: float, S_before: Float, S_after: Float, information: Float
) -> None:
    """Fill in the upper entries (N, 6) of the residuals' information matrices under a motion."""
    a, b, c = T[0, 0], T[0, 1], T[0, 2]
    d, e, f = T[1, 0], T[1, 1], T[1, 2]
    g, h, i = T[2, 0], T[2, 1], T[2, 2]
    for j in range(len(information)):
        before, after = S_before[j], S_after[j]
        xx, xy, xz = after[0, 0], after[0, 1], after[0, 2]
        yy, yz, zz = after[1, 1], after[1, 2], after[2, 2]
        # rows of R S, then R S R^T
        ax, ay, az = a * xx + b * xy + c * xz, a * xy + b * yy + c * yz, a * xz + b * yz + c * zz
        dx, dy, dz = d * xx + e * xy + f * xz, d * xy + e * yy + f * yz, d * xz + e * yz + f * zz
        gx, gy, gz = g * xx + h * xy + i * xz, g * xy + h * yy + i * yz, g * xz + h * yz + i * zz
        axx, axy, axz, ayy, ayz, azz, determinant = cofactors(
            before[0, 0] + variance + ax * a + ay * b + az * c,
            before[0, 1] + ax * d + ay * e + az * f,
            before[0, 2] + ax * g + ay * h + az * i,
            before[1, 1] + variance + dx * d + dy * e + dz * f,
            before[1, 2] + dx * g + dy * h + dz * i,
            before[2, 2] + variance + gx * g + gy * h + gz * i,
        )
        entries, scale = information[j], 1 / determinant
        entries[0], entries[1], entries[2] = scale * axx, scale * axy, scale * axz
        entries[3], entries[4], entries[5] = scale * ayy, scale * ayz, scale * azz


@kernel(error_model="numpy")
def _apply_step(T: Float, step: Float) -> None:
    """Translate and rotate a motion by a step: translation and rotation vector (Rodrigues)."""
    x, y, z = step[3], step[4], step[5]
    angle = math.sqrt(x * x + y * y + z * z)
    # sin(a) / a and (1 - cos(a)) / a^2, exact through zero
    sine = math.sin(angle) / angle if angle > 0 else 1.0
    half = math.sin(angle / 2) / angle if angle > 0 else 0.5
    versine = 2 * half * half
    for c in range(3):
        a, b, d = T[0, c], T[1, c], T[2, c]
        cx, cy, cz = y * d - z * b, z * a - x * d, x * b - y * a
        T[0, c] += sine * cx + versine * (y * cz - z * cy)
        T[1, c] += sine * cy + versine * (z * cx - x * cz)
        T[2, c] += sine * cz + versine * (x * cy - y * cx)
    for k in range(3):
        T[k, 3] += step[k]


_PLANE = [0, 1, 5]  # indices of x, y and the rotation about z
# Without links the motion is predicted by the last speed. The robot may have stopped or turned, so
# the standard deviation of the prediction is the motion itself plus the largest observed step. The
# initial value of the largest step is that of the simulated robot between two frames, m and rad.
_FIRST_STEP = np.array([0.1, 0.1, 0.1])


@dataclass(frozen=True)
class VisualOdometry:
    """Planar motions since the frame before, for T frames.

    Attributes:
        increments: motions in the robot frame of the frame before, shape (T, 3); the first is zero.
        covariance: covariances of the increments, shape (T, 3, 3); the first is zero.
        guessed: motions predicted by the last speed for lack of links, shape (T,) bool.
    """

    increments: Float
    covariance: Float
    guessed: np.ndarray


def visual_odometry(
    motions: Sequence[RigidMotion | None],
    steps: Float,
    camera: StereoCamera,
    T_robot_camera: Float,
    attitude: Attitude | None = None,
) -> VisualOdometry:
    """Compute the odometry of a log from the motions of its camera.

    Args:
        motions: `Tracks.motion` of T frames, of a camera that was assumed level.
        steps: time since the frame before, in usual frame intervals, shape (T,).
        camera: the pair, with its assumed mount.
        T_robot_camera: actual mount, shape (4, 4); axes x ahead, y left, z up.
        attitude: attitudes of the T frames; None for a level body.
    """
    n = len(motions)
    increments, covariance = np.zeros((n, 3)), np.zeros((n, 3, 3))
    guessed = np.array([motion is None for motion in motions])
    guessed[0] = False
    by_robot = robot_motions(motions, camera, T_robot_camera)
    speed, widest = np.zeros(3), _FIRST_STEP  # per usual frame interval
    for k in range(1, n):
        visual_motion = by_robot[k]
        if visual_motion is None:
            increments[k] = steps[k] * speed
            covariance[k] = np.diag((np.abs(increments[k]) + steps[k] * widest) ** 2)
        else:
            level = np.eye(3) if attitude is None else se3.tilt(*attitude.value[k - 1, :2])
            increments[k] = se3.planar(se3.pose(level, np.zeros(3)) @ visual_motion.T_before_after)
            turned = np.kron(np.eye(2), level)
            covariance[k] = (turned @ visual_motion.covariance @ turned.T)[np.ix_(_PLANE, _PLANE)]
            speed = increments[k] / steps[k]
            widest = np.maximum(widest, np.abs(speed))
    return VisualOdometry(increments, covariance, guessed)


def robot_motions(
    motions: Sequence[RigidMotion | None], camera: StereoCamera, T_robot_camera: Float
) -> list[RigidMotion | None]:
    """Convert motions of a camera that was assumed level to motions of the robot.

    Arguments as in `visual_odometry`.
    """
    T_level_camera = se3.pose(np.eye(3), camera.p_robot_left)
    T_robot_level = T_robot_camera @ se3.inverse(T_level_camera)
    return [None if motion is None else motion.of_body(T_robot_level) for motion in motions]
