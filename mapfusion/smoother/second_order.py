"""Second-order errors of path and landmarks, in addition to those of the linearised equations.

With an error e of the heading, a path of length s ends s e to the side and s e^2 / 2 short. The
linearised equations have only the first error. On a long path the second can exceed the stated
standard deviation.

With the residuals r(x + d) = r + J d + rho(d) to second order in an error d, and their information
W, the estimate that fits the same data as x + d is off by a further

    q(d) = -(J' W J)^-1 J' W rho(d)

(Box 1971, "Bias in nonlinear estimation", J. R. Stat. Soc. B 33). Errors d are normal with the
covariance (J' W J)^-1. Their third moments vanish, so that d and q(d) are uncorrelated and the mean
square of the whole error is (J' W J)^-1 + E[q q']. The last is the mean over random draws of d.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import rotation, wrap
from mapfusion.smoother.elimination import ReducedPoses
from mapfusion.smoother.normal_equations import (
    Estimate,
    Weights,
    disturbance_jacobians,
    disturbances,
    normal_equations,
)
from mapfusion.smoother.optimizer import OptimizerState, Problem, linearize_and_solve
from mapfusion.smoother.robust_loss import information_shares
from mapfusion.smoother.schur_complement import (
    coupling_times_poses,
    eliminate_offsets,
    substitute_points,
)

# Number of draws. The relative error of the mean square is a third in the worst case, the square of
# one normal variable. Usually several directions contribute and it is smaller.
_DRAWS = 100
# Second-order errors are ignored if they add less than this share to the covariance of every pose
# (2.5 % of a standard deviation). A bound is tested first, and then a few draws.
_FIRST_DRAWS, _NEGLIGIBLE = 4, 0.05
_SEED = 0


class SecondOrder(NamedTuple):
    """Independent errors whose squares add to the covariance.

    Attributes:
        path: errors of the poses, shape (S, T, 3).
        point_m: errors of the landmarks, shape (S, L, 3).
    """

    path: Float
    point_m: Float

    def pose_covariances(self) -> Float:
        """Return the second-order covariances of all poses, shape (T, 3, 3)."""
        return np.einsum("sti,stj->tij", self.path, self.path)


def second_order_errors(problem: Problem, state: OptimizerState) -> SecondOrder | None:
    """Return the second-order errors of an estimate; None if they are negligible.

    If the poses are eliminated first (`elimination.py`), all poses see the same few landmarks,
    which determine the headings. There are no second-order errors then.

    Args:
        problem: the problem with the final noise scales.
        state: the smoothed state.
    """
    if not state.solution.landmarks_first or len(state.estimate.path) < 2:
        return None
    problem = problem._replace(obs=state.obs)
    factor, index = state.solution.factor, state.obs.pose_index[1:] - 1
    covariance = factor.envelope.between(factor.inverse, index, index)

    # Bound: suppose that every error of the heading shortens its part of the path, and that no
    # observation corrects it. The error b of a pose is then the sum of length * variance / 2. Its
    # mean square is at most 3 b^2, as for the square of one normal variable.
    estimate = state.estimate.path
    length_m = np.linalg.norm(np.diff(estimate[:, :2], axis=0), axis=1)
    error_m = np.cumsum(length_m * covariance[:, 2, 2]) / 2
    xx, yy, xy = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]
    largest_m2 = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
    # the squared error over the smallest variance in any direction
    if np.max(error_m**2 * largest_m2 / (xx * yy - xy**2)) < _NEGLIGIBLE:
        return None
    path, _ = _Drawing.of(problem, state).errors(np.random.default_rng(_SEED), _FIRST_DRAWS)
    squares = np.einsum("ski,skj->kij", path[:, 1:], path[:, 1:]) / len(path)
    squared_sigmas = np.trace(np.linalg.solve(covariance, squares), axis1=1, axis2=2) / 3
    if np.max(squared_sigmas) < _NEGLIGIBLE:
        return None
    # Matrix and gradient have to be of the same estimate, because small differences in stiff
    # directions cause large errors in weak ones.
    state = linearize_and_solve(problem, state.estimate, state.weights, state.tails)
    path, point_m = _Drawing.of(problem, state).errors(np.random.default_rng(_SEED), _DRAWS)
    share = 1 / np.sqrt(_DRAWS)
    return SecondOrder(share * path, share * point_m)


class _Drawing(NamedTuple):
    """Random errors of an estimate; the attributes are common to all draws.

    Attributes:
        problem: the least-squares problem.
        state: the smoothed state.
        at: its estimate.
        weights: weights of the matrix of the equations.
        poses: the equations of the poses.
        to_robot: rotations from the map frame to the robot frame of each observation, shape
            (N, 2, 2).
        predicted_m: predicted observations in the robot frame, shape (N, 3).
    """

    problem: Problem
    state: OptimizerState
    at: Estimate
    weights: Weights
    poses: ReducedPoses
    to_robot: Float
    predicted_m: Float

    @classmethod
    def of(cls, problem: Problem, state: OptimizerState) -> "_Drawing":
        """Return the common quantities of a smoothed state."""
        obs, at = state.obs, state.estimate
        shares = information_shares(state.tails, obs.n_dimensions)
        weights = Weights(
            shares.observation * state.weights.observation, shares.offset * state.weights.offset
        )
        poses = ReducedPoses(obs, state.equations, eliminate_offsets(obs, state.equations.points))
        to_robot = np.swapaxes(rotation(at.path[obs.frame, 2]), 1, 2)
        predicted_m = _predicted_observations(state, at)
        return cls(problem, state, at, weights, poses, to_robot, predicted_m)

    def errors(self, rng: np.random.Generator, n: int) -> tuple[Float, Float]:
        """Return n draws of q: errors (n, T, 3) of the path and (n, L, 3) of the landmarks."""
        path = np.empty((n, *self.at.path.shape))
        point_m = np.empty((n, *self.at.point_m.shape))
        for k in range(n):
            path[k], point_m[k] = self._second_order(self._draw(rng))
        return path, point_m

    def _draw(self, rng: np.random.Generator) -> Estimate:
        """Draw an error d of the path and of the points, given the path.

        The points' errors for a known path have no second-order effect and are left out.
        """
        factor, reduced = self.state.solution.factor, self.poses.reduced
        normal = rng.standard_normal(len(factor))
        path_step = self.poses.by_frame(factor.solve_transposed(normal))
        still = reduced._replace(
            offset_gradient=np.zeros_like(reduced.offset_gradient),
            point_gradient=np.zeros_like(reduced.point_gradient),
        )
        equations = self.state.equations
        path_term = coupling_times_poses(self.state.obs, equations.coupling, path_step)
        return Estimate(
            path_step, *substitute_points(self.state.obs, equations.points, still, path_term)
        )

    def _second_order(self, error: Estimate) -> tuple[Float, Float]:
        """Return q of path and landmarks for an error d.

        The equations get data whose residuals are rho(d). Offsets are residuals themselves and have
        no second-order part.
        """
        obs, at, path_step = self.state.obs, self.at, error.path
        moved = Estimate(*(old + displacement for old, displacement in zip(at, error, strict=True)))
        jacobian_before, jacobian_after = disturbance_jacobians(at.path)
        disturbance = disturbances(at.path, self.problem.odometry)
        linear = np.einsum("kij,kj->ki", jacobian_before, path_step[:-1])
        linear += np.einsum("kij,kj->ki", jacobian_after, path_step[1:])
        of_motion = disturbances(moved.path, self.problem.odometry) - disturbance - linear
        of_motion[:, 2] = wrap(of_motion[:, 2])
        odometry = self.problem.odometry.copy()
        odometry[1:] += disturbance - of_motion

        displacement = error.point_m[obs.landmark] + error.offset_m[obs.track]
        displacement[:, :2] -= path_step[obs.frame, :2]
        displacement[:, :2] = np.einsum("nij,nj->ni", self.to_robot, displacement[:, :2])
        turned = path_step[obs.frame, 2]
        displacement[:, 0] += turned * self.predicted_m[:, 1]
        displacement[:, 1] -= turned * self.predicted_m[:, 0]
        of_points = _predicted_observations(self.state, moved) - self.predicted_m - displacement
        explained = replace(obs, position_m=self.predicted_m - of_points)
        offset_prior, information = self.problem.offset_prior, self.problem.information
        equations = normal_equations(
            explained, at, self.weights, offset_prior, odometry, information
        )
        equations.points.offset_gradient[:] = 0
        reduced = eliminate_offsets(obs, equations.points)
        gradient = ReducedPoses(obs, equations, reduced).gradient()
        path_q = self.poses.solve(self.state.solution.factor, -gradient)
        path_term = coupling_times_poses(obs, equations.coupling, path_q)
        return path_q, substitute_points(obs, equations.points, reduced, path_term)[0]


def _predicted_observations(state: OptimizerState, at: Estimate) -> Float:
    """Return the point of each observation in the robot frame, shape (N, 3)."""
    obs = state.obs
    point, pose = at.point_m[obs.landmark] + at.offset_m[obs.track], at.path[obs.frame]
    offset = point[:, :2] - pose[:, :2]
    point[:, :2] = np.einsum("nji,nj->ni", rotation(pose[:, 2]), offset)
    return point
