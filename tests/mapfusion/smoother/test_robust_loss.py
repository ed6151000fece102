"""The degrees of freedom are found again in what was drawn with them."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from mapfusion.smoother.robust_loss import (
    LEAST_DOF,
    MOST_DOF,
    fit_dof,
    information_share,
    student_bound,
    student_cost,
    student_deviance,
    student_slope,
    student_weights,
)


@pytest.mark.parametrize("n_dimensions", [2, 3])
@pytest.mark.parametrize("dof", [2.5, 5.0, 20.0])
def test_found_in_draws(dof: float, n_dimensions: int) -> None:
    """A Student-t is a Gaussian over the root of a chi-square by its degrees of freedom."""
    rng = np.random.default_rng(1)
    normal = rng.standard_normal((40_000, n_dimensions))
    squares = np.sum(normal**2, axis=1) / (rng.chisquare(dof, 40_000) / dof)
    assert fit_dof(squares, n_dimensions) == pytest.approx(dof, rel=0.1)


def test_gaussian_draws_keep_their_weights() -> None:
    squares = np.sum(np.random.default_rng(0).standard_normal((40_000, 3)) ** 2, axis=1)
    dof = fit_dof(squares, 3)
    assert dof > 100
    np.testing.assert_allclose(student_weights(squares, dof, 3), 1, atol=0.2)


def test_weights_are_the_slope_of_the_cost() -> None:
    """The derivative of the cost by the square is the weight, as reweighted least squares needs."""
    for square in (0.1, 2.0, 30.0):
        about = [student_cost(np.array([square + h]), 4.0, 3) for h in (-1e-5, 1e-5)]
        slope = (about[1] - about[0]) / 2e-5
        assert slope == pytest.approx(student_weights(np.array([square]), 4.0, 3)[0], rel=1e-6)


@pytest.mark.parametrize("dof", [2.5, 30.0])
def test_as_many_as_stated_are_beyond_the_bound(dof: float) -> None:
    rng = np.random.default_rng(2)
    normal, scale = rng.standard_normal((200_000, 3)), rng.chisquare(dof, 200_000) / dof
    squares = np.sum(normal**2, axis=1) / scale
    beyond = np.mean(squares > student_bound(0.99, dof, 3))
    assert beyond == pytest.approx(0.01, abs=4 * np.sqrt(0.01 / 200_000))


@pytest.mark.parametrize("dof", [3.0, 10.0, MOST_DOF])
def test_estimates_are_as_far_off_as_the_information_says(dof: float) -> None:
    """Many locations, each the robust mean of 50 draws: their spread is that of the information."""
    rng, n_draws = np.random.default_rng(3), 50
    normal = rng.standard_normal((4_000, n_draws, 2))
    drawn = normal / np.sqrt(rng.chisquare(dof, (4_000, n_draws, 1)) / dof)
    at = np.zeros((4_000, 1, 2))
    for _ in range(60):
        weight = student_weights(np.sum((drawn - at) ** 2, axis=2), dof, 2)[:, :, None]
        at = np.sum(weight * drawn, axis=1, keepdims=True) / np.sum(weight, axis=1, keepdims=True)
    information = information_share(dof, 2) * np.sum(weight, axis=1).mean()
    assert np.mean(at**2) * information == pytest.approx(1, abs=0.06)


def drawn_squares(dof: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances, and in how many dimensions each is: a third of them in none."""
    rng = np.random.default_rng(5)
    dimensions = rng.uniform(0, 3, n) * (rng.uniform(size=n) > 1 / 3)
    return rng.chisquare(dimensions + 1e-9) / (rng.chisquare(dof, n) / dof), dimensions


@pytest.mark.parametrize("dof", [0.7, 6.0, 900.0])
def test_slope_is_that_of_the_deviance(dof: float) -> None:
    squares, dimensions = drawn_squares(4.0, 500)
    for n in (3, dimensions):
        about = [student_deviance(squares, dof * np.exp(h), n) for h in (-1e-4, 1e-4)]
        slope = (about[1] - about[0]) / 2e-4
        assert student_slope(squares, dof, n) == pytest.approx(slope, rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("dof", [0.1, 2.0, 8.0, 60.0, 1e9])
def test_fitted_are_the_likeliest(dof: float) -> None:
    """Against a search of the deviance itself, and wherever they are looked for first."""
    squares, dimensions = drawn_squares(dof, 3000)
    for n in (3, dimensions):
        bounds = (np.log(LEAST_DOF), np.log(MOST_DOF))

        def deviance(log_dof: float, n: int | np.ndarray = n) -> float:
            return student_deviance(squares, float(np.exp(log_dof)), n)

        twin = minimize_scalar(deviance, bounds=bounds, method="bounded", options={"xatol": 1e-7})
        found = fit_dof(squares, n)
        assert found == pytest.approx(np.exp(twin.x), rel=1e-4)
        for near in (found, 1.05 * found, 0.5, 7.0):
            assert fit_dof(squares, n, near) == pytest.approx(found, rel=1e-5)


def test_nothing_tells_no_tails() -> None:
    assert fit_dof(np.empty(0), np.empty(0)) == MOST_DOF
