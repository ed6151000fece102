"""Solution of the normal equations, and marginal covariances of poses and landmarks.

It takes the fewer of them the nearer a preconditioner is to the matrix's inverse.

Its matrix is large and has a factor; a product with it needs neither: it goes from the poses to the
points that they saw, and back. From one step to the next the matrix changes little, so that with
the factor of a step before a few products solve for a step.

With L the factor of the poses' information, C the poses' blocks with the landmarks and A the
landmarks' covariances if the path were known, the landmarks' joint covariance is A beside Y' Y with
Y = L^-1 C A. It has as many columns as there are coordinates of landmarks; C A has few entries.

Both are exact. With the landmarks gone a sparse system of the poses is left; with the poses gone,
which are a chain, a dense one of the landmarks and tracks. The one that takes fewer products is
solved. The first pose is the frame and no unknown.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.sparse import csr_array

from mapfusion.geometry.joint_covariance import RANK, KnownErrors, SharedErrors
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.smoother.cholesky import Envelope, Factor, factor_in_envelope
from mapfusion.smoother.normal_equations import Estimate, NormalEquations, Weights, point_equations
from mapfusion.smoother.problem import Sightings
from mapfusion.smoother.schur_complement import (
    Points,
    Reduced,
    along_points,
    along_way,
    known_points,
    left_couplings,
    moved_points,
    subtract_points,
    without_offsets,
)


def solved_by_products(
    times: Callable[[Float], Float],
    preconditioned: Callable[[Float], Float],
    right: Float,
    share: float,
    most: int,
) -> Float | None:
    """The x that the positive definite matrix turns into `right`, both of any shape.

    Args:
        times: the matrix times an x.
        preconditioned: about its inverse times a right side; positive definite, too.
        right: what the product is to be.
        share: of x that it may be off by, in the norm of the matrix.
        most: products that are tried.

    Returns:
        x; None where it took more, or the matrix is not positive definite.
    """
    x, residual = np.zeros_like(right), right.copy()
    news = direction = preconditioned(residual)
    square = float(np.vdot(residual, news))
    enough = share**2 * square
    for _ in range(most):
        if square <= enough:
            return x
        product = times(direction)
        curvature = float(np.vdot(direction, product))
        if not curvature > 0:
            return None
        x += square / curvature * direction
        residual -= square / curvature * product
        news, before = preconditioned(residual), square
        square = float(np.vdot(residual, news))
        direction = news + square / before * direction
    return x if square <= enough else None


# What a step may be off by, as a share of it, both in sigmas: what the last ones, of hundredths of
# a sigma, leave of it is nothing, and they mend what those before left. As each leaves a third and
# more for weights that follow it, to be closer makes no step needless.
_OFF = 1e-2
# A factor of its own costs as much as this many products and more.
_MOST_PRODUCTS = 15


@dataclass(frozen=True)
class ReducedPoses:
    """The equations of T poses, of which the first is known: its rows are zero.

    Attributes:
        seen: the observations.
        equations: all of them.
        left: once the offsets are eliminated.
    """

    seen: Sightings
    equations: NormalEquations
    left: Reduced

    def gradient(self) -> Float:
        """(T, 3)."""
        still = np.zeros_like(self.equations.points.track_gradient)
        return self._with_points(self.equations.pose_gradient, self.left, still)

    def times(self, way: Float) -> Float:
        """(T, 3) the matrix times a way (T, 3) of the poses."""
        link, gained = self.equations.link, np.zeros_like(self.left.pull)
        product = np.einsum("kij,kj->ki", self.equations.pose_block, way)
        product[1:] += np.einsum("kij,kj->ki", link, way[:-1])
        product[:-1] += np.einsum("kji,kj->ki", link, way[1:])
        along = along_way(self.seen, self.equations.coupling, way)
        unpulled = np.zeros_like(self.left.point_gradient)
        still = self.left._replace(pull=gained, point_gradient=unpulled)
        return self._with_points(product, still, along)

    def factor(self) -> Factor:
        """Of the matrix without the first pose, the others in their order.

        Raises:
            LinAlgError: the matrix is not positive definite.
        """
        envelope = self.seen.order.envelope
        S = envelope.zeros()
        _put_poses(S, envelope, self.seen.pose_place[1:] - 1, self.equations)
        subtract_points(self.seen, self.equations, self.left, S)
        return factor_in_envelope(S, envelope)

    def solved(self, factor: Factor, right: Float) -> Float:
        """(T, 3) what a matrix with this factor turns into `right` (T, 3)."""
        solved = factor.solve_transposed(factor.solve(self._ordered(right)))
        return self.by_frame(solved)

    def solved_nearby(self, factor: Factor, right: Float) -> Float | None:
        """(T, 3) what the matrix turns into `right` (T, 3), by a factor that is nearly its own.

        None where that is too far off.
        """

        def roughly(rest: Float) -> Float:
            return self.by_frame(factor.solve_both_roughly(self._ordered(rest)))

        return solved_by_products(self.times, roughly, right, _OFF, _MOST_PRODUCTS)

    def _ordered(self, of_poses: Float) -> Float:
        """(3 (T - 1),) values (T, 3) of the unknown poses, in their order."""
        ordered = np.empty((len(of_poses) - 1, 3))
        ordered[self.seen.pose_place[1:] - 1] = of_poses[1:]
        return ordered.ravel()

    def by_frame(self, ordered: Float) -> Float:
        """(T, 3) the same by frame; zero for the first pose."""
        place = self.seen.pose_place
        found = np.zeros((len(place), 3))
        found[1:] = ordered.reshape(-1, 3)[place[1:] - 1]
        return found

    def _with_points(self, of_poses: Float, left: Reduced, along: Float) -> Float:
        """With what points add that follow the poses."""
        moved = moved_points(self.seen, self.equations.points, left, along)
        total = of_poses + along_points(self.seen, self.equations.coupling, *moved)
        total[0] = 0.0
        return total


def _put_poses(S: Float, envelope: Envelope, place: np.ndarray, equations: NormalEquations) -> None:
    """What odometry and the poses' own observations say, by the `place` of each unknown pose."""
    S[envelope.where(place, place)] = equations.pose_block[1:]
    after, before, link = place[1:], place[:-1], equations.link[1:]
    link = np.where((after > before)[:, None, None], link, np.swapaxes(link, 1, 2))
    S[envelope.where(np.maximum(after, before), np.minimum(after, before))] = link


