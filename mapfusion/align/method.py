"""Interface of an alignment method, and the test for degenerate landmarks."""

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from mapfusion.align.alignment import Pairs
from mapfusion.geometry.numerics import Float, chi_square_bound

# probability that points without extent seem to have one because of noise
SHAPE_FALSE_ALARM = 1e-3


def lacks_extent(p: Float, covariance_m2: Float, drift_m2: float, dimensions: int) -> bool:
    """Return True if points may lie on one point of the plane (dimensions 1) or on one line (2).

    The squared deviations along the weakest of the strongest `dimensions` principal axes, each over
    its own variance, are compared with their chi-square distribution under noise alone (Cochran
    1954, Q statistic). An uncertain landmark therefore counts little and does not hide the extent
    of the others.

    Args:
        p: positions, shape (N, 2 or more), N at least 1.
        covariance_m2: covariances, shape (N, 2 or more, 2 or more).
        drift_m2: s_drift^2, added to each covariance.
        dimensions: 1 or 2.
    """
    in_plan = np.ascontiguousarray(p.T[:2])
    off = in_plan - in_plan[:, :1]  # avoids cancellation far from the origin
    # rounding error, as in numpy.linalg.matrix_rank
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

    The angle is open if all pairs lie on one point of either map. `which` describes the pairs in
    the text.
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


@dataclass(frozen=True)
class Needs:
    """Requirements of a method on the pairs; a method is not called without them.

    Attributes:
        pairs: smallest number of pairs.
        dimensions: 1 if the pairs must not lie on one point of either map, 2 if the landmarks of
            map b must not lie on one line, 0 if the method tests the extent itself.
    """

    pairs: int = 2
    dimensions: int = 0

    def why_without_extent(self, pairs: Pairs) -> str:
        """Return why the extent of the pairs is too small; empty if it is large enough."""
        if self.dimensions == 0:
            return ""
        if self.dimensions == 1:
            return why_angle_is_open(pairs, which="")
        if lacks_extent(pairs.p_b, pairs.covariance_b, 0.0, 2):
            n = len(pairs)
            return f"the {n} pairs lie on one line of map b in plan, as far as noise can tell"
        return ""


@dataclass(frozen=True)
class Fit:
    """Motion that a method found, with the pairs that it was fitted to.

    Attributes:
        T_a_b: motion, shape (3,), finite.
        inlier: given pairs that support the motion, bool, shape (N,).
        weight: weights of the fitted pairs in the least squares, shape (n,); equal by default.
        gain: derivative of the motion by each fitted residual, shape (n, 3, 2); by default that of
            the least squares with `weight`.
        fitted: the n fitted pairs; the inliers by default.
        gate_m: largest residual of a fitted pair.
        refusal: why the motion must not be used; empty if it may.
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
    """Result of a method if the pairs determine no motion, with the reason for a user."""

    reason: str


class Method(Protocol):
    """Alignment method.

    Optional attributes: `needs`, a `Needs`; `height`, a `HeightGate`, restricts the pairs that the
    method receives to those with compatible heights.

    Attributes:
        randomised: True if the result depends on the generator.
    """

    randomised: ClassVar[bool]

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Estimate T_a_b and mark the pairs that support it."""
        ...


def supported(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, refusal: str = ""
) -> Fit | Undetermined:
    """Return the fit of a motion that is the unweighted least squares of the pairs marked (N,).

    A motion with fewer than two pairs is refused. The angle is undetermined if all lie on one
    point.
    """
    n = int(np.count_nonzero(inlier))
    if n < 2:
        return Fit(T_a_b, inlier, refusal=refusal or f"{n} correspondences support the motion")
    support = pairs[inlier]
    reason = why_angle_is_open(support)
    return Undetermined(reason) if reason else Fit(T_a_b, inlier, fitted=support, refusal=refusal)
