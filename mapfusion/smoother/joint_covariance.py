"""The joint covariance of a smoothed map: block diagonal plus what the poses have in common.

With the poses eliminated in turn, the landmarks' covariance is D + Y' Y: D the covariance of each
landmark if the poses were known, Y = L^-1 [coupling A^-1], L the factor of the poses' information.
"""

import numpy as np
import scipy.linalg

from mapfusion.se2 import Float
from mapfusion.smoother.smooth import Smoothed


def common_part(smoothed: Smoothed) -> Float:
    """Y (3T - 3, 3L), of which Y' Y is what the poses' errors add to the landmarks' covariance."""
    seen, made = smoothed.seen, smoothed.eliminated
    n_landmarks, n_frames = len(made.covariance_m2), len(smoothed.estimate.path)
    landmark = np.repeat(np.arange(n_landmarks), np.diff(seen.starts))
    gain = made.coupling @ made.covariance_m2[landmark]
    wide = np.zeros((n_frames, 3, n_landmarks, 3))
    np.add.at(wide, (seen.frame, slice(None), landmark), gain)
    right = wide.reshape(3 * n_frames, 3 * n_landmarks)[3:]
    return scipy.linalg.solve_triangular(
        smoothed.factor, right, lower=True, overwrite_b=True, check_finite=False
    )


def joint_covariance(smoothed: Smoothed) -> Float:
    """(3L, 3L) of all landmarks, dense: for small maps."""
    Y = common_part(smoothed)
    joint = Y.T @ Y
    n = len(smoothed.eliminated.covariance_m2)
    blocks, each = joint.reshape(n, 3, n, 3), np.arange(n)
    blocks[each, :, each, :] += smoothed.eliminated.covariance_m2
    return joint
