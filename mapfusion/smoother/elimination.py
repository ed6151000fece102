"""Solution of the normal equations, and marginal covariances of poses and landmarks.

With L the factor of the poses' information, C the poses' blocks with the landmarks and A the
landmarks' covariances for a known path, the landmarks' joint covariance is A + Y' Y with
Y = L^-1 C A. Y is large and dense, but C A is sparse.

Eliminating landmarks and tracks leaves a sparse system of the poses. Eliminating the poses, which
are a chain, leaves a dense system of landmarks and tracks. Both are exact; the system with fewer
multiplications is solved. The first pose is the frame and is known.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.geometry.joint_covariance import RANK, KnownErrors, SharedErrors
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.smoother.cholesky import Envelope, Factor, factor_in_envelope
from mapfusion.smoother.normal_equations import Estimate, NormalEquations, Weights, point_equations
from mapfusion.smoother.problem import OrderedObservations
from mapfusion.smoother.schur_complement import (
    PointCovariances,
    ReducedEquations,
    coupling_times_points,
    coupling_times_poses,
    eliminate_offsets,
    point_covariances,
    reduced_couplings,
    substitute_points,
    subtract_point_terms,
)


@dataclass(frozen=True)
class ReducedPoses:
    """Equations of T poses. The first pose is known, so its rows are zero.

    Attributes:
        obs: the observations.
        equations: the equations of poses, landmarks and offsets.
        reduced: the equations after the offsets are eliminated.
    """

    obs: OrderedObservations
    equations: NormalEquations
    reduced: ReducedEquations

    def gradient(self) -> Float:
        """Return the gradient, shape (T, 3)."""
        equations = self.equations
        still = np.zeros_like(equations.points.track_gradient)
        steps = substitute_points(self.obs, equations.points, self.reduced, still)
        total = equations.pose_gradient + coupling_times_points(
            self.obs, equations.coupling, *steps
        )
        total[0] = 0.0
        return total

    def factor(self) -> Factor:
        """Return the Cholesky factor of the matrix without the first pose.

        Its rows are in the order of `Sightings.pose_index`.

        Raises:
            LinAlgError: the matrix is not positive definite.
        """
        envelope = self.obs.order.envelope
        S = envelope.zeros()
        # blocks of odometry and of each pose's own observations
        index = self.obs.pose_index[1:] - 1
        S[envelope.where(index, index)] = self.equations.pose_block[1:]
        index_after, index_before, link = index[1:], index[:-1], self.equations.link[1:]
        link = np.where((index_after > index_before)[:, None, None], link, np.swapaxes(link, 1, 2))
        S[
            envelope.where(
                np.maximum(index_after, index_before), np.minimum(index_after, index_before)
            )
        ] = link
        obs, coupling = self.obs, self.equations.coupling
        couplings = coupling, reduced_couplings(obs, coupling, self.reduced)
        rows, index = obs.by_landmark, obs.unknown_index
        subtract_point_terms(rows, index, couplings, self.reduced, envelope.offset, S)
        return factor_in_envelope(S, envelope)

    def solve(self, factor: Factor, right: Float) -> Float:
        """Solve for x (T, 3) with the matrix of this factor and the right side (T, 3)."""
        ordered = np.empty((len(right) - 1, 3))
        ordered[self.obs.pose_index[1:] - 1] = right[1:]
        return self.by_frame(factor.solve_transposed(factor.solve(ordered.ravel())))

    def by_frame(self, ordered: Float) -> Float:
        """Return the values (3 (T - 1),) of the ordered poses by frame (T, 3), zero for the first.

        The order is that of the rows of `factor`.
        """
        index = self.obs.pose_index
        by_frame = np.zeros((len(index), 3))
        by_frame[1:] = ordered.reshape(-1, 3)[index[1:] - 1]
        return by_frame


@dataclass(frozen=True)
class PathErrors:
    """Y (R, 3L) for the R coordinates of the unknown poses in their order.

    Attributes:
        obs: the observations.
        factor: L.
        pose_landmark: block of C A of each observation, shape (N, 3, 3).
    """

    obs: OrderedObservations
    factor: Factor
    pose_landmark: Float

    @classmethod
    def of(
        cls, obs: OrderedObservations, equations: NormalEquations, own_m2: Float, factor: Factor
    ) -> "PathErrors":
        """Return Y for equations whose landmarks are eliminated, with `own_m2` and the factor."""
        reduced = eliminate_offsets(obs, equations.points)
        coupling = reduced_couplings(obs, equations.coupling, reduced)
        return cls(obs, factor, coupling @ own_m2[obs.landmark])

    def __len__(self) -> int:
        return len(self.factor)

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """Return the columns `rows` (r,) of Y Y', shape (R, r)."""
        chosen = np.zeros((len(self), len(rows)))
        chosen[rows, np.arange(len(rows))] = 1.0
        return self.gram(chosen)

    def gram(self, columns: Float) -> Float:
        """Return Y Y' times columns (R, c), computed in single precision."""
        AC = self._landmark_pose_single
        by_landmark = AC @ self.factor.solve_transposed(columns.astype(np.float32))
        return self.factor.solve(AC.T @ by_landmark).astype(np.float64)

    def spread(self, columns: Float) -> Float:
        """Return Y' times columns (R, c), shape (3L, c)."""
        return self._landmark_pose @ self.factor.solve_transposed(columns)

    def gathered(self, by_landmark: Float) -> Float:
        """Return Y times columns (3L, c), shape (R, c)."""
        return self.factor.solve(self._landmark_pose.T @ by_landmark)

    def squares(self) -> Float:
        """Return the diagonal blocks of Y' Y, shape (L, 3, 3)."""
        total = np.zeros((self.obs.n_landmarks, 3, 3))
        covariance, offset = self.factor.inverse, self.factor.envelope.offset
        unknown_index = self.obs.unknown_index
        _add_squares(self.obs.starts, unknown_index, self.pose_landmark, offset, covariance, total)
        return total + np.swapaxes(total, 1, 2)

    @cached_property
    def _landmark_pose(self) -> "scipy.sparse.csr_array":
        """A C' with one block for each observation, shape (3L, R)."""
        unknown_index, each = self.obs.unknown_index, np.arange(3)
        has_pose = unknown_index >= 0
        rows = 3 * self.obs.landmark[has_pose, None] + each
        columns = 3 * unknown_index[has_pose, None] + each
        rows, columns = np.broadcast_arrays(rows[:, None, :], columns[:, :, None])
        shape = 3 * self.obs.n_landmarks, len(self)
        return scipy.sparse.csr_array(
            (self.pose_landmark[has_pose].ravel(), (rows.ravel(), columns.ravel())), shape
        )

    @cached_property
    def _landmark_pose_single(self) -> "scipy.sparse.csr_array":
        """A C' in single precision."""
        matrix = self._landmark_pose
        entries = matrix.data.astype(np.float32), matrix.indices, matrix.indptr
        return scipy.sparse.csr_array(entries, matrix.shape)


