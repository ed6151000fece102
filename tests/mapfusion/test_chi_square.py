"""Chi-square bounds against draws and closed forms."""

import math

import numpy as np

from mapfusion.geometry.numerics import chi_square_bound


def test_two_degrees_of_freedom_have_a_closed_form() -> None:
    for probability in (0.5, 0.99, 0.999):
        assert math.isclose(chi_square_bound(probability, 2), -2 * math.log1p(-probability))


def test_share_of_draws_below() -> None:
    squares = np.random.default_rng(0).standard_normal((100_000, 3)) ** 2
    below = np.mean(squares.sum(axis=1) <= chi_square_bound(0.9, 3))
    assert abs(below - 0.9) < 4 * math.sqrt(0.9 * 0.1 / len(squares))
