"""The paper's fuser: a stationary Kalman filter on each pair of landmarks (eq. 12 to 16)."""

import numpy as np

from mapfusion.fuse.component import Component
from mapfusion.fuse.parameters import MergeParameters
from mapfusion.fuse.sequential import fused_in_turn
from mapfusion.fused_map import FusedMap
from mapfusion.se2 import Float


class Kalman:
    """With the landmarks' covariances as the filter states them, as the paper has it."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        return fused_in_turn(component, parameters, kalman_fused, use_drift=False)


def kalman_fused(
    position_i: Float, covariance_i: Float, position_j: Float, covariance_j: Float
) -> tuple[Float, Float]:
    """Stationary Kalman filter on pairs of landmarks in one frame (eq. 12 to 14).

    Eq. 13 is printed with L_i - L_j, which moves the result away from L_j; the sign here is right.

    Positions are (N, D), covariances (N, D, D), those returned as well.
    """
    # S_i and S_i + S_j are symmetric, so K^T solves (S_i + S_j) K^T = S_i
    gain = np.swapaxes(np.linalg.solve(covariance_i + covariance_j, covariance_i), 1, 2)  # eq. 12
    position = position_i + np.einsum("nij,nj->ni", gain, position_j - position_i)  # eq. 13
    covariance = covariance_i - gain @ covariance_i  # eq. 14
    return position, (covariance + np.swapaxes(covariance, 1, 2)) / 2