@dataclass(frozen=True)
class PathErrors:
    """Y (R, 3L), of the R coordinates of the unknown poses in their order.

    Attributes:
        seen: the observations.
        factor: L.
        moved: (N, 3, 3) entries of C A, by observation.
    """

    seen: Sightings
    factor: Factor
    moved: Float

    @classmethod
    def of(
        cls, seen: Sightings, equations: NormalEquations, own_m2: Float, factor: Factor
    ) -> "PathErrors":
        """Of equations that are solved, the landmarks first: with their `own_m2` and the factor."""
        left = without_offsets(seen, equations.points)
        coupling = left_couplings(seen, equations.coupling, left)
        return cls(seen, factor, coupling @ own_m2[seen.landmark])

    def __len__(self) -> int:
        return len(self.factor)

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """(R, r) columns of Y Y', those of `rows` (r,)."""
        chosen = np.zeros((len(self), len(rows)))
        chosen[rows, np.arange(len(rows))] = 1.0
        return self.gram(chosen)

    def gram(self, columns: Float) -> Float:
        """Y Y' times columns (R, c), in single precision."""
        moving = self._moving_roughly
        by_landmark = moving @ self.factor.solve_transposed(columns.astype(np.float32))
        return self.factor.solve(moving.T @ by_landmark).astype(np.float64)

    def spread(self, columns: Float) -> Float:
        """(3L, c) Y' times columns (R, c)."""
        return self._moving @ self.factor.solve_transposed(columns)

    def gathered(self, by_landmark: Float) -> Float:
        """Return (R, c) Y times columns (3L, c)."""
        return self.factor.solve(self._moving.T @ by_landmark)

    def squares(self) -> Float:
        """(L, 3, 3) blocks of Y' Y, each landmark's with itself."""
        total = np.zeros((self.seen.n_landmarks, 3, 3))
        covariance, offset = self.factor.inverse, self.factor.envelope.offset
        place = self.seen.unknown_place
        _add_squares(self.seen.starts, place, self.moved, offset, covariance, total)
        return total + np.swapaxes(total, 1, 2)

    @cached_property
    def _moving(self) -> csr_array:
        """(3L, R) A C', of which each observation is a block."""
        place, each = self.seen.unknown_place, np.arange(3)
        known = place >= 0
        rows = 3 * self.seen.landmark[known, None] + each
        columns = 3 * place[known, None] + each
        rows, columns = np.broadcast_arrays(rows[:, None, :], columns[:, :, None])
        shape = 3 * self.seen.n_landmarks, len(self)
        return csr_array((self.moved[known].ravel(), (rows.ravel(), columns.ravel())), shape)

    @cached_property
    def _moving_roughly(self) -> csr_array:
        """The same in single precision."""
        known = self._moving
        entries = known.data.astype(np.float32), known.indices, known.indptr
        return csr_array(entries, known.shape)


@kernel
def _add_squares(
    starts: np.ndarray,
    place: np.ndarray,
    moved: Float,
    offset: np.ndarray,
    Z: Float,
    total: Float,
) -> None:
    """Of each landmark what, with its transpose, is moved' Z moved of all that saw it."""
    of_pose = np.empty((3, 3))
    for j in range(len(starts) - 1):
        for i in range(starts[j], starts[j + 1]):
            if place[i] < 0:
                continue
            for r in range(3):
                for q in range(3):
                    of_pose[r, q] = 0.0
            for k in range(starts[j], i + 1):
                if place[k] >= 0:
                    share = 0.5 if k == i else 1.0
                    # Add a share of the poses' covariance times what moves observation k's
                    # landmark.
                    row = 3 * place[i]
                    column = 3 * place[k]
                    above = row < column  # its mirror image is stored
                    down, across = (column, row) if above else (row, column)
                    at0, at1, at2 = (
                        offset[down] + across,
                        offset[down + 1] + across,
                        offset[down + 2] + across,
                    )
                    for q in range(3):
                        x, y, z = (
                            share * moved[k, 0, q],
                            share * moved[k, 1, q],
                            share * moved[k, 2, q],
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
                        moved[i, 0, r] * of_pose[0, q]
                        + moved[i, 1, r] * of_pose[1, q]
                        + moved[i, 2, r] * of_pose[2, q]
                    )


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
