"""Interface of an alignment method, and the test for degenerate landmarks."""

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from mapfusion.align.alignment import Pairs
from mapfusion.geometry.numerics import Float, chi_square_bound

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


def why_angle_is_open(pairs: Pairs, drift_m2: float = 0.0, which: str = " that agree") -> str:
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


def why_affine_map_is_open(pairs: Pairs) -> str:
    """Return why an affine map from b to a is open; empty if the pairs determine it.

    It is open if in plan all landmarks of map b that have a pair lie on one line.
    """
    if lacks_extent(pairs.p_b, pairs.covariance_b, 0.0, 2):
        n = len(pairs)
        return f"the {n} pairs lie on one line of map b in plan, as far as noise can tell"
    return ""


@dataclass(frozen=True)
class Needs:
    """What a method asks of the pairs; with less it is not called.

    Attributes:
        pairs: how many at least.
        dimensions: 1 when they must not lie on one point of either map, 2 when those of map b must
            not lie on one line; 0 when the method sees to it itself.
    """

    pairs: int = 2
    dimensions: int = 0

    def why_without_extent(self, pairs: Pairs) -> str:
        """Why the pairs span too little; empty when they do not."""
        if self.dimensions == 0:
            return ""
        return (
            why_angle_is_open(pairs, which="")
            if self.dimensions == 1
            else why_affine_map_is_open(pairs)
        )


@dataclass(frozen=True)
class Fit:
    """A motion that a method found, and the residuals that made it.

    Attributes:
        T_a_b: (3,) finite.
        inlier: (N,) bool, which of the pairs given support it.
        weight: (n,) of the fitted pairs in the least squares; all equal by default.
        gain: how much each fitted pair's residual moved the motion (n, 3, 2), where that is not the
            least squares of `weight`.
        fitted: the n pairs whose residuals made it; the inliers by default.
        gate_m: radius beyond which residuals were not fitted.
        refusal: why the motion is not to be trusted, if so.
    """

    T_a_b: Float
    inlier: np.ndarray
    weight: Float | None = None
    gain: Float | None = None
    fitted: Pairs | None = None
    gate_m: float = math.inf
    refusal: str = ""


@dataclass(frozen=True)
class Undetermined:
    """The pairs determine no motion; the reason is one a person can act on."""

    reason: str


class Method(Protocol):
    """An alignment method.

    It may also have `needs`, a `Needs` (with less it is not called), and `height`, a `HeightGate`
    (it is given only the pairs whose heights agree).
    """

    randomised: ClassVar[bool]  # whether another generator can give another answer

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """T_a_b of the pairs, and which of them support it."""
        ...


def supported(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, refusal: str = ""
) -> Fit | Undetermined:
    """A motion that is the least squares, equally weighted, of the pairs marked (N,) bool.

    Fewer than two are a refusal; all in one place, they leave the angle open.
    """
    n = int(np.count_nonzero(inlier))
    if n < 2:
        return Fit(T_a_b, inlier, refusal=refusal or f"{n} correspondences support the motion")
    support = pairs[inlier]
    reason = why_angle_is_open(support)
    return Undetermined(reason) if reason else Fit(T_a_b, inlier, fitted=support, refusal=refusal)
