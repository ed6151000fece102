"""Whether the landmarks of pairs can determine a motion of the plane."""

import math

import numpy as np

from mapfusion.align.pairs import Pairs
from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float

# probability that points without extent pass for a shape by their noise alone
SHAPE_FALSE_ALARM = 1e-3


def lacks_extent(p: Float, covariance_m2: Float, drift_m2: float, dimensions: int) -> bool:
    """Return True if points may lie on one point of the plane (dimensions 1) or on one line (2).

    Points are (N, 2 or more), N at least 1, with covariances (N, 2 or more, likewise) and s_drift^2
    on top of each. Exact zeros never occur: the squared deviations along the weakest of the
    strongest `dimensions` principal axes, each over its own variance, are compared with the
    chi-square distribution that noise alone gives them (Cochran 1954, the Q statistic). So an
    uncertain landmark counts little, and does not hide the extent of the others.
    """
    in_plan = np.ascontiguousarray(p.T[:2])
    off = in_plan - in_plan[:, :1]  # far from the origin as exact as near it
    # rounding alone leaves this much, as in numpy.linalg.matrix_rank
    rounding = len(p) * np.finfo(np.float64).eps * np.abs(in_plan).max()
    floor_m2 = drift_m2 + rounding**2 + np.finfo(np.float64).tiny
    xx, xy, yy = (covariance_m2[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    weight = 1 / ((xx + yy) / 2 + floor_m2)
    off -= (off @ weight / weight.sum())[:, None]
    x, y = np.linalg.eigh((off * weight) @ off.T)[1][:, 2 - dimensions]  # eigenvalues ascend
    weight = 1 / (x * x * xx + 2 * x * y * xy + y * y * yy + floor_m2)
    along = x * off[0] + y * off[1]
    along -= along @ weight / weight.sum()
    freedom = max(len(p) - dimensions, 1)
    return bool(weight @ along**2 <= chi_square_bound(1 - SHAPE_FALSE_ALARM, freedom))


def why_one_place(pairs: Pairs, drift_m2: float = 0.0, which: str = " that agree") -> str:
    """Return why the angle between the maps is open; empty if the pairs (1 or more) determine it.

    The angle is open if all pairs lie on one point of either map. `which` pairs they are, the
    reason says.
    """
    for name, p, covariance in (
        ("a", pairs.p_a, pairs.covariance_a),
        ("b", pairs.p_b, pairs.covariance_b),
    ):
        if lacks_extent(p, covariance, drift_m2, 1):
            n = len(pairs)
            lie = f"pairs{which} lie" if n > 1 else f"pair{which.replace('agree', 'agrees')} lies"
            sigma_m = math.sqrt(np.median(covariance[:, [0, 1], [0, 1]]) + drift_m2)
            noise = f"noise of {sigma_m:.2g} m can tell"
            return f"the {n} {lie} on one point of map {name} in plan, as far as {noise}"
    return ""


def why_one_line(pairs: Pairs) -> str:
    """Return why an affine map from b to a is open; empty if the pairs determine it.

    It is open if in plan all landmarks of map b that have a pair lie on one line.
    """
    if lacks_extent(pairs.p_b, pairs.covariance_b, 0.0, 2):
        n = len(pairs)
        return f"the {n} pairs lie on one line of map b in plan, as far as noise can tell"
    return ""
