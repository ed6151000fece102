"""What the wheels say of the path: each pose from the one before it (eq. 3)."""

import numpy as np

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.se2 import Float, between, rotation, wrap

# Wheels that do not turn hold the robot, but no closer than this: far below what any sensor of a
# robot tells, and far above what rounding leaves of a system of a thousand poses.
_STILL = np.array([1e-4, 1e-4, 1e-5])  # m, m, rad


def odometry_information(odometry: Float, noise: MotionNoise) -> Float:
    """(T - 1, 3) inverse variances of the increments (T, 3) after the first, which is no motion."""
    sigma = np.array([noise.standard_deviations(each) for each in odometry[1:]]).reshape(-1, 3)
    return 1.0 / (sigma**2 + _STILL**2)


def disturbances(path: Float, odometry: Float) -> Float:
    """(T - 1, 3) what was added to the increments on this path: x_k = x_(k-1) + (u_k + d)."""
    found = between(path[:-1], path[1:]) - odometry[1:]
    found[:, 2] = wrap(found[:, 2])
    return found


def add_odometry(path: Float, odometry: Float, information: Float, S: Float, g: Float) -> None:
    """Add the increments to the normal equations of the poses, S (3T, 3T) lower half and g (3T,)."""
    n = len(path) - 1
    d = disturbances(path, odometry)
    to_robot = np.swapaxes(rotation(path[:-1, 2]), 1, 2)
    way = path[1:, :2] - path[:-1, :2]
    before, after = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))  # of d, by either pose
    after[:, :2, :2], after[:, 2, 2] = to_robot, 1.0
    before[:, :2, :2], before[:, 2, 2] = -to_robot, -1.0
    before[:, :2, 2] = np.einsum("nij,nj->ni", to_robot, np.stack([way[:, 1], -way[:, 0]], 1))
    blocks = S.reshape(n + 1, 3, n + 1, 3)
    gradient, k = g.reshape(n + 1, 3), np.arange(n)
    for J, at in ((before, k), (after, k + 1)):
        weighted = np.swapaxes(J, 1, 2) * information[:, None, :]
        blocks[at, :, at, :] += weighted @ J
        gradient[at] += np.einsum("nij,nj->ni", weighted, d)
    blocks[k + 1, :, k, :] += (np.swapaxes(after, 1, 2) * information[:, None, :]) @ before
