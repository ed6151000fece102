"""Where to put particles so that the observations do not throw most of them away.

Drawn from the odometry alone (eq. 3), a cloud is as wide as the odometry is bad. A camera that sees
fifty corners to a fraction of a pixel tells the pose a hundred times better, so of 200 particles
one or two are left in every frame, and what they err by stays in the map. The informed proposal
draws from what odometry and observations say together, as FastSLAM 2.0 does (Montemerlo, Thrun,
Koller, Wegbreit 2003), and divides by its density: the particles stand for the same distribution as
with eq. 3 and eq. 10, there are only more of them where it is.

Everything is in units of the odometry's standard deviations: a pose is the odometry disturbed by
sigma * eta, and eta is standard normal before anything is seen.
"""

from enum import StrEnum

import numpy as np
from numba import njit

from mapfusion.fastslam.sensor import Sightings, innovation, quadratic_form
from mapfusion.fastslam.slots import Slots
from mapfusion.se2 import Float
from mapfusion.symmetric import cholesky, solve_lower, solve_upper

# Gauss-Newton steps; the turn of a frame is off by 0.1 rad at most, which the second step makes
# 0.005 and the third nothing.
_ROUNDS = 3
_PAIR = 11  # numbers kept of a pair, see _gather_pairs


class Proposal(StrEnum):
    """What particles are drawn from."""

    MOTION = "motion"  # the odometry: eq. 3 as printed
    INFORMED = "informed"  # odometry and observations, with the weights made good


def widened(
    predicted: Sightings, T_map_predicted: Float, odometry: Float, sigma: Float
) -> Sightings:
    """Sightings at the predicted poses with the odometry's uncertainty in their covariances.

    Poses are (M, 3), odometry and its standard deviations `sigma` (3,).
    """
    covariance = predicted.covariance_m2.copy()
    _widen(predicted.point_m, covariance, T_map_predicted, odometry[2], sigma)
    return Sightings(predicted.point_m, covariance)


@njit(cache=True, error_model="numpy")
def _widen(point: Float, covariance: Float, pose: Float, turn: float, sigma: Float) -> None:
    for m in range(len(pose)):
        # the disturbance is added in the frame that the robot had before the motion
        cos, sin = np.cos(pose[m, 2] - turn), np.sin(pose[m, 2] - turn)
        a, b, w = sigma[0] ** 2, sigma[1] ** 2, sigma[2] ** 2
        xx, yy = cos * cos * a + sin * sin * b, sin * sin * a + cos * cos * b
        xy = cos * sin * (a - b)
        for k in range(len(point)):
            dx, dy = point[k, m, 0] - pose[m, 0], point[k, m, 1] - pose[m, 1]
            covariance[k, m, 0] += xx + w * dy * dy
            covariance[k, m, 1] += xy - w * dx * dy
            covariance[k, m, 3] += yy + w * dx * dx


@njit(cache=True, error_model="numpy")
def informed_disturbance(
    slots: Slots,
    chosen: np.ndarray,
    predicted: Sightings,
    T_map_predicted: Float,
    turn: float,
    sigma: Float,
    gate: float,
    planar: bool,
    standard_normal: Float,
) -> tuple[Float, Float]:
    """Draw disturbances from odometry and observations together.

    The observations' part is a Gaussian at the most probable eta, found by Gauss-Newton steps from
    zero. Pairs weigh 1 / (1 + d^2 / gate) (Cauchy), since a wide gate lets false ones in.
    `chosen` (K, M) is negative for none, `turn` the heading part of the odometry, `sigma` (3,) its
    standard deviations, `standard_normal` (M, 3) independent draws. Returns (M, 3) eta, and (M,)
    log of its prior density over the density it was drawn from.
    """
    eta = np.zeros(T_map_predicted.shape)
    log_ratio = np.empty(len(eta))
    pairs = np.empty((len(chosen), _PAIR))
    root, right, pull = np.empty((3, 3)), np.empty(3), np.empty(3)
    for m in range(len(eta)):
        n_pairs = _gather_pairs(slots, chosen, predicted, T_map_predicted, planar, m, pairs)
        before = T_map_predicted[m, 2] - turn
        for _ in range(_ROUNDS):
            _normal_equations(pairs[:n_pairs], before, sigma, gate, eta[m], root, right)
            cholesky(root, 0.0)
            solve_lower(root, right)
            solve_upper(root, right)
            for i in range(3):
                eta[m, i] += right[i]
        # the precision is root root^T, so root^-T times a standard normal has its inverse
        for i in range(3):
            pull[i] = standard_normal[m, i]
        solve_upper(root, pull)
        for i in range(3):
            eta[m, i] += pull[i]
        prior = eta[m, 0] ** 2 + eta[m, 1] ** 2 + eta[m, 2] ** 2
        drawn = standard_normal[m, 0] ** 2 + standard_normal[m, 1] ** 2 + standard_normal[m, 2] ** 2
        log_ratio[m] = 0.5 * (drawn - prior) - np.log(root[0, 0] * root[1, 1] * root[2, 2])
    return eta, log_ratio


