"""Slow reference implementations of kernels, shared by several tests."""

import numpy as np
from scipy.spatial.distance import cdist

from mapfusion.align.rigid_motion import residual_covariances, residuals

_WORD = 2**64 - 1


def draw(state):
    """Return the next state of the 64-bit xorshift generator."""
    state ^= (state << 13) & _WORD
    state ^= state >> 7
    state ^= (state << 17) & _WORD
    return state


def slow_squares(T_a_b, pairs, variance):
    """Return residuals, their covariances and their squared Mahalanobis distances."""
    e = residuals(T_a_b, pairs.p_a, pairs.p_b)
    C = residual_covariances(T_a_b, pairs.covariance_a, pairs.covariance_b) + variance * np.eye(2)
    return e, C, np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e)


def slow_consistency(pairs, variance, bound):
    """Return distances and the variances along the connecting lines, by matrix products."""
    total = 2 * variance
    for p, S in ((pairs.p_a, pairs.S_a), (pairs.p_b, pairs.S_b)):
        line = p[None] - p[:, None]
        length = np.linalg.norm(line, axis=2)
        unit = line / np.where(length > 0, length, 1)[:, :, None]
        total = total + np.einsum("ijk,ijkl,ijl->ij", unit, S[:, None] + S[None], unit)
    difference = cdist(pairs.p_a, pairs.p_a) - cdist(pairs.p_b, pairs.p_b)
    return (difference**2 <= bound * total) & ~np.eye(len(pairs.p_a), dtype=bool)