@kernel
def _add_squares(
    starts: np.ndarray,
    unknown_index: np.ndarray,
    pose_landmark: Float,
    offset: np.ndarray,
    Z: Float,
    total: Float,
) -> None:
    """Write half of Y' Y of each landmark: the sum with its transpose is the diagonal block."""
    of_pose = np.empty((3, 3))
    for j in range(len(starts) - 1):
        for i in range(starts[j], starts[j + 1]):
            if unknown_index[i] < 0:
                continue
            for r in range(3):
                for q in range(3):
                    of_pose[r, q] = 0.0
            for k in range(starts[j], i + 1):
                if unknown_index[k] >= 0:
                    share = 0.5 if k == i else 1.0
                    # add a share of the poses' covariance times the block of observation k
                    row = 3 * unknown_index[i]
                    column = 3 * unknown_index[k]
                    above = row < column  # the transpose is stored
                    down, across = (column, row) if above else (row, column)
                    at0, at1, at2 = (
                        offset[down] + across,
                        offset[down + 1] + across,
                        offset[down + 2] + across,
                    )
                    for q in range(3):
                        x, y, z = (
                            share * pose_landmark[k, 0, q],
                            share * pose_landmark[k, 1, q],
                            share * pose_landmark[k, 2, q],
                        )
                        if above:
                            for r in range(3):
                                of_pose[r, q] += Z[at0 + r] * x + Z[at1 + r] * y + Z[at2 + r] * z
                        else:
                            of_pose[0, q] += Z[at0] * x + Z[at0 + 1] * y + Z[at0 + 2] * z
                            of_pose[1, q] += Z[at1] * x + Z[at1 + 1] * y + Z[at1 + 2] * z
                            of_pose[2, q] += Z[at2] * x + Z[at2 + 1] * y + Z[at2 + 2] * z
            for r in range(3):
                for q in range(3):
                    total[j, r, q] += (
                        pose_landmark[i, 0, r] * of_pose[0, q]
                        + pose_landmark[i, 1, r] * of_pose[1, q]
                        + pose_landmark[i, 2, r] * of_pose[2, q]
                    )


