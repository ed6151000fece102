"""Robust losses: Student-t weights of observations and of track offsets.

A share of the observations is of corners that are none, or of other landmarks. A Student-t gives
them less weight the farther off they are, and its degrees of freedom, found from the residuals
themselves, say how many there are: of Gaussian residuals they grow without limit and all weights
are one. Lange, Little, Taylor (1989), "Robust statistical modeling using the t distribution".

A gross observation loses its weight and its track keeps the rest. A track that as a whole is of
another landmark has an offset far beyond all others: it no longer pulls at the landmark, and still
holds the poses that saw it together, as it is one point all the same.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import fdtri, gammaln, psi

from mapfusion.geometry.numerics import Float
from mapfusion.smoother.normal_equations import (
    Estimate,
    Shares,
    Weights,
    known_dimensions,
    offset_squares,
    squared_distances,
    squares_of_points,
)
from mapfusion.smoother.problem import Sightings
from mapfusion.smoother.schur_complement import Points

# Tails heavier than the first give (a Cauchy's are at 1) are no sensor's; above the second nobody
# can tell it from a Gaussian.
LEAST_DOF, MOST_DOF = 0.5, 1e4
# Degrees of freedom are found to this share of themselves: far closer than any number of errors
# tells them.
_FOUND_TO = 1e-6
# Beside where they were before they are looked for by secants: the first is of a place this share
# aside, about what they change by from step to step.
_ASIDE, _MOST_SECANTS = 0.01, 6

# Numbers that are multiplied before a logarithm is taken of them.
_MULTIPLIED = 8


def student_weights(squares: Float, dof: float, n_dimensions: Float | int) -> Float:
    """Weights (N,) of errors at these squared Mahalanobis distances (N,), in n dimensions each."""
    return (dof + n_dimensions) / (dof + squares)


def information_share(dof: float, n_dimensions: Float | int) -> Float | float:
    """What of the weighted information is there in truth: (dof + n) / (dof + n + 2).

    The weights' mean is 1, as if their scales were known; but they are told from the same errors,
    and where the cost is flatter than a Gaussian's an estimate is less certain: this is the
    expected information of a multivariate t's location (Lange et al.). Of Gaussian errors it is 1.
    """
    return (dof + n_dimensions) / (dof + n_dimensions + 2)


def student_cost(squares: Float, dof: float, n_dimensions: Float | int) -> float:
    """Twice the negative log likelihood, up to what does not depend on the distances."""
    return float(np.sum((dof + n_dimensions) * np.log1p(squares / dof)))


def student_deviance(squares: Float, dof: float, n_dimensions: Float | int) -> float:
    """Twice the negative log likelihood, up to a constant."""
    n = np.broadcast_to(np.asarray(n_dimensions, dtype=np.float64), len(squares))
    normal = gammaln((dof + n) / 2) - gammaln(dof / 2) - n / 2 * np.log(dof)
    return student_cost(squares, dof, n) - 2 * float(np.sum(normal))


def student_bound(probability: float, dof: float, n_dimensions: int) -> float:
    """The squared Mahalanobis distance that errors stay below with this probability.

    The square over the number of dimensions has an F distribution with (n, dof).
    """
    return n_dimensions * float(fdtri(n_dimensions, dof, probability))


def student_slope(squares: Float, dof: float, n_dimensions: Float | int) -> float:
    """How `student_deviance` changes with the logarithm of the degrees of freedom."""
    n, dims = len(squares), np.asarray(n_dimensions, dtype=np.float64)
    beside = squares * (1 / dof)
    beside += 1
    of_tails = dof * _sum_of_logs(beside)
    np.reciprocal(beside, out=beside)
    of_weights = np.sum((dof + dims) * (1 - beside))
    of_normal = dof * (psi((dof + dims) / 2) - psi(dof / 2)) - dims
    share = 1 if of_normal.ndim else n  # the same for all where all have the same dimensions
    return float(of_tails - of_weights - share * np.sum(of_normal))


def _sum_of_logs(values: Float) -> float:
    """Of values (N,) from 1 to 10^38: logarithms of products, which take less time than those."""
    n = len(values) // _MULTIPLIED * _MULTIPLIED
    products = np.multiply.reduce(values[:n].reshape(_MULTIPLIED, -1), axis=0)
    return float(np.sum(np.log(products)) + np.sum(np.log(values[n:])))


def fitted_dof(squares: Float, n_dimensions: Float | int, near: float = MOST_DOF) -> float:
    """The degrees of freedom under which these squared distances (N,) are most likely.

    Args:
        squares: theirs.
        n_dimensions: one for all, or (N,).
        near: where they are looked for first.
    """

    @functools.cache  # searches look at their ends again
    def slope(log_dof: float) -> float:
        return student_slope(squares, float(np.exp(log_dof)), n_dimensions)

    low, high = float(np.log(LEAST_DOF)), float(np.log(MOST_DOF))
    if near < MOST_DOF:
        found = _root_nearby(slope, float(np.log(near)), low, high)
        if found is not None:
            return float(np.exp(found))
    if slope(high) <= 0:
        return MOST_DOF
    if slope(low) >= 0:
        return LEAST_DOF
    found = root_scalar(slope, bracket=(low, high), method="brentq", xtol=_FOUND_TO)
    return float(np.exp(found.root))


def _root_nearby(
    slope: Callable[[float], float], start: float, low: float, high: float
) -> float | None:
    """Where a slope rises through zero, by secants from `start`; None where they do not lead there.

    A secant's end is off by about the product of how far off the two places were that it is of.
    """
    before, slope_before = start, slope(start)
    at, off_before = before + np.copysign(_ASIDE, -slope_before), 1.0
    for _ in range(_MOST_SECANTS):
        slope_at = slope(at)
        rise = (slope_at - slope_before) / (at - before)
        if not rise > 0:
            return None
        before, slope_before, off = at, slope_at, -slope_at / rise
        at = at + off
        if not (low < at < high and abs(off) < 1):
            return None
        if abs(off * off_before) < _FOUND_TO:
            return float(at)
        off_before = off
    return None


class Tails(NamedTuple):
    """Degrees of freedom of the Student-t's of observations and offsets."""

    observation: float
    offset: float


