"""Whether the landmarks of pairs can determine a motion of the plane."""

import numpy as np

from mapfusion.align.pairs import Pairs
from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float

# probability that points without extent pass for a shape by their noise alone
SHAPE_FALSE_ALARM = 1e-3


def lacks_extent(p: Float, covariance_m2: Float, drift_m2: float, dimensions: int) -> bool:
    """Whether points may lie on one point of the plane (dimensions 1) or on one line (2).

    Points are (N, 2 or more), N at least 1, with covariances (N, 2 or more, likewise) and s_drift^2
    on top of each. Exact zeros never occur: the spread along the weakest of the strongest
    `dimensions` principal axes is compared with what the noise along it would give (chi-square).
    """
    scatter, noise_m2, largest = _moments(p, covariance_m2)
    spread, axes = np.linalg.eigh(scatter)  # ascending
    axis = axes[:, 2 - dimensions]
    noise = axis @ noise_m2 @ axis + drift_m2
    # rounding alone leaves this much, as in numpy.linalg.matrix_rank
    rounding = (len(p) * np.finfo(np.float64).eps * largest) ** 2
    freedom = max(len(p) - dimensions, 1)
    most = noise * chi_square_bound(1 - SHAPE_FALSE_ALARM, freedom) + rounding
    return bool(spread[2 - dimensions] <= most)


def _moments(p: Float, covariance_m2: Float) -> tuple[Float, Float, float]:
    """In plan: scatter about the mean (2, 2), mean covariance (2, 2), largest coordinate."""
    n, in_plan = len(p), np.ascontiguousarray(p.T[:2])
    share = np.full(n, 1 / n)
    off = in_plan - in_plan[:, :1]  # far from the origin as exact as near it
    off -= (off @ share)[:, None]
    mean = (share @ covariance_m2.reshape(n, -1)).reshape(covariance_m2.shape[1:])
    return off @ off.T, mean[:2, :2], np.abs(in_plan).max()


def why_one_place(pairs: Pairs, drift_m2: float = 0.0) -> str:
    """Why the angle between the maps is open: all pairs (1 or more) lie on one point of either."""
    for name, p, covariance in (
        ("a", pairs.p_a, pairs.covariance_a),
        ("b", pairs.p_b, pairs.covariance_b),
    ):
        if lacks_extent(p, covariance, drift_m2, 1):
            return f"in plan map {name}'s landmarks lie on one point, as far as noise can tell"
    return ""


def why_one_line(pairs: Pairs) -> str:
    """Why an affine map from b to a is open: in plan all of map b's landmarks lie on one line."""
    if lacks_extent(pairs.p_b, pairs.covariance_b, 0.0, 2):
        return "in plan the landmarks of map b lie on one line, as far as their noise can tell"
    return ""
