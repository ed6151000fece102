"""Covariance intersection: fusion of landmarks whose errors have an unknown correlation.

Julier and Uhlmann (1997), "A non-divergent estimation algorithm in the presence of unknown
correlations". The fused information is w A^-1 + (1 - w) B^-1, with the w of least determinant of
the covariance.
"""

import numpy as np

from mapfusion.fusion.fusers import Component, FusedMap, MergeParameters
from mapfusion.fusion.kalman import fuse_sequentially
from mapfusion.geometry.numerics import Float

_HALVINGS = 40  # bisections of the unit interval; the error of w is then 1e-12


class CovarianceIntersection:
    """Covariance intersection of the landmarks, with drift added to their covariances."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the maps of a component."""
        return fuse_sequentially(component, parameters, intersect_covariances, use_drift=True)


def intersect_covariances(
    position_i: Float, covariance_i: Float, position_j: Float, covariance_j: Float
) -> tuple[Float, Float]:
    """Fuse N pairs of landmarks in a common frame.

    Args:
        position_i: positions of the first landmarks, shape (N, D).
        covariance_i: covariances of the first landmarks, shape (N, D, D).
        position_j: positions of the second landmarks, shape (N, D).
        covariance_j: covariances of the second landmarks, shape (N, D, D).

    Returns:
        fused positions (N, D) and covariances (N, D, D).
    """
    A, B = np.linalg.inv(covariance_i), np.linalg.inv(covariance_j)
    # det(w A + (1 - w) B) = det B prod(1 + w m), where 1 + m are the generalised eigenvalues of
    # (A, B)
    root = np.linalg.cholesky(covariance_j)
    eigenvalue_excess = np.linalg.eigvalsh(np.swapaxes(root, 1, 2) @ A @ root).T - 1
    low, high = np.zeros(len(A)), np.ones(len(A))
    for _ in range(_HALVINGS):  # log det is concave in w, so its slope decreases
        w = (low + high) / 2
        rises = np.sum(eigenvalue_excess / (1 + w * eigenvalue_excess), axis=0) > 0
        low, high = np.where(rises, w, low), np.where(rises, high, w)
    w = ((low + high) / 2)[:, None, None]
    covariance = np.linalg.inv(w * A + (1 - w) * B)
    total = np.einsum("nij,nj->ni", w * A, position_i)
    total += np.einsum("nij,nj->ni", (1 - w) * B, position_j)
    position = np.einsum("nij,nj->ni", covariance, total)
    return position, (covariance + np.swapaxes(covariance, 1, 2)) / 2