NO_TAILS = Tails(MOST_DOF, MOST_DOF)


def informative(tails: Tails, n_dimensions: int) -> Shares:
    """What of the weighted information is there in truth."""
    return Shares(*(float(information_share(dof, n_dimensions)) for dof in tails))


def unweighted(seen: Sightings) -> Weights:
    """All ones; tracks that do not stray have no offsets that anything could be known about."""
    return Weights(np.ones(len(seen)), seen.strays.astype(np.float64))


def reweighted(
    seen: Sightings,
    at: Estimate,
    weights: Weights,
    tails: Tails,
    known: Points,
    stray_information: float,
) -> tuple[Weights, Tails]:
    """New weights and tails, given those so far and what is known of points under them.

    Of observations the squares are those expected about the true points (the E step of Lange et
    al.). Offsets have a Student-t in as many dimensions as they are known in, else those of
    landmarks with a single track, which look perfectly average, would hide the tails of the rest.
    """
    n, new = seen.n_dimensions, unweighted(seen)
    squares = squared_distances(seen, at)
    squares += squares_of_points(seen, at.path, known.track_m2)
    of_offset = offset_squares(seen, at, stray_information)
    dimensions = known_dimensions(seen, known.offset_m2, weights.offset * stray_information)
    tails = Tails(
        fitted_dof(squares, n, tails.observation),
        fitted_dof(of_offset, dimensions, tails.offset),
    )
    new.observation[:] = student_weights(squares, tails.observation, n)
    new.offset[seen.strays] = student_weights(of_offset, tails.offset, dimensions)
    return new, tails
