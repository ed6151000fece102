"""Errors of second order: of a chain that is composed, of data that are solved, and at the end."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose
from mapfusion.robot_log import Observations, RobotLog
from mapfusion.smoother import second_order
from mapfusion.smoother.normal_equations import Estimate
from mapfusion.smoother.optimizer import OptimizerState, Problem, linearize_and_solve, optimize
from mapfusion.smoother.problem import order_observations
from mapfusion.smoother.second_order import second_order_errors
from mapfusion.smoother.smooth import Smoothed, SmootherParameters, condensed_points, smooth
from tests.benchmarks.synthetic_drives import reckoned
from tests.helpers.synthetic_drives import Drive, drive

# Each step is one metre. The heading is off by 0.15 rad in the end, the way too short by a third of
# a metre, and its length is known to a fifth of a metre.
N_STEPS = 60
NOISE = MotionNoise(rotation_rad_per_sqrt_m=0.02, rotation_rad_per_sqrt_rad=0, track_error=0)
SIGMA_M = 0.01


def chain(rng: np.random.Generator) -> Drive:
    """Return a straight drive in which each frame sees a landmark of its own: nothing is held."""
    motion = np.tile([1.0, 0.0, 0.0], (N_STEPS + 1, 1))
    motion[0] = 0.0
    sigma = np.array([NOISE.standard_deviations(each) for each in motion])
    path = reckoned(motion + sigma * rng.standard_normal(motion.shape))
    seen_m = np.tile([2.0, 1.0, 0.5], (len(path), 1))
    point_m = seen_m.copy()
    point_m[:, :2] = compose(path, np.c_[seen_m[:, :2], np.zeros(len(path))])[:, :2]
    position = seen_m + SIGMA_M * rng.standard_normal(seen_m.shape)
    covariance = np.tile(SIGMA_M**2 * np.eye(3), (len(path), 1, 1))
    frame = np.arange(len(path))
    obs = Observations(position, covariance, None, frame.astype(np.int32))
    return Drive(RobotLog("R1", False, frame.astype(np.float64), motion, frame, obs), path, point_m)


def solved_chain() -> tuple[Problem, OptimizerState]:
    """Return a chain, whose most probable path is that of the odometry."""
    driven = chain(np.random.default_rng(0))
    obs = order_observations(driven.log, np.arange(N_STEPS + 1), 1, with_offsets=False)
    information = SmootherParameters(NOISE).odometry_information(driven.log)
    problem = Problem(obs, driven.log.odometry, information, 0.0)
    path = reckoned(driven.log.odometry)
    point_m = driven.log.observations.position_m.copy()
    point_m[:, :2] = compose(path, np.c_[point_m[:, :2], np.zeros(len(path))])[:, :2]
    at = Estimate(path, point_m, np.zeros((len(obs.has_offset), 3)))
    return problem, optimize(problem, at)


def test_mean_squares_are_those_of_chains_that_are_composed() -> None:
    """Compare with 5 000 paths of random disturbances: path length and last landmark."""
    problem, end = solved_chain()
    found = second_order_errors(problem, end)
    assert found is not None
    rng = np.random.default_rng(1)
    sigma = 1 / np.sqrt(problem.information)
    noisy = problem.odometry[1:] + sigma * rng.standard_normal((5_000, *sigma.shape))
    pose = np.zeros((len(noisy), 3))
    for k in range(N_STEPS):
        pose = compose(pose, noisy[:, k])
    end_m = end.estimate.path[-1, 0]
    true_m2 = np.mean((pose[:, 0] - end_m) ** 2)
    linear_m2 = np.sum(sigma[:, 0] ** 2)
    assert true_m2 > 3 * linear_m2
    added_m2 = found.pose_covariances()[N_STEPS, 0, 0]
    assert added_m2 == pytest.approx(true_m2 - linear_m2, rel=0.3)
    of_landmark_m2 = np.sum(found.point_m[:, -1, 0] ** 2)
    assert of_landmark_m2 == pytest.approx(added_m2, rel=0.2)


def test_is_off_by_what_fits_the_same_data() -> None:
    """Data to first order of an error, by differences, are solved by steps: an error and q more."""
    driven = drive("lap", 120, 1.0, 0)
    label = driven.log.observations.label
    assert label is not None
    found = smooth(driven.log, label, driven.path, SmootherParameters())
    assert found.second_order is None  # the path is short
    information = SmootherParameters().odometry_information(driven.log) / found.odometry_scales
    problem = Problem(found.obs, driven.log.odometry, information, 0.0)
    end = linearize_and_solve(problem, found.estimate, found.weights, found.tails)
    drawing, at, small = second_order._Drawing.of(problem, end), end.estimate, 1e-3
    error = drawing._draw(np.random.default_rng(0))
    path, point_m = drawing._second_order(error)

    here, ahead, behind = (_data(found, _moved(at, error, k)) for k in (0, small, -small))
    odometry, position_m = (
        now + (one - other) / (2 * small)
        for now, one, other in zip(here, ahead, behind, strict=True)
    )
    fitted = problem._replace(odometry=odometry, obs=replace(found.obs, position_m=position_m))
    again = first = _moved(at, error, 1.0)
    for _ in range(4):
        step = linearize_and_solve(fitted, again, found.weights, found.tails).solution.step
        again = _moved(again, step, 1.0)
    off = np.linalg.norm(again.path - first.path - path)
    assert off < 0.05 * np.linalg.norm(path)
    assert np.linalg.norm(again.point_m - first.point_m - point_m) < 0.05 * np.linalg.norm(point_m)


def _moved(at: Estimate, error: Estimate, share: float) -> Estimate:
    return Estimate(*(old + share * off for old, off in zip(at, error, strict=True)))


def _data(found: Smoothed, at: Estimate) -> tuple[Float, Float]:
    """Return odometry (T, 3) and observations (N, 3) that fit an estimate exactly."""
    odometry = np.zeros_like(at.path)
    odometry[1:] = between(at.path[:-1], at.path[1:])
    pose, point_m = at.path[found.obs.frame], at.point_m[found.obs.landmark]
    position_m = between(pose, np.c_[point_m[:, :2], np.zeros(len(pose))])
    return odometry, np.c_[position_m[:, :2], point_m[:, 2]]


def test_a_path_that_is_too_short_is_in_the_covariances() -> None:
    """The NEES of a 60 m chain is far above one without the errors of second order."""
    known = []
    for seed in range(12):
        driven = chain(np.random.default_rng(seed))
        parameters = SmootherParameters(NOISE, min_count=1)
        found = smooth(
            driven.log, np.arange(N_STEPS + 1), reckoned(driven.log.odometry), parameters
        )
        off = (found.estimate.point_m - driven.point_m)[1:]
        joint = condensed_points(found)[1].marginal_m2[1:]
        known.append(
            np.mean(np.einsum("ni,ni->n", off, np.linalg.solve(joint, off[..., None])[..., 0]))
        )
    assert 0.5 < np.mean(known) / 3 < 2


def test_is_that_of_the_estimate_whatever_equations_led_to_it() -> None:
    """The last step goes on from the equations whose factor is known; the path may bend by it."""
    problem, end = solved_chain()
    error = second_order._Drawing.of(problem, end)._draw(np.random.default_rng(0))
    at = _moved(end.estimate, error, 0.1)
    fresh = linearize_and_solve(problem, at, end.weights, end.tails)
    found = second_order_errors(problem, end._replace(estimate=at))
    expected = second_order_errors(problem, fresh)
    assert found is not None
    assert expected is not None
    np.testing.assert_allclose(found.path, expected.path, rtol=1e-9, atol=1e-9)


def test_a_path_that_turns_nowhere_has_none() -> None:
    """The heading is known, and with it everything is linear."""
    problem, end = solved_chain()
    information = problem.information * [1, 1, 1e6]
    problem = problem._replace(information=information)
    assert second_order_errors(problem, optimize(problem, end.estimate)) is None