_GB = 1e9
_ITEM = np.dtype(np.float64).itemsize
# Number of arrays in memory at the same time. In the envelope: factor and inverse of two successive
# steps. Blocks of points with poses: as built, by rows, solved, and copies of LAPACK. Blocks of
# points.
_FACTORS, _WIDE, _SQUARE = 4.0, 5.0, 6.0
_BLOCK, _BLOCKS = 9, 12  # entries of a 3 by 3 block; blocks per pose, observation and track
_CONDENSED = 6.0  # arrays of the map's shared directions
_BAND = 5  # below the diagonal of a chain of poses of three coordinates
# Number of poses whose covariances are computed at the same time, to limit the memory.
_POSES_AT_ONCE = 8


class Solution(NamedTuple):
    """Step and factors of the covariance.

    Attributes:
        step: step of the poses (zero for the first), landmarks and offsets.
        squared_step: squared length of the step of the reduced system, in sigmas.
        own_m2: covariance of each landmark for a known path, shape (L, 3, 3).
        offset_m2: covariance of each track's offset for a known path, shape (B, 3, 3).
        track_m2: covariance of each track's point for a known path, shape (B, 3, 3).
        factor: Cholesky factor of the reduced system.
        landmarks_first: true if the reduced system is that of the poses, in the order of
            `pose_index`; false if it is that of the offsets and, after them, the landmarks.
    """

    step: Estimate
    squared_step: float
    own_m2: Float
    offset_m2: Float
    track_m2: Float
    factor: Factor
    landmarks_first: bool


def solve(obs: OrderedObservations, equations: NormalEquations) -> Solution:
    """Solve the equations of these observations for the next step."""
    if _is_landmarks_first(obs):
        return _eliminate_landmarks_first(obs, equations)
    return _eliminate_poses_first(obs, equations)


def solve_points(
    obs: OrderedObservations, at: Estimate, weights: Weights, offset_prior: float
) -> tuple[Estimate, PointCovariances]:
    """Return the step of landmarks and offsets for a fixed path, and their covariances."""
    equations = point_equations(obs, at, weights, offset_prior)
    reduced = eliminate_offsets(obs, equations)
    still = np.zeros_like(equations.track_gradient)
    steps = substitute_points(obs, equations, reduced, still)
    return Estimate(np.zeros_like(at.path), *steps), point_covariances(obs, reduced)


def memory_bytes(obs: OrderedObservations) -> float:
    """Return an upper bound of the memory that smoothing these observations takes, in bytes.

    It counts the matrices of `solve` and of the covariances, the blocks of observations and tracks,
    and the map's joint covariance.
    """
    n_poses, n_landmarks = 3 * obs.order.n_poses, 3 * obs.n_landmarks
    if _is_landmarks_first(obs):
        entries, n_shared = _FACTORS * int(obs.order.envelope.offset[-1]), n_poses
    else:
        n = 3 * _n_points(obs)
        entries, n_shared = n * (_WIDE * n_poses + _SQUARE * n), n_landmarks
    blocks = len(obs) + len(obs.has_offset) + obs.order.n_poses
    condensed = min(RANK, n_shared) * (n_shared + n_landmarks)
    return _ITEM * (entries + _BLOCK * _BLOCKS * blocks + _CONDENSED * condensed)


