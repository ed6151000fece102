"""Factor by which the odometry of a log is noisier than stated, from the observed motions.

The difference r of an odometry motion and the observed motion over the same span of frames has the
covariance S + f^2 C, with the covariance S of the observed motion, the stated covariance C of the
odometry, and the unknown factor f on the odometry's standard deviations. The squared distances

    r' (S + f^2 C)^-1 r

are chi-square distributed. At f = 1 the number of distances above the median is binomial with
probability 1/2. This sign test decides whether the stated noise is too small. It is not affected
by outliers, such as jumps and false links.

The factor is the f at which a quantile of the distances equals that of the chi-square distribution.
The larger factor by the median and by an upper quantile counts: wheels that slip have larger errors
in some frames than normal ones, and the noise of the filter is normal.

The stated noise includes systematic errors (`MotionNoise`), which hardly show over a few frames.
The sign test therefore uses the covariance C of all the noise, but the factor that of the random
walks. The systematic errors are assumed to be larger by the same factor.

Only the distances ahead and the rotations are compared, because wheels do not measure the motion
across. Only spans count in which the observed motion is more accurate than the odometry, so
covariances of observations that are too large or too small have little effect. Errors of
observations and of clocks do not grow with the length of a span. Spans of several lengths are
therefore compared, and the smallest factor counts.
"""

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.datasets.relative_motion import PLANAR, Motions
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import compose, rotation, wrap
from mapfusion.robot_log import RobotLog

_MEASURED = [0, 2]  # of x, y and the rotation: what wheels measure
# Probability of a larger noise for a log whose odometry is as noisy as stated.
_FALSE_ALARM = 0.01
# Largest factor that is ignored; the filter is hardly less accurate with the stated noise.
_IGNORED_FACTOR = 1.5
_UPPER = 0.95  # probability; jumps and false links in a twentieth of the frames are ignored
# Least share of the random walks in the stated standard deviations: no factor on a random walk that
# is zero explains a larger noise.
_LEAST_RANDOM = 0.5
# Number of motions that the factor of a span length needs. By either quantile the factor has the
# relative standard error 0.72 / sqrt(n) for normal errors of two coordinates, or 0.11.
_LEAST_MOTIONS = 40
# Smaller factors are zero, as a share of the factor for observations without errors. S may be zero,
# so f must not.
_SMALLEST_SHARE = 1e-3


class NoiseSource(StrEnum):
    """Odometry noise of the filter and the smoother."""

    FROM_LOG = "from_log"  # the larger one of the stated and the estimated noise
    STATED = "stated"


class OdometryNoise(NamedTuple):
    """Noise of a log's odometry, relative to the stated noise.

    Attributes:
        factor: estimated factor on the stated standard deviations; NaN if unknown.
        is_larger: true if the noise is larger than stated.
        stated: medians of the stated standard deviations of the increments, in m and rad.
        n_observed: number of frames whose motion since the frame before is observed.
    """

    factor: float
    is_larger: bool
    stated: Float
    n_observed: int

    @property
    def text(self) -> str:
        """One line with the estimated and the stated noise."""
        stated_m, stated_rad = self.stated
        found_m, found_rad = self.factor * self.stated
        return (
            f"odometry is {self.factor:.1f} times as noisy as stated ({found_m:.2g} m and "
            f"{found_rad:.2g} rad a frame; stated: {stated_m:.2g} m and {stated_rad:.2g} rad)"
        )


