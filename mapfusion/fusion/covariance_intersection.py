"""Covariance intersection: landmarks whose errors may be correlated in any way.

Julier and Uhlmann (1997), "A non-divergent estimation algorithm in the presence of unknown
correlations": of w A^-1 + (1 - w) B^-1 that of the smallest determinant of the covariance.
"""

import numpy as np

from mapfusion.fusion.fused_map import Component, FusedMap, MergeParameters
from mapfusion.fusion.kalman import fuse_sequentially
from mapfusion.geometry.numerics import Float

_HALVINGS = 40  # of the unit interval: what is left of it is far below any use


class CovarianceIntersection:
    """Never surer than correlations allow; the drift of the maps counts as it does elsewhere."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        return fuse_sequentially(component, parameters, intersect_covariances, use_drift=True)


def intersect_covariances(
    position_i: Float, covariance_i: Float, position_j: Float, covariance_j: Float
) -> tuple[Float, Float]:
    """Pairs of landmarks in one frame.

    Positions are (N, D), covariances (N, D, D), those returned as well.
    """
    A, B = np.linalg.inv(covariance_i), np.linalg.inv(covariance_j)
    # det(w A + (1 - w) B) is that of B times the product of 1 + w m, one for each axis along which
    # the two are both uncorrelated: there A is 1 + m times as much as B
    root = np.linalg.cholesky(covariance_j)
    more = np.linalg.eigvalsh(np.swapaxes(root, 1, 2) @ A @ root).T - 1
    low, high = np.zeros(len(A)), np.ones(len(A))
    for _ in range(_HALVINGS):  # its logarithm is concave in w: the slope falls
        w = (low + high) / 2
        rises = np.sum(more / (1 + w * more), axis=0) > 0
        low, high = np.where(rises, w, low), np.where(rises, high, w)
    w = ((low + high) / 2)[:, None, None]
    covariance = np.linalg.inv(w * A + (1 - w) * B)
    total = np.einsum("nij,nj->ni", w * A, position_i)
    total += np.einsum("nij,nj->ni", (1 - w) * B, position_j)
    position = np.einsum("nij,nj->ni", covariance, total)
    return position, (covariance + np.swapaxes(covariance, 1, 2)) / 2