def require_memory(obs: OrderedObservations, max_memory_gb: float) -> None:
    """Raise MemoryError if smoothing these observations may take more memory."""
    needed_gb = memory_bytes(obs) / _GB
    if needed_gb > max_memory_gb:
        raise MemoryError(f"may take {needed_gb:.2g} GB, more than it is given")


def _is_landmarks_first(obs: OrderedObservations) -> bool:
    return obs.order.is_sparser_than(_n_points(obs))


def _n_points(obs: OrderedObservations) -> int:
    return obs.n_landmarks + int(np.count_nonzero(obs.has_offset))


def shared_errors(
    obs: OrderedObservations, equations: NormalEquations, solution: Solution
) -> SharedErrors:
    """Return Y (R, 3L); the landmarks' joint covariance is block diagonal of `own_m2` plus Y' Y."""
    if solution.landmarks_first:
        return PathErrors.of(obs, equations, solution.own_m2, solution.factor)
    # the joint covariance without the diagonal blocks `own_m2`, from the landmarks' information
    own_m2 = solution.own_m2
    n, each = len(own_m2), np.arange(len(own_m2))
    lower = solution.factor.dense()[-3 * n :, -3 * n :]  # landmarks are last
    joint = scipy.linalg.cho_solve((lower, True), np.eye(3 * n), check_finite=False)
    joint.reshape(n, 3, n, 3)[each, :, each, :] -= own_m2
    variance, direction = np.linalg.eigh(joint)
    return KnownErrors((np.sqrt(np.maximum(variance, 0.0)) * direction).T[::-1])


def pose_covariances(
    obs: OrderedObservations, equations: NormalEquations, solution: Solution
) -> Float:
    """Return the covariances of all T poses, shape (T, 3, 3); that of the fixed first one is 0."""
    n_poses = len(equations.pose_block)
    covariance = np.zeros((n_poses, 3, 3))
    if solution.landmarks_first:
        factor, index = solution.factor, obs.pose_index[1:] - 1
        covariance[1:] = factor.envelope.between(factor.inverse, index, index)
        return covariance
    # errors of the path for known points, and errors from the points
    chain, (blocks, *_) = chain_factor(equations), pose_point_blocks(obs, equations)
    for first in range(1, n_poses, _POSES_AT_ONCE):
        poses = np.arange(first, min(first + _POSES_AT_ONCE, n_poses))
        n = len(poses)
        right = np.zeros((n_poses - 1, 3, n, 3))
        right[poses - 1, :, np.arange(n)] = np.eye(3)
        right = right.reshape(-1, 3 * n)
        solved = scipy.linalg.cho_solve_banded((chain, True), right, check_finite=False)
        root = solution.factor.solve(blocks.T @ solved)
        blocks_of_poses = (root.T @ root + right.T @ solved).reshape(n, 3, n, 3)
        covariance[poses] = blocks_of_poses[np.arange(n), :, np.arange(n)]
    return covariance


def _eliminate_landmarks_first(obs: OrderedObservations, equations: NormalEquations) -> Solution:
    reduced = eliminate_offsets(obs, equations.points)
    poses = ReducedPoses(obs, equations, reduced)
    gradient, factor = poses.gradient(), poses.factor()
    path_step = poses.solve(factor, -gradient)
    path_term = coupling_times_poses(obs, equations.coupling, path_step)
    step = Estimate(path_step, *substitute_points(obs, equations.points, reduced, path_term))
    squared_step, conditional = (
        -float(np.vdot(gradient, path_step)),
        point_covariances(obs, reduced),
    )
    covariances = reduced.landmark_m2, conditional.offset_m2, conditional.track_m2
    return Solution(step, squared_step, *covariances, factor, landmarks_first=True)