def estimate_odometry_noise(
    log: RobotLog, spans: Sequence[Motions], noise: MotionNoise
) -> OdometryNoise:
    """Compare the odometry's noise with the stated one.

    Args:
        log: log whose odometry is independent of its observations.
        spans: observed motions over spans of several lengths (`observed_spans`).
        noise: stated noise of the odometry.

    Returns:
        The factor; it is unknown if fewer than `_LEAST_MOTIONS` observed motions of each length
        are more accurate than the odometry.
    """
    sigma = _standard_deviations(log.odometry, noise)
    walks = _standard_deviations(log.odometry, replace(noise, scale_error=0.0, track_error=0.0))
    walks = np.maximum(walks, _LEAST_RANDOM * sigma)
    medians, factors, exceeds, n_observed = list[float](), list[float](), False, len(spans[0].end)
    for observed in spans:
        off, S, C = _differences(log.odometry, sigma, observed)
        is_accurate = np.all(_diagonal(S) < _diagonal(C), axis=1)
        if np.count_nonzero(is_accurate) < _LEAST_MOTIONS:
            continue
        off, S, C = off[is_accurate], S[is_accurate], C[is_accurate]
        if not factors:  # the shortest spans are the most
            # sign test: more squared distances than by chance exceed the median
            median = chi_square_bound(0.5, len(_MEASURED))
            n_larger = int(np.count_nonzero(_squared_distances(off, S + C) > median))
            by_chance = scipy.special.bdtrc(n_larger - 1, len(off), 0.5)
            exceeds = n_larger > 0 and float(by_chance) < _FALSE_ALARM
            stated = np.median(sigma[observed.end[is_accurate]][:, _MEASURED], axis=0)
        _, _, C_walks = _differences(log.odometry, walks, observed)
        given = off, S, C_walks[is_accurate]
        medians.append(_factor(*given, 0.5))
        factors.append(max(medians[-1], _factor(*given, _UPPER)))
    if not factors:
        return OdometryNoise(np.nan, False, np.full(2, np.nan), n_observed)
    is_larger = exceeds and min(medians) > _IGNORED_FACTOR
    return OdometryNoise(min(factors), is_larger, stated, n_observed)


def _standard_deviations(odometry: Float, noise: MotionNoise) -> Float:
    return np.array([noise.standard_deviations(each) for each in odometry]).reshape(-1, 3)


def _differences(odometry: Float, sigma: Float, observed: Motions) -> tuple[Float, Float, Float]:
    """Return the differences (N, 2) from observed motions, and the covariances S and C (N, 2, 2).

    The covariance of an odometry motion is propagated to first order from frame to frame.
    """
    n = len(observed.start)
    T, C = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for k in range(1, int(np.max(observed.end - observed.start, initial=0)) + 1):
        frame = observed.start + k
        R = np.tile(np.eye(3), (n, 1, 1))
        R[:, :2, :2] = rotation(T[:, 2])
        moved = compose(T, odometry[frame])
        by_heading = np.tile(np.eye(3), (n, 1, 1))
        by_heading[:, 0, 2], by_heading[:, 1, 2] = T[:, 1] - moved[:, 1], moved[:, 0] - T[:, 0]
        C = by_heading @ C @ np.swapaxes(by_heading, 1, 2)
        C += (R * sigma[frame, None] ** 2) @ np.swapaxes(R, 1, 2)
        T = moved
    off = observed.motion[:, PLANAR] - T
    off[:, 2] = wrap(off[:, 2])
    S = observed.covariance[:, PLANAR][:, :, PLANAR]
    measured = np.ix_(range(n), _MEASURED, _MEASURED)
    return off[:, _MEASURED], S[measured], C[measured]


def _diagonal(covariance: Float) -> Float:
    return np.diagonal(covariance, axis1=1, axis2=2)


def _squared_distances(off: Float, covariance: Float) -> Float:
    return np.sum(off * np.linalg.solve(covariance, off[:, :, None])[:, :, 0], axis=1)


def _factor(off: Float, S: Float, C: Float, probability: float) -> float:
    """Return the factor f at which a quantile of the squared distances is that of chi-square."""
    wanted = chi_square_bound(probability, len(_MEASURED))

    def excess(factor: float) -> float:
        squares = _squared_distances(off, S + factor**2 * C)
        return float(np.quantile(squares, probability)) - wanted

    # Without S the distances are larger, so f is at most this factor.
    largest = float(np.sqrt(np.quantile(_squared_distances(off, C), probability) / wanted))
    smallest = _SMALLEST_SHARE * largest
    if not smallest > 0 or excess(smallest) <= 0:
        return 0.0
    return float(scipy.optimize.brentq(excess, smallest, 2 * largest))
