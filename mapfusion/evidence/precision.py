"""How surely an alignment lays one map onto the other."""

import numpy as np

from mapfusion.se2 import Float, transform_points


def laid_sigma_m(T_a_b: Float, covariance: Float, p_b: Float) -> float:
    """By how far the landmarks of map b lie off for the alignment's sake, RMS, in metres.

    To first order: the mean over the landmarks of tr(J S J') with J = d(T p_b)/dT. What supports an
    alignment lies in one part of the map; what the angle leaves open there grows with the distance.

    Args:
        T_a_b: (3,).
        covariance: (3, 3) of it.
        p_b: (N, 2) positions in metres.
    """
    x, y = (transform_points(T_a_b, p_b) - T_a_b[:2]).T
    moved_by_angle = x**2 + y**2
    with_shift = x * covariance[1, 2] - y * covariance[0, 2]
    squares = covariance[0, 0] + covariance[1, 1] + 2 * with_shift
    return float(np.sqrt(np.mean(squares + moved_by_angle * covariance[2, 2])))
