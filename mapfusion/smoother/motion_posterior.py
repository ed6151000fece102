"""What a smoothed log tells of its odometry: each disturbance with its covariance, all observed.

With d = D x - u and the poses' information H, landmarks eliminated, the disturbances have the
covariance D H^-1 D'. With the poses gone first, H is a chain C less a matrix of low rank, so
H^-1 = C^-1 + X K^-1 X' with X = C^-1 B and K the landmarks' information (Woodbury).
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from mapfusion.kernels import kernel
from mapfusion.se2 import Float
from mapfusion.smoother.elimination import chain_factor, own_factor, pose_point_blocks
from mapfusion.smoother.normal_equations import disturbance_jacobians, disturbances
from mapfusion.smoother.settle import Settled


class MotionPosterior(NamedTuple):
    """Of the increments after the first, T - 1 of them.

    Attributes:
        mean: (T - 1, 3) the disturbances on the smoothed path.
        variance: (T - 1, 3) theirs.
        constants_information: (C, C) of constants that the increments depend on, all else unknown.
        constants_gradient: (C,) of their log likelihood.
    """

    mean: Float
    variance: Float
    constants_information: Float
    constants_gradient: Float


def motion_posterior(
    end: Settled, odometry: Float, information: Float, by_constants: Float
) -> MotionPosterior:
    """Disturbances given the observations, and what they tell of constants.

    Args:
        end: where smoothing ended.
        odometry: (T, 3) increments, as they were smoothed.
        information: (T - 1, 3) theirs after the first.
        by_constants: (T - 1, 3, C) how the increments after the first change with the constants.
    """
    path, n = end.estimate.path, len(odometry) - 1
    factor, spread = _covariance_factors(end)
    before, after = disturbance_jacobians(path)
    variance = _of_differences(before, after, *_chain_covariances(factor, n))
    variance += np.sum(_difference(before, after, spread) ** 2, axis=2)

    weighted = information[:, :, None] * by_constants
    pulled = _transposed_difference(before, after, weighted)
    solved = scipy.linalg.cho_solve_banded((factor, True), pulled, check_finite=False)
    shared = spread.T @ pulled
    of_constants = np.einsum("kdc,kde->ce", by_constants, weighted)
    of_constants -= pulled.T @ solved + shared.T @ shared
    mean = disturbances(path, odometry)
    return MotionPosterior(mean, variance, of_constants, np.einsum("kdc,kd->c", weighted, mean))


def _covariance_factors(end: Settled) -> tuple[Float, Float]:
    """C's factor, and what is to be added to C^-1: X K^-1 X' as a product of columns."""
    factor = chain_factor(end.equations)
    B, K, _ = pose_point_blocks(end.seen, end.equations)
    X = scipy.linalg.cho_solve_banded((factor, True), B, check_finite=False)
    root = scipy.linalg.cholesky(K - B.T @ X, lower=True, check_finite=False)
    return factor, scipy.linalg.solve_triangular(root, X.T, lower=True, check_finite=False).T


def disturbance_variances(end: Settled) -> Float:
    """(T - 1, 3) of the disturbances, whatever was eliminated first."""
    before, after = disturbance_jacobians(end.estimate.path)
    if end.solution.landmarks_first:
        return _from_poses(end, before, after)
    factor, spread = _covariance_factors(end)
    variance = _of_differences(before, after, *_chain_covariances(factor, len(after)))
    return variance + np.sum(_difference(before, after, spread) ** 2, axis=2)


def _from_poses(end: Settled, before: Float, after: Float) -> Float:
    """From the inverse of the poses' information, in their order."""
    factor = own_factor(end.seen, end.equations, end.solution)
    Z, between = factor.inverse, factor.envelope.between
    place = end.seen.pose_place[1:] - 1
    own, link = between(Z, place, place), between(Z, place[:-1], place[1:])
    return _of_differences(before, after, own, link)


def _difference(before: Float, after: Float, of_poses: Float) -> Float:
    """D of columns (3 (T - 1), R) of the poses but the first: (T - 1, 3, R)."""
    blocks = of_poses.reshape(len(after), 3, -1)
    made = after @ blocks
    made[1:] += before[1:] @ blocks[:-1]
    return made


def _transposed_difference(before: Float, after: Float, of_increments: Float) -> Float:
    """D' of columns (T - 1, 3, C): (3 (T - 1), C)."""
    made = np.swapaxes(after, 1, 2) @ of_increments
    made[:-1] += np.swapaxes(before[1:], 1, 2) @ of_increments[1:]
    return made.reshape(-1, of_increments.shape[2])


def _of_differences(before: Float, after: Float, own: Float, link: Float) -> Float:
    """(T - 1, 3) variances of D x from covariances of the poses and of each with the next."""
    made = np.einsum("kij,kjl,kil->ki", after, own, after)
    made[1:] += np.einsum("kij,kjl,kil->ki", before[1:], own[:-1], before[1:])
    made[1:] += 2 * np.einsum("kij,kjl,kil->ki", before[1:], link, after[1:])
    return made


def _chain_covariances(factor: Float, n: int) -> tuple[Float, Float]:
    """(n, 3, 3) covariances of a chain of n poses, (n - 1, 3, 3) of each with the next."""
    diagonal, below = np.zeros((n, 3, 3)), np.zeros((max(n - 1, 0), 3, 3))
    for r in range(3):
        for q in range(3):
            if r >= q:
                diagonal[:, r, q] = factor[r - q, q::3]
            below[:, r, q] = factor[3 + r - q, q : 3 * (n - 1) : 3]
    own, link = np.empty((n, 3, 3)), np.empty((max(n - 1, 0), 3, 3))
    _selected_inverse(diagonal, below, own, link)
    return own, link


@kernel
def _selected_inverse(diagonal: Float, below: Float, own: Float, link: Float) -> None:
    """The blocks of the inverse on and beside the diagonal (Takahashi et al. 1973)."""
    for k in range(len(diagonal) - 1, -1, -1):
        inverse = np.linalg.inv(diagonal[k])
        own[k] = inverse.T @ inverse
        if k < len(below):
            G = below[k] @ inverse
            link[k] = -G.T @ own[k + 1]
            own[k] += G.T @ own[k + 1] @ G
