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

from mapfusion.fastslam.landmarks import LANES, Estimates
from mapfusion.fastslam.measurement import MapObservations, innovation, quadratic_form
from mapfusion.geometry.numerics import Float, cholesky, kernel, solve_lower, solve_upper

# Gauss-Newton steps; the turn of a frame is off by 0.1 rad at most, which the second step makes
# 0.005 and the third nothing.
_ROUNDS = 3
_PAIR = 11  # rows kept of a pair, see _gather_pairs
_AT, _SYSTEM = 8, 9  # rows of where it is linearised, and of the system there, see _put_linearised


class Proposal(StrEnum):
    """What particles are drawn from."""

    MOTION = "motion"  # the odometry: eq. 3 as printed
    INFORMED = "informed"  # odometry and observations, with the weights made good


def with_odometry_noise(
    predicted: MapObservations, T_map_predicted: Float, odometry: Float, sigma: Float
) -> MapObservations:
    """Sightings at the predicted poses with the odometry's uncertainty in their covariances.

    Poses are (M, 3), odometry and its standard deviations `sigma` (3,).
    """
    covariance = predicted.covariance_m2.copy()
    _widen(predicted.point_m, covariance, T_map_predicted, odometry[2], sigma)
    return MapObservations(predicted.point_m, covariance)


@kernel(error_model="numpy")
def _widen(point: Float, covariance: Float, pose: Float, turn: float, sigma: Float) -> None:
    a, b, w = sigma[0] ** 2, sigma[1] ** 2, sigma[2] ** 2
    by_odometry = np.empty((len(pose), 3))
    for m in range(len(pose)):
        # the disturbance is added in the frame that the robot had before the motion
        cos, sin = np.cos(pose[m, 2] - turn), np.sin(pose[m, 2] - turn)
        by_odometry[m, 0], by_odometry[m, 1] = cos * cos * a + sin * sin * b, cos * sin * (a - b)
        by_odometry[m, 2] = sin * sin * a + cos * cos * b
    for k in range(len(point)):
        for m in range(len(pose)):
            dx, dy = point[k, m, 0] - pose[m, 0], point[k, m, 1] - pose[m, 1]
            covariance[k, m, 0] += by_odometry[m, 0] + w * dy * dy
            covariance[k, m, 1] += by_odometry[m, 1] - w * dx * dy
            covariance[k, m, 3] += by_odometry[m, 2] + w * dx * dx


