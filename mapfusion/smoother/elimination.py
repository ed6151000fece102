"""The normal equations solved: either all landmarks are eliminated first, or all poses.

Both are exact. With the landmarks gone a dense system of the poses is left, with the poses gone,
which are a chain, one of the landmarks: the smaller of the two is taken. The first pose is the
frame and no unknown.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from numba import njit

from mapfusion.se2 import Float
from mapfusion.smoother.normal_equations import Estimate, NormalEquations
from mapfusion.smoother.sightings import Sightings

_BAND = 5  # below the diagonal of a chain of poses of three coordinates


class Solution(NamedTuple):
    """A step, and what the landmarks' joint covariance is: block diagonal plus common' common.

    Attributes:
        step: of the poses, the first one's zero, and of the landmarks.
        decrease: of the squared sigmas, twice what the step would gain if all were linear.
        own_m2: (L, 3, 3) covariance of each landmark if all that is eliminated later were known.
        factor: lower Cholesky factor of the information of what was eliminated last.
        landmarks_first: whether these are the poses (else the landmarks).
    """

    step: Estimate
    decrease: float
    own_m2: Float
    factor: Float
    landmarks_first: bool


def solve(seen: Sightings, equations: NormalEquations) -> Solution:
    """The step that solves the equations."""
    tracked = equations.between is not None  # which only a dense system of the poses can hold
    landmarks_first = tracked or len(equations.pose_block) - 1 < len(equations.point_block)
    return (_landmarks_first if landmarks_first else _poses_first)(seen, equations)


def common_part(seen: Sightings, equations: NormalEquations, solution: Solution) -> Float:
    """(R, 3L) Y: the landmarks' joint covariance is block diagonal of `own_m2` plus Y' Y."""
    if not solution.landmarks_first:
        n = len(solution.factor)
        return scipy.linalg.solve_triangular(solution.factor, np.eye(n), lower=True)
    n_poses, n_points = len(equations.pose_block), len(equations.point_block)
    wide = np.zeros((n_poses, n_points, 3, 3))
    np.add.at(
        wide, (seen.frame, seen.landmark), equations.coupling @ solution.own_m2[seen.landmark]
    )
    right = wide.transpose(0, 2, 1, 3).reshape(3 * n_poses, 3 * n_points)[3:]
    return scipy.linalg.solve_triangular(solution.factor, right, lower=True, check_finite=False)


def _landmarks_first(seen: Sightings, equations: NormalEquations) -> Solution:
    n = len(equations.pose_block)
    S = np.zeros((3 * n, 3 * n)) if equations.between is None else equations.between.copy()
    blocks, each = S.reshape(n, 3, n, 3), np.arange(n)
    blocks[each, :, each, :] += equations.pose_block
    blocks[each[1:], :, each[:-1], :] += equations.link
    own = np.asarray(np.linalg.inv(_regular(seen, equations.point_block)), np.float64)
    gradient = equations.pose_gradient.copy()
    _subtract_landmarks(
        seen.arrays[:2], equations.coupling, own, equations.point_gradient, S, gradient
    )
    factor = scipy.linalg.cholesky(S[3:, 3:], lower=True, check_finite=False)
    way = np.zeros((n, 3))
    way[1:] = -scipy.linalg.cho_solve((factor, True), gradient[1:].ravel()).reshape(-1, 3)
    moved = seen.sum_by_landmark(np.einsum("nij,ni->nj", equations.coupling, way[seen.frame]))
    points = -np.einsum("lij,lj->li", own, equations.point_gradient + moved)
    return _solution(seen, equations, Estimate(way, points), own, factor, True)


@njit(cache=True)
def _subtract_landmarks(
    seen: tuple[np.ndarray, np.ndarray],
    coupling: Float,
    own: Float,
    point_gradient: Float,
    S: Float,
    gradient: Float,
) -> None:
    """Coupling A^-1 coupling' of each landmark, between all frames that saw it; the lower half."""
    starts, frame = seen
    gain = np.empty((3, 3))
    for j in range(len(starts) - 1):
        b = point_gradient[j]
        for i in range(starts[j], starts[j + 1]):
            row, H = 3 * frame[i], coupling[i]
            for r in range(3):
                for q in range(3):
                    gain[r, q] = (
                        H[r, 0] * own[j, 0, q] + H[r, 1] * own[j, 1, q] + H[r, 2] * own[j, 2, q]
                    )
                gradient[frame[i], r] -= gain[r, 0] * b[0] + gain[r, 1] * b[1] + gain[r, 2] * b[2]
            for k in range(starts[j], i + 1):
                column, G = 3 * frame[k], coupling[k]
                for r in range(3):
                    for q in range(3):
                        S[row + r, column + q] -= (
                            gain[r, 0] * G[q, 0] + gain[r, 1] * G[q, 1] + gain[r, 2] * G[q, 2]
                        )


def _poses_first(seen: Sightings, equations: NormalEquations) -> Solution:
    n_poses, n_points = len(equations.pose_block), len(equations.point_block)
    wide = np.zeros((n_poses, n_points, 3, 3))
    np.add.at(wide, (seen.frame, seen.landmark), equations.coupling)
    B = wide.transpose(0, 2, 1, 3).reshape(3 * n_poses, 3 * n_points)[3:]
    chain = scipy.linalg.cholesky_banded(_banded(equations)[:, 3:], lower=True, check_finite=False)
    right = np.column_stack([B, equations.pose_gradient[1:].ravel()])
    solved = scipy.linalg.cho_solve_banded((chain, True), right, check_finite=False)
    K = -B.T @ solved[:, :-1]
    each = np.arange(n_points)
    blocks = K.reshape(n_points, 3, n_points, 3)
    blocks[each, :, each, :] += _regular(seen, equations.point_block)
    factor = scipy.linalg.cholesky(K, lower=True, check_finite=False)
    right = equations.point_gradient.ravel() - B.T @ solved[:, -1]
    points = -scipy.linalg.cho_solve((factor, True), right)
    way = np.zeros((n_poses, 3))
    way[1:] = -(solved[:, -1] + solved[:, :-1] @ points).reshape(-1, 3)
    step = Estimate(way, points.reshape(-1, 3))
    return _solution(seen, equations, step, np.zeros((n_points, 3, 3)), factor, False)


def _banded(equations: NormalEquations) -> Float:
    """The chain of the poses as LAPACK takes a band: row d is the d-th diagonal below the main."""
    n = 3 * len(equations.pose_block)
    band = np.zeros((_BAND + 1, n))
    for r in range(3):
        for q in range(3):
            if r >= q:
                band[r - q, q::3] = equations.pose_block[:, r, q]
            band[3 + r - q, q : n - 3 : 3] = equations.link[:, r, q]
    return band


def _regular(seen: Sightings, point_block: Float) -> Float:
    """The landmarks' blocks; in planar data, which say nothing of z, it has a block of its own."""
    if seen.n_dimensions == 3:
        return point_block
    regular = point_block.copy()
    regular[:, 2, 2] = 1.0
    return regular


def _solution(
    seen: Sightings,
    equations: NormalEquations,
    step: Estimate,
    own_m2: Float,
    factor: Float,
    landmarks_first: bool,
) -> Solution:
    gained = np.sum(equations.pose_gradient * step.path) + np.sum(
        equations.point_gradient * step.point_m
    )
    return Solution(step, -float(gained), own_m2, factor, landmarks_first)