def _eliminate_poses_first(obs: OrderedObservations, equations: NormalEquations) -> Solution:
    n_poses, n_offsets = len(equations.pose_block), 3 * np.count_nonzero(obs.has_offset)
    B, K, gradient = pose_point_blocks(obs, equations)
    chain = chain_factor(equations)
    right = np.column_stack([B, equations.pose_gradient[1:].ravel()])
    solved = scipy.linalg.cho_solve_banded((chain, True), right, check_finite=False)
    envelope = Envelope(np.zeros(len(K), dtype=np.int64))
    factor = factor_in_envelope(envelope.of(K - B.T @ solved[:, :-1]), envelope)
    points = -factor.solve_transposed(factor.solve(gradient - B.T @ solved[:, -1]))
    path_step, offsets = np.zeros((n_poses, 3)), np.zeros((len(obs.has_offset), 3))
    path_step[1:] = -(solved[:, -1] + solved[:, :-1] @ points).reshape(-1, 3)
    offsets[obs.has_offset] = points[:n_offsets].reshape(-1, 3)
    step = Estimate(path_step, points[n_offsets:].reshape(-1, 3), offsets)
    reduced = eliminate_offsets(obs, equations.points)
    conditional = point_covariances(obs, reduced)
    covariances = reduced.landmark_m2, conditional.offset_m2, conditional.track_m2
    last = step.point_m.ravel()
    squared_step = float(np.sum((factor.dense()[-last.size :, -last.size :].T @ last) ** 2))
    return Solution(step, squared_step, *covariances, factor, landmarks_first=False)


def pose_point_blocks(
    obs: OrderedObservations, equations: NormalEquations
) -> tuple[Float, Float, Float]:
    """Return the points' block with the poses, their own block and gradient; offsets come first."""
    has_offset, n_poses = obs.has_offset, len(equations.pose_block)
    row, number = has_offset[obs.track], np.cumsum(has_offset) - 1
    n, n_points = np.count_nonzero(has_offset), np.count_nonzero(has_offset) + obs.n_landmarks
    full_blocks, K = np.zeros((n_poses, n_points, 3, 3)), np.zeros((n_points, n_points, 3, 3))
    np.add.at(full_blocks, (obs.frame[row], number[obs.track[row]]), equations.coupling[row])
    np.add.at(full_blocks, (obs.frame, n + obs.landmark), equations.coupling)
    S, each, landmark = (
        equations.points.track_block,
        np.arange(n_points),
        n + obs.landmark_of_track,
    )
    landmark_block = obs.sum_tracks(S)
    if obs.n_dimensions == 2:  # z is not observed
        landmark_block[:, 2, 2] = 1.0
    point_blocks = np.concatenate([S[has_offset], landmark_block])
    point_blocks[:n] += equations.points.offset_information[has_offset, None, None] * np.eye(3)
    K[each, each] = point_blocks
    K[landmark[has_offset], each[:n]] = S[has_offset]
    K[each[:n], landmark[has_offset]] = S[has_offset]
    gradient = [
        (equations.points.track_gradient + equations.points.offset_gradient)[has_offset],
        obs.sum_tracks(equations.points.track_gradient),
    ]
    as_matrix = full_blocks.transpose(0, 2, 1, 3).reshape(3 * n_poses, 3 * n_points)[3:]
    K = K.transpose(0, 2, 1, 3).reshape(3 * n_points, 3 * n_points)
    return as_matrix, K, np.concatenate(gradient).ravel()


def chain_factor(equations: NormalEquations) -> Float:
    """Return the Cholesky factor of the chain of poses after the first.

    It is a band matrix of LAPACK: row d is the d-th diagonal below the main diagonal.
    """
    n = 3 * len(equations.pose_block)
    band = np.zeros((_BAND + 1, n))
    for r in range(3):
        for q in range(3):
            if r >= q:
                band[r - q, q::3] = equations.pose_block[:, r, q]
            band[3 + r - q, q : n - 3 : 3] = equations.link[:, r, q]
    return scipy.linalg.cholesky_banded(band[:, 3:], lower=True, check_finite=False)
