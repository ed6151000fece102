"""The degrees of freedom are found again in what was drawn with them."""

import numpy as np
import pytest

from mapfusion.smoother.student import fitted_dof, student_cost, student_weights


@pytest.mark.parametrize("n_dimensions", [2, 3])
@pytest.mark.parametrize("dof", [2.5, 5.0, 20.0])
def test_found_in_draws(dof: float, n_dimensions: int) -> None:
    """A Student-t is a Gaussian over the root of a chi-square by its degrees of freedom."""
    rng = np.random.default_rng(1)
    normal = rng.standard_normal((40_000, n_dimensions))
    squares = np.sum(normal**2, axis=1) / (rng.chisquare(dof, 40_000) / dof)
    assert fitted_dof(squares, n_dimensions) == pytest.approx(dof, rel=0.1)


def test_gaussian_draws_keep_their_weights() -> None:
    squares = np.sum(np.random.default_rng(0).standard_normal((40_000, 3)) ** 2, axis=1)
    dof = fitted_dof(squares, 3)
    assert dof > 100
    np.testing.assert_allclose(student_weights(squares, dof, 3), 1, atol=0.2)


def test_weights_are_the_slope_of_the_cost() -> None:
    """What reweighted least squares needs: d cost / d square = weight."""
    for square in (0.1, 2.0, 30.0):
        about = [student_cost(np.array([square + h]), 4.0, 3) for h in (-1e-5, 1e-5)]
        slope = (about[1] - about[0]) / 2e-5
        assert slope == pytest.approx(student_weights(np.array([square]), 4.0, 3)[0], rel=1e-6)
