"""The normal equations solved: landmarks and their tracks are eliminated first, or all poses.

Both are exact. With the landmarks gone a sparse system of the poses is left; with the poses gone,
which are a chain, a dense one of the landmarks and tracks. The one that takes fewer products is
solved. The first pose is the frame and no unknown.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from mapfusion.joint_covariance import RANK, KnownErrors, SharedErrors
from mapfusion.se2 import Float
from mapfusion.smoother.landmark_elimination import along_way
from mapfusion.smoother.normal_equations import Estimate, NormalEquations, Weights, point_equations
from mapfusion.smoother.offsets import Points, known_points, moved_points, without_offsets
from mapfusion.smoother.path_errors import PathErrors
from mapfusion.smoother.reduced_poses import ReducedPoses
from mapfusion.smoother.sightings import Sightings
from mapfusion.smoother.skyline import Envelope, Factor, factor_in_envelope

_GB = 1e9
_ITEM = np.dtype(np.float64).itemsize
# Arrays that are there at once. In the envelope: the factor of a step before with its inverse and
# its copy in single precision, and those of the next. Of points: blocks with the poses as they are
# made, in rows, solved, and LAPACK's copies; and the points' own.
_FACTORS, _WIDE, _SQUARE = 5.5, 5.0, 6.0
_BLOCK, _BLOCKS = 9, 12  # entries of a block of three by three; blocks of a pose, sighting, track
_CONDENSED = 6.0  # arrays of the map's shared directions
_BAND = 5  # below the diagonal of a chain of poses of three coordinates


class Solution(NamedTuple):
    """A step, and what the landmarks' joint covariance is: block diagonal plus common' common.

    Attributes:
        step: of the poses, the first one's zero, of the landmarks and of the offsets.
        moved: how far the step moves what was eliminated last, in squared sigmas.
        own_m2: (L, 3, 3) covariance of each landmark if the path were known.
        offset_m2: (B, 3, 3) of each track's offset, likewise.
        track_m2: (B, 3, 3) of each track's point, likewise.
        factor: Cholesky factor of the information of what was eliminated last; None where
            that of a step before was enough (`own_factor`).
        landmarks_first: whether these are the poses, in the order of `pose_place` (else the offsets
            and, after them, landmarks).
    """

    step: Estimate
    moved: float
    own_m2: Float
    offset_m2: Float
    track_m2: Float
    factor: Factor | None
    landmarks_first: bool


def solve(seen: Sightings, equations: NormalEquations, nearby: Factor | None = None) -> Solution:
    """The step that solves the equations; by the factor of a step before, if that is near enough.

    Args:
        seen: the observations.
        equations: what they say.
        nearby: factor that was found for the same observations at a step before.
    """
    if _is_landmarks_first(seen):
        return _landmarks_first(seen, equations, nearby)
    return _poses_first(seen, equations)


def own_factor(seen: Sightings, equations: NormalEquations, solution: Solution) -> Factor:
    """The factor of the equations themselves; of a step that another one was enough for, anew."""
    if solution.factor is not None:
        return solution.factor
    return ReducedPoses(seen, equations, without_offsets(seen, equations.points)).factor()


def solve_points(
    seen: Sightings, at: Estimate, weights: Weights, stray_information: float
) -> tuple[Estimate, Points]:
    """The step of landmarks and offsets that is left on a path, and what is known of them there."""
    equations = point_equations(seen, at, weights, stray_information)
    left = without_offsets(seen, equations)
    still = np.zeros_like(equations.track_gradient)
    moved = moved_points(seen, equations, left, still)
    return Estimate(np.zeros_like(at.path), *moved), known_points(seen, left)


def memory_bytes(seen: Sightings) -> float:
    """Return an upper bound of the memory that smoothing these observations takes, in bytes.

    It counts what is there at once when most is: the matrices of `solve` and of the covariances,
    the observations' and tracks' blocks, and the map's joint covariance.
    """
    n_poses, n_landmarks = 3 * seen.order.n_poses, 3 * seen.n_landmarks
    if _is_landmarks_first(seen):
        entries, n_shared = _FACTORS * int(seen.order.envelope.offset[-1]), n_poses
    else:
        n = 3 * _n_points(seen)
        entries, n_shared = n * (_WIDE * n_poses + _SQUARE * n), n_landmarks
    blocks = len(seen) + len(seen.strays) + seen.order.n_poses
    condensed = min(RANK, n_shared) * (n_shared + n_landmarks)
    return _ITEM * (entries + _BLOCK * _BLOCKS * blocks + _CONDENSED * condensed)


def require_memory(seen: Sightings, max_memory_gb: float) -> None:
    """Raise MemoryError if smoothing these observations may take more."""
    needed_gb = memory_bytes(seen) / _GB
    if needed_gb > max_memory_gb:
        raise MemoryError(f"may take {needed_gb:.2g} GB, more than it is given")


def _is_landmarks_first(seen: Sightings) -> bool:
    return seen.order.is_sparser_than(_n_points(seen))


def _n_points(seen: Sightings) -> int:
    return seen.n_landmarks + int(np.count_nonzero(seen.strays))


def shared_errors(seen: Sightings, equations: NormalEquations, solution: Solution) -> SharedErrors:
    """Y (R, 3L): the landmarks' joint covariance is block diagonal of `own_m2` plus Y' Y."""
    factor = own_factor(seen, equations, solution)
    if solution.landmarks_first:
        return PathErrors.of(seen, equations, solution.own_m2, factor)
    return KnownErrors(_beside_own(solution.own_m2, factor.dense()))


def pose_covariances(
    seen: Sightings, equations: NormalEquations, solution: Solution, frames: np.ndarray
) -> Float:
    """(n, 3, 3) covariance of each pose of these frames (n,), none the first."""
    n_unknown, n = len(equations.pose_block) - 1, len(frames)
    chosen = np.zeros((n_unknown, 3, n, 3))
    row = seen.pose_place[frames] if solution.landmarks_first else frames
    chosen[row - 1, :, np.arange(n)] = np.eye(3)
    right, alone = chosen.reshape(3 * n_unknown, 3 * n), 0.0
    if not solution.landmarks_first:  # the errors of the path if all points were known, and theirs
        solved = scipy.linalg.cho_solve_banded((chain_factor(equations), True), right)
        right, alone = pose_point_blocks(seen, equations)[0].T @ solved, right.T @ solved
    root = own_factor(seen, equations, solution).solve(right)
    return (root.T @ root + alone).reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]


def _beside_own(own_m2: Float, lower: Float) -> Float:
    """Y (3L, 3L) from the landmarks' information: what the path's errors add to `own_m2`."""
    n, each = len(own_m2), np.arange(len(own_m2))
    lower = lower[-3 * n :, -3 * n :]  # the last rows are that of what is left
    joint = scipy.linalg.cho_solve((lower, True), np.eye(3 * n), check_finite=False)
    joint.reshape(n, 3, n, 3)[each, :, each, :] -= own_m2
    variance, direction = np.linalg.eigh(joint)
    return (np.sqrt(np.maximum(variance, 0.0)) * direction).T[::-1]


def _landmarks_first(
    seen: Sightings, equations: NormalEquations, nearby: Factor | None = None
) -> Solution:
    left = without_offsets(seen, equations.points)
    poses, factor = ReducedPoses(seen, equations, left), None
    gradient = poses.gradient()
    way = None if nearby is None else poses.solved_nearby(nearby, -gradient)
    if way is None:
        factor = poses.factor()
        way = poses.solved(factor, -gradient)
    along = along_way(seen, equations.coupling, way)
    step = Estimate(way, *moved_points(seen, equations.points, left, along))
    moved, known = -float(np.vdot(gradient, way)), known_points(seen, left)
    own = left.landmark_m2, known.offset_m2, known.track_m2
    return Solution(step, moved, *own, factor, landmarks_first=True)


def _poses_first(seen: Sightings, equations: NormalEquations) -> Solution:
    n_poses, n_offsets = len(equations.pose_block), 3 * np.count_nonzero(seen.strays)
    B, K, gradient = pose_point_blocks(seen, equations)
    chain = chain_factor(equations)
    right = np.column_stack([B, equations.pose_gradient[1:].ravel()])
    solved = scipy.linalg.cho_solve_banded((chain, True), right, check_finite=False)
    whole = Envelope(np.zeros(len(K), dtype=np.int64))
    factor = factor_in_envelope(whole.of(K - B.T @ solved[:, :-1]), whole)
    points = -factor.solve_transposed(factor.solve(gradient - B.T @ solved[:, -1]))
    way, offsets = np.zeros((n_poses, 3)), np.zeros((len(seen.strays), 3))
    way[1:] = -(solved[:, -1] + solved[:, :-1] @ points).reshape(-1, 3)
    offsets[seen.strays] = points[:n_offsets].reshape(-1, 3)
    step = Estimate(way, points[n_offsets:].reshape(-1, 3), offsets)
    left = without_offsets(seen, equations.points)
    known = known_points(seen, left)
    own = left.landmark_m2, known.offset_m2, known.track_m2
    last = step.point_m.ravel()
    moved = float(np.sum((factor.dense()[-last.size :, -last.size :].T @ last) ** 2))
    return Solution(step, moved, *own, factor, landmarks_first=False)


def pose_point_blocks(seen: Sightings, equations: NormalEquations) -> tuple[Float, Float, Float]:
    """Of the offsets and, after them, the landmarks: block with the poses, own block, gradient."""
    strays, n_poses = seen.strays, len(equations.pose_block)
    row, stray = strays[seen.track], np.cumsum(strays) - 1
    n, n_points = np.count_nonzero(strays), np.count_nonzero(strays) + seen.n_landmarks
    wide, K = np.zeros((n_poses, n_points, 3, 3)), np.zeros((n_points, n_points, 3, 3))
    np.add.at(wide, (seen.frame[row], stray[seen.track[row]]), equations.coupling[row])
    np.add.at(wide, (seen.frame, n + seen.landmark), equations.coupling)
    S, each, landmark = (
        equations.points.track_block,
        np.arange(n_points),
        n + seen.landmark_of_track,
    )
    own = np.concatenate([S[strays], _regular(seen, seen.sum_tracks(S))])
    own[:n] += equations.points.offset_information[strays, None, None] * np.eye(3)
    K[each, each] = own
    K[landmark[strays], each[:n]] = S[strays]
    K[each[:n], landmark[strays]] = S[strays]
    gradient = [
        (equations.points.track_gradient + equations.points.offset_gradient)[strays],
        seen.sum_tracks(equations.points.track_gradient),
    ]
    as_matrix = wide.transpose(0, 2, 1, 3).reshape(3 * n_poses, 3 * n_points)[3:]
    K = K.transpose(0, 2, 1, 3).reshape(3 * n_points, 3 * n_points)
    return as_matrix, K, np.concatenate(gradient).ravel()


def chain_factor(equations: NormalEquations) -> Float:
    """Cholesky factor of the poses, which are a chain, but for the first.

    As LAPACK takes a band: row d is the d-th diagonal below the main.
    """
    n = 3 * len(equations.pose_block)
    band = np.zeros((_BAND + 1, n))
    for r in range(3):
        for q in range(3):
            if r >= q:
                band[r - q, q::3] = equations.pose_block[:, r, q]
            band[3 + r - q, q : n - 3 : 3] = equations.link[:, r, q]
    return scipy.linalg.cholesky_banded(band[:, 3:], lower=True, check_finite=False)


def _regular(seen: Sightings, point_block: Float) -> Float:
    """The landmarks' blocks; in planar data, which say nothing of z, it has a block of its own."""
    if seen.n_dimensions == 3:
        return point_block
    regular = point_block.copy()
    regular[:, 2, 2] = 1.0
    return regular
