"""Proposal distribution of the particles' poses, from odometry and observations.

The motion proposal (eq. 3) samples from the odometry alone. If observations are much more precise
than the odometry, few of these samples have a significant weight, and the error of the survivors
stays in the map. The informed proposal samples from odometry and observations together, as FastSLAM
2.0 does (Montemerlo, Thrun, Koller, Wegbreit 2003). The weights are divided by its density, so the
particles represent the same distribution as with eq. 3 and eq. 10.

A pose is the odometry disturbed by sigma * eta, where sigma are the odometry's standard deviations
and eta is standard normal before any observation.
"""

from enum import StrEnum

import numpy as np

from mapfusion.fastslam.landmark_arrays import LANES, Estimates
from mapfusion.fastslam.measurement import MapObservations, innovation, quadratic_form
from mapfusion.geometry.numerics import Float, cholesky, kernel, solve_lower, solve_upper

# Gauss-Newton steps. Convergence is quadratic: a heading error of 0.1 rad falls to about 0.005 rad
# in the second step and to about 1e-5 rad in the third.
_ITERATIONS = 3
_PAIR_ROWS = 11  # innovation (3), inverse of Z (6), arm from robot to point (2)
_POINT_ROWS = 8  # d(x, y)/d eta_0 and eta_1 (4), cosine and sine of the turn, shift (2)
_SYSTEM_ROWS = 9  # gradient (3), diagonal (3) and other entries (3) of the precision


class Proposal(StrEnum):
    """Distribution from which the particles are sampled."""

    MOTION = "motion"  # the odometry: eq. 3 as printed
    INFORMED = "informed"  # odometry and observations, with corrected weights


@kernel(error_model="numpy")
def with_odometry_noise(
    predicted: MapObservations, T_map_predicted: Float, odometry: Float, sigma: Float
) -> MapObservations:
    """Add the odometry's uncertainty to the covariances of observations at predicted poses.

    Args:
        predicted: observations at the predicted poses.
        T_map_predicted: (M, 3) predicted poses.
        odometry: (3,) increment that the prediction used.
        sigma: (3,) standard deviations of the increment.
    """
    point, pose, turn = predicted.point_m, T_map_predicted, odometry[2]
    covariance = predicted.covariance_m2.copy()
    a, b, w = sigma[0] ** 2, sigma[1] ** 2, sigma[2] ** 2
    by_odometry = np.empty((len(pose), 3))
    for m in range(len(pose)):
        # the disturbance applies in the robot frame before the motion
        cos, sin = np.cos(pose[m, 2] - turn), np.sin(pose[m, 2] - turn)
        by_odometry[m, 0], by_odometry[m, 1] = cos * cos * a + sin * sin * b, cos * sin * (a - b)
        by_odometry[m, 2] = sin * sin * a + cos * cos * b
    for k in range(len(point)):
        for m in range(len(pose)):
            dx, dy = point[k, m, 0] - pose[m, 0], point[k, m, 1] - pose[m, 1]
            covariance[k, m, 0] += by_odometry[m, 0] + w * dy * dy
            covariance[k, m, 1] += by_odometry[m, 1] - w * dx * dy
            covariance[k, m, 3] += by_odometry[m, 2] + w * dx * dx
    return MapObservations(point, covariance)


