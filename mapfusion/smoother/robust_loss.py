"""Robust losses: Student-t weights of observations and of track offsets.

Some observations are of false corners or of other landmarks. A Student-t distribution gives large
residuals less weight. Its degrees of freedom are estimated from the residuals. For Gaussian
residuals they are very large and all weights are one. Lange, Little, Taylor (1989), "Robust
statistical modeling using the t distribution".

A gross observation loses its weight; the other observations of its track keep theirs. A track of
another landmark has a very large offset. It then has no weight for the landmark, but it still
constrains the poses that observed it.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.geometry.numerics import Float
from mapfusion.smoother.normal_equations import (
    Estimate,
    InformationShares,
    Weights,
    determined_dimensions,
    expected_point_squares,
    offset_squares,
    squared_distances,
)
from mapfusion.smoother.problem import OrderedObservations
from mapfusion.smoother.schur_complement import PointCovariances

# Limits of the degrees of freedom. A Cauchy distribution has 1; no sensor has heavier tails than
# the lower limit. Above the upper limit the distribution is Gaussian for all purposes.
LEAST_DOF, MOST_DOF = 0.5, 1e4
# Relative tolerance of the degrees of freedom, far below their statistical error.
_FOUND_TO = 1e-6
# The secant method starts at the earlier value and at one that differs by this share, the typical
# change between two steps.
_ASIDE, _MOST_SECANTS = 0.01, 6

# Number of values that are multiplied before the logarithm.
_MULTIPLIED = 8


def student_weights(squares: Float, dof: float, n_dimensions: Float | int) -> Float:
    """Return the weights of squared Mahalanobis distances (N,) in n dimensions."""
    return (dof + n_dimensions) / (dof + squares)


def information_share(dof: float, n_dimensions: Float | int) -> Float | float:
    """Return the expected share of the weighted information: (dof + n) / (dof + n + 2).

    The mean of the weights is 1, as if their scales were known. They are estimated from the same
    errors, so the estimate is less certain. The share is that of the expected information of the
    location of a multivariate t distribution (Lange et al.). It is 1 for Gaussian errors.
    """
    return (dof + n_dimensions) / (dof + n_dimensions + 2)


def student_cost(squares: Float, dof: float, n_dimensions: Float | int) -> float:
    """Return twice the negative log likelihood without terms that depend only on `dof`."""
    return float(np.sum((dof + n_dimensions) * np.log1p(squares / dof)))


def student_deviance(squares: Float, dof: float, n_dimensions: Float | int) -> float:
    """Return twice the negative log likelihood up to a constant."""
    n = np.broadcast_to(np.asarray(n_dimensions, dtype=np.float64), len(squares))
    normal = (
        scipy.special.gammaln((dof + n) / 2) - scipy.special.gammaln(dof / 2) - n / 2 * np.log(dof)
    )
    return student_cost(squares, dof, n) - 2 * float(np.sum(normal))


def student_bound(probability: float, dof: float, n_dimensions: int) -> float:
    """Return the quantile of the squared Mahalanobis distance for a probability.

    The square over the number of dimensions has an F distribution with (n, dof).
    """
    return n_dimensions * float(scipy.special.fdtri(n_dimensions, dof, probability))


def student_slope(squares: Float, dof: float, n_dimensions: Float | int) -> float:
    """Return the derivative of `student_deviance` by the logarithm of the degrees of freedom."""
    n, dims = len(squares), np.asarray(n_dimensions, dtype=np.float64)
    beside = squares * (1 / dof)
    beside += 1
    # sum of logarithms by logarithms of products, which is faster; values are from 1 to 10^38
    n_multiplied = n // _MULTIPLIED * _MULTIPLIED
    products = np.multiply.reduce(beside[:n_multiplied].reshape(_MULTIPLIED, -1), axis=0)
    sum_of_logs = float(np.sum(np.log(products)) + np.sum(np.log(beside[n_multiplied:])))
    of_tails = dof * sum_of_logs
    np.reciprocal(beside, out=beside)
    of_weights = np.sum((dof + dims) * (1 - beside))
    of_normal = dof * (scipy.special.psi((dof + dims) / 2) - scipy.special.psi(dof / 2)) - dims
    share = 1 if of_normal.ndim else n  # equal terms if all dimensions are equal
    return float(of_tails - of_weights - share * np.sum(of_normal))


def fit_dof(squares: Float, n_dimensions: Float | int, initial_dof: float = MOST_DOF) -> float:
    """Return the maximum likelihood degrees of freedom of squared distances.

    Args:
        squares: squared Mahalanobis distances, shape (N,).
        n_dimensions: one number, or shape (N,).
        initial_dof: where the search starts.
    """

    @functools.cache  # root finders evaluate the ends again
    def slope(log_dof: float) -> float:
        return student_slope(squares, float(np.exp(log_dof)), n_dimensions)

    low, high = float(np.log(LEAST_DOF)), float(np.log(MOST_DOF))
    if initial_dof < MOST_DOF:
        root = _secant_root(slope, float(np.log(initial_dof)), low, high)
        if root is not None:
            return float(np.exp(root))
    if slope(high) <= 0:
        return MOST_DOF
    if slope(low) >= 0:
        return LEAST_DOF
    root = scipy.optimize.root_scalar(slope, bracket=(low, high), method="brentq", xtol=_FOUND_TO)
    return float(np.exp(root.root))


def _secant_root(
    slope: Callable[[float], float], start: float, low: float, high: float
) -> float | None:
    """Find a root of an increasing slope by the secant method; None if it does not converge.

    The error of a secant step is about the product of the errors of its two points.
    """
    previous, previous_slope = start, slope(start)
    at, off_before = previous + np.copysign(_ASIDE, -previous_slope), 1.0
    for _ in range(_MOST_SECANTS):
        slope_at = slope(at)
        slope_change = (slope_at - previous_slope) / (at - previous)
        if not slope_change > 0:
            return None
        previous, previous_slope, step = at, slope_at, -slope_at / slope_change
        at = at + step
        if not (low < at < high and abs(step) < 1):
            return None
        if abs(step * off_before) < _FOUND_TO:
            return float(at)
        off_before = step
    return None


class Tails(NamedTuple):
    """Degrees of freedom of the Student-t distributions of observations and offsets."""

    observation: float
    offset: float


GAUSSIAN_TAILS = Tails(MOST_DOF, MOST_DOF)


def information_shares(tails: Tails, n_dimensions: int) -> InformationShares:
    """Return the expected shares of the weighted information (`information_share`)."""
    return InformationShares(*(float(information_share(dof, n_dimensions)) for dof in tails))


def unit_weights(obs: OrderedObservations) -> Weights:
    """Return weights of one; tracks without an offset have the offset weight zero."""
    return Weights(np.ones(len(obs)), obs.has_offset.astype(np.float64))


def update_weights(
    obs: OrderedObservations,
    at: Estimate,
    weights: Weights,
    tails: Tails,
    covariances: PointCovariances,
    offset_prior: float,
) -> tuple[Weights, Tails]:
    """Compute new weights and tails from the current estimate.

    The squares of observations are expected values about the true points (the E step of Lange et
    al.). The dimension of each offset's distribution is the number of dimensions that the data
    determine. Otherwise landmarks with a single track, whose offset is always zero, would hide the
    tails of the other tracks.

    Args:
        obs: the observations.
        at: the estimate.
        weights: the current weights.
        tails: the current tails.
        covariances: covariances of the points under the current weights.
        offset_prior: information of an offset along each axis, in 1/m^2.
    """
    n, new = obs.n_dimensions, unit_weights(obs)
    squares = squared_distances(obs, at)
    squares += expected_point_squares(obs, at.path, covariances.track_m2)
    of_offset = offset_squares(obs, at, offset_prior)
    dimensions = determined_dimensions(obs, covariances.offset_m2, weights.offset * offset_prior)
    tails = Tails(
        fit_dof(squares, n, tails.observation),
        fit_dof(of_offset, dimensions, tails.offset),
    )
    new.observation[:] = student_weights(squares, tails.observation, n)
    new.offset[obs.has_offset] = student_weights(of_offset, tails.offset, dimensions)
    return new, tails
