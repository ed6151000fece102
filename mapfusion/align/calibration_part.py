"""What the calibration of two robots' cameras leaves open of the motion between their maps."""

import numpy as np

from mapfusion.align.pairs import Pairs
from mapfusion.align.rigid import motion_jacobian, residual_covariances
from mapfusion.se2 import Float, rotation


def calibration_part(T_a_b: Float, pairs: Pairs, drift_sigma_m: float) -> Float:
    """Covariance (3, 3) that T_a_b has of it, beside that of independent residuals.

    To first order: an error that moves all points of a map at once moves the least squares of
    residuals p_a - T p_b, weighed by (S_a + R S_b R^T + s_drift^2 I)^-1, by the sum of their gains.
    The errors of two maps are independent, unless both are of one camera.

    Args:
        T_a_b: (3,) the motion.
        pairs: N that made it, not all in one place; of fewer than two nothing is said.
        drift_sigma_m: s_drift.
    """
    of_maps = pairs.map_a.calibration, pairs.map_b.calibration
    if all(each.is_none for each in of_maps) or len(pairs) < 2:
        return np.zeros((3, 3))
    S = residual_covariances(T_a_b, pairs.covariance_a, pairs.covariance_b)
    W = np.linalg.inv(S + drift_sigma_m**2 * np.eye(2))
    J = motion_jacobian(T_a_b, pairs.p_b)
    weighted = np.swapaxes(J, 1, 2) @ W
    gain = np.linalg.solve(np.sum(weighted @ J, axis=0), weighted)
    by_a, by_b = (
        own.moves_m(p)[:, :, :2] for own, p in zip(of_maps, (pairs.p_a, pairs.p_b), strict=True)
    )
    by_b = -by_b @ rotation(T_a_b[2]).T
    alike = of_maps[0].is_of_one_camera(of_maps[1])
    moved = by_a + by_b if alike else np.concatenate([by_a, by_b], axis=1)
    by = np.einsum("nij,nkj->ik", gain, moved)
    return by @ by.T
