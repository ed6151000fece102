"""Whether the landmarks of pairs can determine a motion of the plane."""

import numpy as np

from mapfusion.align.pairs import Pairs
from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float

# probability that points without extent pass for a shape by their noise alone
SHAPE_FALSE_ALARM = 1e-3


def lacks_extent(p: Float, covariance_m2: Float, dimensions: int) -> bool:
    """Whether points (N, 2) may lie on one point (dimensions 1) or on one line (dimensions 2).

    Exact zeros never occur: the spread along the weakest of the strongest `dimensions` principal
    axes is compared with what the landmarks' own noise, (2, 2) in the mean, along it would give
    (chi-square).
    """
    centred = p - _mean(p)
    spread, axes = np.linalg.eigh(centred.T @ centred)  # ascending
    axis = axes[:, 2 - dimensions]
    noise = axis @ covariance_m2 @ axis
    # rounding alone leaves this much, as in numpy.linalg.matrix_rank
    rounding = (len(p) * np.finfo(np.float64).eps * np.abs(p).max()) ** 2
    freedom = max(len(p) - dimensions, 1)
    most = noise * chi_square_bound(1 - SHAPE_FALSE_ALARM, freedom) + rounding
    return bool(spread[2 - dimensions] <= most)


def _mean(values: Float) -> Float:
    """Mean of N small arrays: as one product, since NumPy sums short rows slowly."""
    n = len(values)
    return (np.full(n, 1 / n) @ values.reshape(n, -1)).reshape(values.shape[1:])


def why_one_place(pairs: Pairs, drift_m2: float = 0.0) -> str:
    """Why the angle between the maps is open: all pairs (1 or more) lie on one point of either."""
    drift = drift_m2 * np.eye(2)
    for name, p, covariance in (
        ("a", pairs.p_a, pairs.covariance_a),
        ("b", pairs.p_b, pairs.covariance_b),
    ):
        if lacks_extent(p[:, :2], _mean(covariance)[:2, :2] + drift, 1):
            return f"in plan map {name}'s landmarks lie on one point, as far as noise can tell"
    return ""


def why_one_line(pairs: Pairs) -> str:
    """Why an affine map from b to a is open: in plan all of map b's landmarks lie on one line."""
    if lacks_extent(pairs.p_b[:, :2], _mean(pairs.covariance_b)[:2, :2], 2):
        return "in plan the landmarks of map b lie on one line, as far as their noise can tell"
    return ""