@kernel(error_model="numpy")
def informed_disturbance(
    by_particle: Estimates,
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
    """Sample disturbances from odometry and observations together.

    The likelihood of the observations is approximated by a Gaussian at its mode, found by
    Gauss-Newton steps from zero. Pairs have the weight 1 / (1 + d^2 / gate) (Cauchy), since a wide
    gate lets false matches pass.

    Args:
        by_particle: estimates of the slots, `Slots.by_particle`.
        row_of: (S,) row of each slot, `Slots.row`.
        chosen: (K, M) slots; negative if there is none.
        predicted: observations at the predicted poses.
        T_map_predicted: (M, 3) predicted poses.
        turn: heading increment of the odometry, in radians.
        sigma: (3,) standard deviations of the odometry.
        gate: scale of the Cauchy weights, a squared Mahalanobis distance.
        planar: two degrees of freedom.
        standard_normal: (M, 3) independent samples.

    Returns:
        (M, 3) eta, and (M,) log of its prior density over the proposal's density.
    """
    eta = np.zeros(T_map_predicted.shape)
    log_ratio = np.empty(len(eta))
    pairs = np.zeros((len(chosen), _PAIR_ROWS * LANES))
    at, system = np.zeros(_POINT_ROWS * LANES), np.zeros(_SYSTEM_ROWS * LANES)
    root, right = np.empty((3, 3)), np.empty(3)
    for first in range(0, len(eta), LANES):
        end = min(first + LANES, len(eta))
        # Gather the pairs of particles `first` to `end`, one row an observation. These values are
        # the same in all steps; Z has the noise rotated by the predicted heading. Particles without
        # a pair have zeros, which add nothing.
        n, point = 0, predicted.point_m
        for k in range(len(chosen)):
            row, is_any = pairs[n], False
            for m in range(first, end):
                s, lane = chosen[k, m], m - first
                if s < 0:
                    for i in range(_PAIR_ROWS):
                        row[i * LANES + lane] = 0.0
                    continue
                is_any, r = True, int(row_of[s])
                difference, inverse, _ = innovation(predicted, k, by_particle, r, m, planar)
                row[lane], row[LANES + lane], row[2 * LANES + lane] = difference
                row[3 * LANES + lane], row[4 * LANES + lane] = inverse[0], inverse[1]
                row[5 * LANES + lane], row[6 * LANES + lane] = inverse[2], inverse[3]
                row[7 * LANES + lane], row[8 * LANES + lane] = inverse[4], inverse[5]
                row[9 * LANES + lane] = point[k, m, 0] - T_map_predicted[m, 0]
                row[10 * LANES + lane] = point[k, m, 1] - T_map_predicted[m, 1]
            n += is_any
        n_pairs = n
        for step in range(_ITERATIONS):
            # Linearise the pose at eta, and start the system with the prior.
            for m in range(first, end):
                lane, heading = m - first, T_map_predicted[m, 2] - turn
                ax, ay = sigma[0] * np.cos(heading), sigma[0] * np.sin(heading)  # by eta_0
                bx, by = -sigma[1] * np.sin(heading), sigma[1] * np.cos(heading)  # by eta_1
                at[lane], at[LANES + lane] = ax, ay
                at[2 * LANES + lane], at[3 * LANES + lane] = bx, by
                at[4 * LANES + lane] = np.cos(sigma[2] * eta[m, 2])
                at[5 * LANES + lane] = np.sin(sigma[2] * eta[m, 2])
                at[6 * LANES + lane] = ax * eta[m, 0] + bx * eta[m, 1]
                at[7 * LANES + lane] = ay * eta[m, 0] + by * eta[m, 1]
                for i in range(3):
                    system[i * LANES + lane] = -eta[m, i]
                    system[(3 + i) * LANES + lane] = 1.0
                    system[(6 + i) * LANES + lane] = 0.0
            # Add the pairs to the gradient of the log density at eta and to the precision.
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
                    # eta moves the point from its prediction
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
                # Solve for the step: lower half of the precision (3, 3) and gradient (3,).
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
                if step == _ITERATIONS - 1:
                    # Sample about eta: the precision is L L^T, so L^-T times a standard normal
                    # vector has the inverse as its covariance.
                    normal = standard_normal[m]
                    for i in range(3):
                        right[i] = normal[i]
                    solve_upper(root, right)
                    for i in range(3):
                        eta[m, i] += right[i]
                    prior = eta[m, 0] ** 2 + eta[m, 1] ** 2 + eta[m, 2] ** 2
                    drawn = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
                    log_det = np.log(root[0, 0] * root[1, 1] * root[2, 2])
                    log_ratio[m] = 0.5 * (drawn - prior) - log_det
    return eta, log_ratio