@kernel(error_model="numpy")
def informed_disturbance(
    own: Estimates,
    row_of: np.ndarray,
    chosen: np.ndarray,
    predicted: MapObservations,
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
    `own` and `row_of` are the `own` and `row` of slots, `chosen` (K, M) slots or negative, `turn`
    the heading part of the odometry, `sigma` (3,) its standard deviations, `standard_normal` (M, 3)
    independent draws. Returns (M, 3) eta, and (M,)
    log of its prior density over the density it was drawn from.
    """
    eta = np.zeros(T_map_predicted.shape)
    log_ratio = np.empty(len(eta))
    pairs = np.zeros((len(chosen), _PAIR * LANES))
    at, system = np.zeros(_AT * LANES), np.zeros(_SYSTEM * LANES)
    root, right = np.empty((3, 3)), np.empty(3)
    for first in range(0, len(eta), LANES):
        end = min(first + LANES, len(eta))
        # Fill rows of innovation (3), inverse of Z (6) and arm from robot to point (2); their
        # number.
        # What does not change from step to step; Z with the noise turned by the predicted
        # heading. Of a row each number is there for the particles from `first` to `end`, zero for
        # those without a pair, to which it adds nothing.
        n, point = 0, predicted.point_m
        for k in range(len(chosen)):
            row, is_any = pairs[n], False
            for m in range(first, end):
                s, lane = chosen[k, m], m - first
                if s < 0:
                    for i in range(_PAIR):
                        row[i * LANES + lane] = 0.0
                    continue
                is_any, r = True, int(row_of[s])
                difference, inverse, _ = innovation(predicted, k, own, r, m, planar)
                row[lane], row[LANES + lane], row[2 * LANES + lane] = difference
                row[3 * LANES + lane], row[4 * LANES + lane] = inverse[0], inverse[1]
                row[5 * LANES + lane], row[6 * LANES + lane] = inverse[2], inverse[3]
                row[7 * LANES + lane], row[8 * LANES + lane] = inverse[4], inverse[5]
                row[9 * LANES + lane] = point[k, m, 0] - T_map_predicted[m, 0]
                row[10 * LANES + lane] = point[k, m, 1] - T_map_predicted[m, 1]
            n += is_any
        n_pairs = n
        for step in range(_ROUNDS):
            for m in range(first, end):
                before = T_map_predicted[m, 2] - turn
                _put_linearised(before, sigma, eta[m], m - first, at, system)
            # Add what pairs say to the gradients of the log density at eta, and to the
            # precisions.
            filled = pairs[:n_pairs]
            sigma_turn = sigma[2]
            for n in range(len(filled)):
                pair = filled[n]
                for m in range(LANES):
                    ax, ay, bx, by = at[m], at[LANES + m], at[2 * LANES + m], at[3 * LANES + m]
                    cos, sin = at[4 * LANES + m], at[5 * LANES + m]
                    dz, ixx, ixy = pair[2 * LANES + m], pair[3 * LANES + m], pair[4 * LANES + m]
                    ixz, iyy = pair[5 * LANES + m], pair[6 * LANES + m]
                    iyz, izz = pair[7 * LANES + m], pair[8 * LANES + m]
                    rx, ry = pair[9 * LANES + m], pair[10 * LANES + m]
                    # eta moves the point from where it was predicted
                    tx, ty = cos * rx - sin * ry, sin * rx + cos * ry
                    dx = pair[m] + (at[6 * LANES + m] + tx - rx)
                    dy = pair[LANES + m] + (at[7 * LANES + m] + ty - ry)
                    distance = quadratic_form((dx, dy, dz), (ixx, ixy, ixz, iyy, iyz, izz))
                    weight = 1.0 / (1.0 + distance / gate)
                    cx, cy = -sigma_turn * ty, sigma_turn * tx  # d(point) / d eta_2
                    wx = weight * (ixx * dx + ixy * dy + ixz * dz)
                    wy = weight * (ixy * dx + iyy * dy + iyz * dz)
                    system[m] -= ax * wx + ay * wy
                    system[LANES + m] -= bx * wx + by * wy
                    system[2 * LANES + m] -= cx * wx + cy * wy
                    axx, axy, ayy = weight * ixx, weight * ixy, weight * iyy
                    system[3 * LANES + m] += ax * ax * axx + 2 * ax * ay * axy + ay * ay * ayy
                    system[4 * LANES + m] += bx * bx * axx + 2 * bx * by * axy + by * by * ayy
                    system[5 * LANES + m] += cx * cx * axx + 2 * cx * cy * axy + cy * cy * ayy
                    system[6 * LANES + m] += (
                        ax * bx * axx + (ax * by + ay * bx) * axy + ay * by * ayy
                    )
                    system[7 * LANES + m] += (
                        ax * cx * axx + (ax * cy + ay * cx) * axy + ay * cy * ayy
                    )
                    system[8 * LANES + m] += (
                        bx * cx * axx + (bx * cy + by * cx) * axy + by * cy * ayy
                    )
            for m in range(first, end):
                # A particle's precision (3, 3) of eta, its lower half, and the gradient (3,).
                lane = m - first
                for i in range(3):
                    right[i] = system[i * LANES + lane]
                    root[i, i] = system[(3 + i) * LANES + lane]
                root[1, 0], root[2, 0] = system[6 * LANES + lane], system[7 * LANES + lane]
                root[2, 1] = system[8 * LANES + lane]
                cholesky(root, 0.0)
                solve_lower(root, right)
                solve_upper(root, right)
                for i in range(3):
                    eta[m, i] += right[i]
                if step == _ROUNDS - 1:
                    log_ratio[m] = _draw(root, standard_normal[m], right, eta[m])
    return eta, log_ratio


@kernel(error_model="numpy")
def _draw(root: Float, standard_normal: Float, pull: Float, eta: Float) -> float:
    """Draw about eta (3,), in place; the log of the density before over that of the draw."""
    # the precision is root root^T, so root^-T times a standard normal has its inverse
    for i in range(3):
        pull[i] = standard_normal[i]
    solve_upper(root, pull)
    for i in range(3):
        eta[i] += pull[i]
    prior = eta[0] ** 2 + eta[1] ** 2 + eta[2] ** 2
    drawn = standard_normal[0] ** 2 + standard_normal[1] ** 2 + standard_normal[2] ** 2
    return 0.5 * (drawn - prior) - np.log(root[0, 0] * root[1, 1] * root[2, 2])


@kernel(error_model="numpy")
def _put_linearised(
    before: float, sigma: Float, eta: Float, lane: int, at: Float, system: Float
) -> None:
    """Where a particle is linearised at, and its system before anything is seen."""
    ax, ay = sigma[0] * np.cos(before), sigma[0] * np.sin(before)  # d(x, y) / d eta_0
    bx, by = -sigma[1] * np.sin(before), sigma[1] * np.cos(before)  # d(x, y) / d eta_1
    at[lane], at[LANES + lane] = ax, ay
    at[2 * LANES + lane], at[3 * LANES + lane] = bx, by
    at[4 * LANES + lane] = np.cos(sigma[2] * eta[2])
    at[5 * LANES + lane] = np.sin(sigma[2] * eta[2])
    at[6 * LANES + lane] = ax * eta[0] + bx * eta[1]
    at[7 * LANES + lane] = ay * eta[0] + by * eta[1]
    for i in range(3):
        system[i * LANES + lane] = -eta[i]
        system[(3 + i) * LANES + lane] = 1.0
        system[(6 + i) * LANES + lane] = 0.0
