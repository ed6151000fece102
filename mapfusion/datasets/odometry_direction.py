"""Systematic errors in the direction of odometry increments.

Two mistakes turn the increments of odometry against the true motion by a small angle:

- Poses that are integrated by Euler's method, x += d cos(theta), with the heading at the start or
  at the end of a step. The chord of an arc of turn a points to a / 2 from the heading at its start
  (Siegwart and Nourbakhsh, Introduction to Autonomous Mobile Robots, section 5.2.4), so these
  increments are turned by a / 2 to either side. If a frame covers several steps, the angle is
  smaller.
- A sensor whose heading in the robot frame differs from the stated one. All increments are turned
  by the same angle.

Such errors are too small to contradict the observations in a single frame, but they accumulate:
a landmark that is seen again lies beside its former position.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mapfusion.datasets.relative_motion import Motions, odometry_over_spans
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import rotation

_FALSE_ALARM = 0.01  # probability of a correction of sound odometry
_MISSED = 0.05  # probability of a true error whose estimate seems to lie outside its range
# Number of motions of a span length that are needed; the median of their squared distances then has
# a relative standard error below one half.
_LEAST_MOTIONS = 10
_GATE = 0.999  # probability of a motion whose squared distance is not an outlier
_MAX_ROUNDS = 5  # of the fit, which leaves other outliers aside and turns the increments further
_CONVERGED_RAD = 1e-4
_LARGEST_SHARE = 0.5  # of the turn: the heading is that at the start or at the end of a step
_LARGEST_RAD = np.pi / 4  # of a sensor's heading; larger angles contradict the observations


class DirectionError(NamedTuple):
    """Angle of the observed motion against the odometry increments, positive to the left.

    An increment with the turn a is off by `turn_share` a + `heading_rad`; one of both is zero.

    Attributes:
        turn_share: share of an increment's turn, -1/2 to 1/2.
        heading_rad: constant angle.
    """

    turn_share: float = 0.0
    heading_rad: float = 0.0

    def corrected(self, odometry: Float) -> Float:
        """Return the increments (T, 3), turned by the error."""
        if self == DirectionError():
            return odometry
        turned = odometry.copy()
        R = rotation(self.angles(odometry))
        turned[:, :2] = np.einsum("nij,nj->ni", R, odometry[:, :2])
        return turned

    def angles(self, odometry: Float) -> Float:
        """Return the error of each increment in rad, shape (T,)."""
        return self.turn_share * odometry[:, 2] + self.heading_rad


class _Fit(NamedTuple):
    """Estimate of one kind of error.

    Attributes:
        value: estimate without regard to its range.
        information: inverse of its variance.
        error: the error, within its range.
        decrease: decrease of the sum of squared distances from no error to `value`. Distances of
            outliers count as much as the gate.
    """

    value: float
    information: float
    error: DirectionError
    decrease: float

    @property
    def gain(self) -> float:
        """Decrease of the sum of squared distances from no error to `error`."""
        return self.decrease - self.excess

    @property
    def excess(self) -> float:
        """Increase of the sum of squared distances from `value` to `error`."""
        return (self.error.turn_share + self.error.heading_rad - self.value) ** 2 * self.information


def find_direction_error(
    odometry: Float, spans: Sequence[Motions], noise: MotionNoise
) -> tuple[DirectionError, str]:
    """Estimate the systematic error of the direction of odometry increments.

    The shift of a span of frames changes with the parameter of the error by its derivative B. With
    the differences r of observed shifts and odometry, and the inverse W of their covariances, the
    weighted least-squares estimate is

        c = sum(B' W r) / sum(B' W B),

    with the variance 1 / sum(B' W B). The covariances are scaled by the median of the squared
    distances where the noise is larger than stated. Of the span lengths, the one with the smallest
    variance counts.

    An error is accepted if likelihood ratio tests reject its absence and do not reject the value
    within its range, and if it moves the robot sideways by more than the odometry's stated noise.

    Args:
        odometry: increments, shape (T, 3).
        spans: observed motions over spans of several lengths (`observed_spans`).
        noise: stated noise of the odometry.

    Returns:
        The error and a line that describes it. No error gives an empty line.
    """
    sigma = np.array([noise.standard_deviations(each) for each in odometry]).reshape(-1, 3)
    distance_m, across_m2 = np.hypot(odometry[1:, 0], odometry[1:, 1]), sigma[1:, 1] ** 2
    by_chance, within = chi_square_bound(1 - _FALSE_ALARM, 1), chi_square_bound(1 - _MISSED, 1)
    accepted = list[_Fit]()
    for unit in (DirectionError(turn_share=1.0), DirectionError(heading_rad=1.0)):
        fits = (
            _fit(odometry, sigma, observed, unit)
            for observed in spans
            if len(observed.end) >= _LEAST_MOTIONS
        )
        fit = max(fits, key=lambda each: each.information, default=_Fit(0.0, 0.0, unit, 0.0))
        sideways_m = distance_m * np.sin(fit.error.angles(odometry)[1:])
        is_larger = np.sum(sideways_m**2) > np.sum(across_m2)
        if fit.gain > by_chance and fit.excess <= within and is_larger:
            accepted.append(fit)
    if not accepted:
        return DirectionError(), ""
    best = max(accepted, key=lambda each: each.gain)
    likely = [each.error for each in accepted if best.gain - each.gain <= by_chance]
    return best.error, _description(best.error, likely, odometry)


def _fit(odometry: Float, sigma: Float, observed: Motions, unit: DirectionError) -> _Fit:
    """Estimate the multiple of `unit` that explains the observed motions best."""
    value, information, is_usual = 0.0, 0.0, np.ones(len(observed.end), dtype=bool)
    angles, without = unit.angles(odometry), np.empty(0)
    for _ in range(_MAX_ROUNDS):
        turned = _multiple(unit, value).corrected(odometry)
        T, C, B = odometry_over_spans(turned, sigma, observed, angles)
        r = observed.motion[:, :2] - T[:, :2]
        W = np.linalg.inv(observed.covariance[:, :2, :2] + C[:, :2, :2])
        information = float(np.einsum("ni,nij,nj->", B[is_usual], W[is_usual], B[is_usual]))
        if not information > 0:
            return _Fit(0.0, 0.0, unit, 0.0)
        if not len(without):
            without = np.einsum("ni,nij,nj->n", r, W, r)
        step = float(np.einsum("ni,nij,nj->", B[is_usual], W[is_usual], r[is_usual])) / information
        value += step
        residual = r - step * B
        squares = np.einsum("ni,nij,nj->n", residual, W, residual)
        scale = max(float(np.median(squares)) / chi_square_bound(0.5, 2), 1.0)
        information /= scale
        gate = scale * chi_square_bound(_GATE, 2)
        was_usual, is_usual = is_usual, squares <= gate
        if abs(step) < _CONVERGED_RAD and np.array_equal(is_usual, was_usual):
            break
    largest = _LARGEST_SHARE if unit.turn_share else _LARGEST_RAD
    in_range = float(np.clip(value, -largest, largest))
    decrease = float(np.sum(np.minimum(without, gate) - np.minimum(squares, gate))) / scale
    return _Fit(value, information, _multiple(unit, in_range), decrease)


def _multiple(unit: DirectionError, value: float) -> DirectionError:
    return DirectionError(value * unit.turn_share, value * unit.heading_rad)


def _description(error: DirectionError, likely: Sequence[DirectionError], odometry: Float) -> str:
    """Return a line that names the size of the error and its likely causes."""
    distance_m = np.hypot(odometry[1:, 0], odometry[1:, 1])
    angles = np.abs(error.angles(odometry)[1:])
    mean_rad = float(distance_m @ angles / distance_m.sum())
    sideways_m = float(np.mean(distance_m * np.sin(angles)))
    causes = []
    for each in likely:
        if each.turn_share:
            end = "start" if each.turn_share > 0 else "end"
            causes.append(f"its poses look integrated with the heading at the {end} of each step")
        else:
            side = "right" if each.heading_rad > 0 else "left"
            degrees = abs(np.degrees(each.heading_rad))
            causes.append(
                f"the sensor seems to point {degrees:.2g} degrees further {side} than stated"
            )
    return (
        f"the odometry's increments point {np.degrees(mean_rad):.2g} degrees beside the motion "
        f"that the observations show ({sideways_m:.2g} m a frame): "
        f"{', or '.join(causes)}; they are turned by this angle"
    )