@njit(cache=True, error_model="numpy")
def _gather_pairs(
    slots: Slots,
    chosen: np.ndarray,
    predicted: Sightings,
    pose: Float,
    planar: bool,
    m: int,
    pairs: Float,
) -> int:
    """Fill rows of innovation (3), inverse of Z (6) and arm from robot to point (2); their number.

    What does not change from step to step; Z with the noise turned by the predicted heading.
    """
    n = 0
    for k in range(len(chosen)):
        s = chosen[k, m]
        if s < 0:
            continue
        point, row, r = predicted.point_m[k], pairs[n], int(slots.row[s])
        difference, inverse, _ = innovation(predicted, k, slots.own, r, m, planar)
        row[0], row[1], row[2] = difference
        row[3], row[4], row[5], row[6], row[7], row[8] = inverse
        row[9], row[10] = point[m, 0] - pose[m, 0], point[m, 1] - pose[m, 1]
        n += 1
    return n


@njit(cache=True, error_model="numpy")
def _normal_equations(
    pairs: Float, before: float, sigma: Float, gate: float, eta: Float, normal: Float, right: Float
) -> None:
    """Fill the precision (3, 3) of eta and the gradient (3,) of the log density at eta."""
    ax, ay = sigma[0] * np.cos(before), sigma[0] * np.sin(before)  # d(x, y) / d eta_0
    bx, by = -sigma[1] * np.sin(before), sigma[1] * np.cos(before)  # d(x, y) / d eta_1
    cos, sin = np.cos(sigma[2] * eta[2]), np.sin(sigma[2] * eta[2])
    shift_x, shift_y = ax * eta[0] + bx * eta[1], ay * eta[0] + by * eta[1]
    n00 = n11 = n22 = 1.0
    n10 = n20 = n21 = 0.0
    r0, r1, r2 = -eta[0], -eta[1], -eta[2]
    for n in range(len(pairs)):
        dz, ixx, ixy, ixz = pairs[n, 2], pairs[n, 3], pairs[n, 4], pairs[n, 5]
        iyy, iyz, izz = pairs[n, 6], pairs[n, 7], pairs[n, 8]
        rx, ry = pairs[n, 9], pairs[n, 10]
        # eta moves the point from where it was predicted
        tx, ty = cos * rx - sin * ry, sin * rx + cos * ry
        dx = pairs[n, 0] + (shift_x + tx - rx)
        dy = pairs[n, 1] + (shift_y + ty - ry)
        distance = quadratic_form((dx, dy, dz), (ixx, ixy, ixz, iyy, iyz, izz))
        weight = 1.0 / (1.0 + distance / gate)
        cx, cy = -sigma[2] * ty, sigma[2] * tx  # d(point) / d eta_2
        wx = weight * (ixx * dx + ixy * dy + ixz * dz)
        wy = weight * (ixy * dx + iyy * dy + iyz * dz)
        r0 -= ax * wx + ay * wy
        r1 -= bx * wx + by * wy
        r2 -= cx * wx + cy * wy
        axx, axy, ayy = weight * ixx, weight * ixy, weight * iyy
        n00 += ax * ax * axx + 2 * ax * ay * axy + ay * ay * ayy
        n11 += bx * bx * axx + 2 * bx * by * axy + by * by * ayy
        n22 += cx * cx * axx + 2 * cx * cy * axy + cy * cy * ayy
        n10 += ax * bx * axx + (ax * by + ay * bx) * axy + ay * by * ayy
        n20 += ax * cx * axx + (ax * cy + ay * cx) * axy + ay * cy * ayy
        n21 += bx * cx * axx + (bx * cy + by * cx) * axy + by * cy * ayy
    normal[0, 0], normal[1, 1], normal[2, 2] = n00, n11, n22
    normal[1, 0], normal[2, 0], normal[2, 1] = n10, n20, n21
    right[0], right[1], right[2] = r0, r1, r2
