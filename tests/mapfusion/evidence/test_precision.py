"""How far landmarks lie off for an alignment's sake, against drawn alignments."""

import numpy as np
import pytest

from mapfusion.geometry import se2
from mapfusion.verification.verdict import laid_sigma_m

COVARIANCE = np.array([[4.0, 1.0, -0.6], [1.0, 3.0, 0.5], [-0.6, 0.5, 0.4]]) * 1e-4
P_B = np.random.default_rng(0).uniform([2, -9], [12, 3], (40, 2))


@pytest.mark.parametrize("T_a_b", [[0.0, 0.0, 0.0], [5.0, -3.0, 2.1]])
def test_it_is_the_rms_of_what_drawn_alignments_do(T_a_b: list[float]) -> None:
    T = np.array(T_a_b)
    drawn = np.random.default_rng(1).multivariate_normal(T, COVARIANCE, 4000)
    laid = np.stack([se2.transform_points(each, P_B) for each in drawn])
    off = laid - se2.transform_points(T, P_B)
    expected = np.sqrt(np.mean(np.sum(off**2, axis=2)))
    assert laid_sigma_m(T, COVARIANCE, P_B) == pytest.approx(expected, rel=0.03)


def test_where_the_frames_have_their_origins_does_not_matter() -> None:
    """The same two maps with b's origin elsewhere: T, its covariance and p_b change, not this."""
    T, shift = np.array([1.0, 2.0, 0.7]), np.array([300.0, -80.0])
    cos, sin = np.cos(T[2]), np.sin(T[2])
    moved = se2.rotation(T[2]) @ shift
    J = np.eye(3)
    J[:2, 2] = sin * shift[0] + cos * shift[1], -cos * shift[0] + sin * shift[1]
    there = laid_sigma_m(T - [*moved, 0.0], J @ COVARIANCE @ J.T, P_B + shift)
    assert there == pytest.approx(laid_sigma_m(T, COVARIANCE, P_B), rel=1e-9)
