"""Consistency checks of a robot log: odometry, observations and truth are compared.

- Odometry or truth that contradicts the observed motion in most of a log (`disagreement`) gives a
  finding with the likely cause.
- Such odometry may be sound, and noisier than stated (`estimate_odometry_noise`): it agrees with
  the observed motion on average.
- Small systematic errors in the direction of the odometry (`find_direction_error`) are corrected.
- Single increments of the odometry that contradict the observations are jumps (`find_jumps`). The
  rest of such a log is sound: `without_jumps` replaces these increments by the observed motion.
- `outside_gate` counts the observations outside the gate of the landmark that they are known to
  show, by label or track.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.datasets.motion_agreement import (
    FALSE_ALARM,
    MIN_AGREEMENT,
    MIN_SIGMAS,
    ORDER_OF_QUATERNIONS,
    UPRIGHT,
    ReportedMotions,
    compare,
    likely_cause,
    odometry_mistakes,
    pose_mistakes,
)
from mapfusion.datasets.odometry_direction import DirectionError, find_direction_error
from mapfusion.datasets.relative_motion import (
    MIN_MOTIONS,
    PLANAR,
    Motions,
    links_needed,
    motions_of_poses,
    observed_spans,
    odometry_over_spans,
    tracked_by_position,
)
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import wrap
from mapfusion.robot_log import NO_TRACK, RobotLog

# A jump is a difference that is larger than chance explains and larger than any ordinary step.
# The bound on chance is a Bonferroni bound over the frames of a log whose noise is estimated by its
# own median. Wheels that spin or lock cause an error of one step at most. The floor allows for
# robots that are bumped while they stand still.
_JUMP_FALSE_ALARM = 1e-3  # probability of a jump in a log without jumps
_JUMP_STEPS = 2.0
_JUMP_FLOOR = np.array([0.2, 0.2])  # m, rad
_MIN_JUMP_LINKS = 3  # links that agree with the motion at a jump; at least half of all links
_ROUNDING = np.array([1e-3, 1e-3, 1e-3])  # m, rad: resolution of stored odometry
_ORDINARY = 0.9  # quantile of the step sizes of a log that are ordinary
# The odometry as a whole is wrong if more than this share of the observed frames are jumps.
_MAX_JUMP_SHARE = 0.1
# Share of expected observations outside the gate of their landmark, above which a map does not
# describe its log: the majority of observations contradicts the map.
_MAX_OUTSIDE = 0.5
_MEASURED = [0, 2]  # of x, y and the rotation: what wheels measure
# Probability of a larger noise for a log whose odometry is as noisy as stated.
_NOISE_FALSE_ALARM = 0.01
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


class Finding(NamedTuple):
    """Contradiction within a log.

    Attributes:
        kind: "odometry", "truth", "direction", "jump", "noise", "association" or "gate".
        frame: frame of a jump, else -1.
        text: one line without the robot's name.
    """

    kind: str
    frame: int
    text: str


@dataclass(frozen=True)
class Jump:
    """One increment of the odometry that contradicts the observations.

    Attributes:
        frame: frame of the increment.
        observed: observed motion since the frame before, shape (3,).
        covariance: error covariance of the observed motion, shape (3, 3).
        odometry: recorded increment, shape (3,).
    """

    frame: int
    observed: Float
    covariance: Float
    odometry: Float

    @property
    def finding(self) -> Finding:
        """Finding that describes the jump."""
        moved = [float(np.hypot(*motion[:2])) for motion in (self.odometry, self.observed)]
        turned = [float(motion[2]) for motion in (self.odometry, self.observed)]
        apart_m = float(np.hypot(*(self.odometry - self.observed)[:2]))
        text = f"odometry moved {moved[0]:.2f} m, the observations {moved[1]:.2f} m"
        if apart_m < abs(float(wrap(turned[0] - turned[1]))):
            text = f"odometry turned {turned[0]:.2f} rad, the observations {turned[1]:.2f} rad"
        elif abs(moved[0] - moved[1]) < apart_m / 2:  # other directions rather than distances
            by_odometry, seen = (
                f"({x:.2f}, {y:.2f})" for x, y, _ in (self.odometry, self.observed)
            )
            text = f"odometry moved by {by_odometry} m, the observations by {seen} m"
        return Finding(
            "jump", self.frame, f"frame {self.frame}: {text}; this increment is not used"
        )


def disagreement(
    kind: str,
    subject: str,
    spans: Sequence[Motions],
    reported: ReportedMotions,
    mistakes: Mapping[str, Float],
) -> Finding | None:
    """Return the finding about reported motions that contradict observed ones; None if they agree.

    Args:
        kind: kind of the finding.
        subject: beginning of its text.
        spans: observed motions over spans of several lengths.
        reported: motions reported by odometry or truth.
        mistakes: corrected poses by mistake, see `likely_cause`.
    """
    comparisons = [compare(observed, reported, FALSE_ALARM / len(spans)) for observed in spans]
    # Shifts or rotations count if they lie below the limit in at least half of the spans: noise and
    # the resolution of reported motions affect short spans only.
    quantities = []
    for name, limit in MIN_AGREEMENT.items():
        medians = [
            comparison.median
            for comparison in (getattr(c, name) for c in comparisons)
            if comparison.is_defined
        ]
        if 2 * sum(median < limit for median in medians) >= len(medians) > 0:
            quantities.append(name)
    contradicting = [
        k
        for k, comparison in enumerate(comparisons)
        if any(map(comparison.contradicts, quantities))
    ]
    if not contradicting:
        return None
    clearest = max(contradicting, key=lambda k: comparisons[k].n)
    medians_text = [
        f"{name}s {comparison.median:.2f}"
        for name, comparison in comparisons[clearest]._asdict().items()
        if comparison.is_defined
    ]
    cause = likely_cause(spans[clearest], mistakes, reported.noise)
    text = f"{subject} in most frames (agreement of {', '.join(medians_text)}; 1 is full): {cause}"
    return Finding(kind, -1, text)


def _agrees_on_average(observed: Motions, reported: ReportedMotions) -> bool:
    """Return True if noise alone explains the differences between reported and observed motions.

    Noise has the mean zero: the regression u = b m of reported motions u on observed motions m has
    a slope b of 1. Mistakes change it. Shifts or rotations without information on b do not count.
    """
    sigma, slopes = reported.sigma(observed), list[tuple[float, float]]()
    moved = motions_of_poses(reported.poses, observed.start, observed.end)
    for axis, (u, limit) in enumerate(zip(moved, MIN_AGREEMENT.values(), strict=True)):
        m = observed.motion[:, 3 * axis : 3 * axis + 3]
        squares = np.sum(m**2, axis=1)
        # The slope of u = 0 must lie outside the interval around 1.
        if MIN_SIGMAS * np.sqrt(squares @ sigma[:, axis] ** 2) < squares.sum():
            slopes.append((float(np.sum(m * u) / squares.sum()), limit))
    return bool(slopes) and all(limit <= slope <= 1 / limit for slope, limit in slopes)


def truth_finding(reference: str, spans: Sequence[Motions], poses: Float) -> Finding | None:
    """Return the finding about true poses (T, 3) or (T, 4, 4), NaN where unknown.

    Args:
        reference: name of the source of the motions, for the text.
        spans: motions that are compared with the truth, over spans of several lengths.
        poses: the truth.
    """
    is_known = np.isfinite(poses.reshape(len(poses), -1)).all(axis=1)
    if poses.ndim == 3 and is_known.any() and np.median(poses[is_known, 2, 2]) < UPRIGHT:
        text = f"the truth stands on end or on its head in most frames: {ORDER_OF_QUATERNIONS}"
        return Finding("truth", -1, text)
    subject = f"the truth contradicts {reference}"
    return disagreement("truth", subject, spans, ReportedMotions(poses), pose_mistakes(poses))


def find_jumps(log: RobotLog, observed: Motions, noise: MotionNoise) -> list[Jump]:
    """Return single increments of the odometry that contradict the observations, by frame.

    Args:
        log: log whose odometry agrees with its observations as a whole.
        observed: observed motions from frame to frame.
        noise: stated noise of the odometry.
    """
    motion = observed.motion[:, PLANAR]
    covariance = observed.covariance[:, PLANAR][:, :, PLANAR]
    odometry = log.odometry[observed.end]
    if not len(motion):
        return []
    off = motion - odometry
    off[:, 2] = wrap(off[:, 2])
    sigma = np.array([noise.standard_deviations(each) for each in odometry])
    spread = covariance + sigma[:, :, None] ** 2 * np.eye(3) + np.diag(_ROUNDING**2)
    square = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
    # Scale by the median if the noise of the whole log is larger than stated.
    square /= max(float(np.median(square)) / chi_square_bound(0.5, 3), 1.0)
    by_chance = chi_square_bound(1 - _JUMP_FALSE_ALARM / len(square), 3)
    sizes = np.stack([_sizes(motion), _sizes(odometry)])
    ordinary = np.quantile(sizes.min(axis=0), _ORDINARY, axis=0)
    least = np.maximum(_JUMP_STEPS * ordinary, _JUMP_FLOOR)
    enough = np.maximum(_MIN_JUMP_LINKS, observed.n_links / 2)
    # An observed motion as large as a jump indicates false links.
    wrong = (square > by_chance) & (_sizes(off) > least).any(axis=1)
    wrong &= (sizes[0] <= least).all(axis=1)
    rows = np.flatnonzero(wrong & (observed.n_agree >= enough))
    if len(rows) > max(_MAX_JUMP_SHARE * len(square), 1):
        return []
    covariance = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))  # exactly, as files hold it
    return [
        Jump(int(observed.end[n]), motion[n], covariance[n], odometry[n]) for n in rows.tolist()
    ]


def _sizes(motion: Float) -> Float:
    """Return distances and absolute angles (N, 2) of motions (N, 3)."""
    return np.column_stack([np.hypot(motion[:, 0], motion[:, 1]), np.abs(motion[:, 2])])


def without_jumps(
    log: RobotLog, jumps: Sequence[Jump], odometry_covariance: Float | None = None
) -> tuple[RobotLog, Float | None]:
    """Replace each jump by the observed motion.

    Args:
        log: log with the jumps.
        jumps: the jumps.
        odometry_covariance: covariance of visual odometry, shape (T, 3, 3), or None.

    Returns:
        The log and the covariance of its odometry; both as given if there are no jumps. Otherwise
        the covariance at a jump is the covariance of the observed motion. NaN stands for the noise
        of the filter's settings.
    """
    if not jumps:
        return log, odometry_covariance
    odometry = log.odometry.copy()
    covariance = np.full((len(log), 3, 3), np.nan)
    if odometry_covariance is not None:
        covariance[:] = odometry_covariance
    for jump in jumps:
        odometry[jump.frame], covariance[jump.frame] = jump.observed, jump.covariance
    return replace(log, odometry=odometry), covariance


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

    The difference r of an odometry motion and the observed motion over the same span of frames has
    the covariance S + f^2 C, with the covariance S of the observed motion, the stated covariance C
    of the odometry, and the unknown factor f on the odometry's standard deviations. The squared
    distances

        r' (S + f^2 C)^-1 r

    are chi-square distributed. At f = 1 the number of distances above the median is binomial with
    probability 1/2. This sign test decides whether the stated noise is too small. It is not
    affected by outliers, such as jumps and false links.

    The factor is the f at which a quantile of the distances equals that of the chi-square
    distribution. The larger factor by the median and by an upper quantile counts: wheels that slip
    have larger errors in some frames than normal ones, and the noise of the filter is normal.

    The stated noise includes systematic errors (`MotionNoise`), which hardly show over a few
    frames. The sign test therefore uses the covariance C of all the noise, but the factor that of
    the random walks. The systematic errors are assumed to be larger by the same factor.

    Only the distances ahead and the rotations are compared, because wheels do not measure the
    motion across. Only spans count in which the observed motion is more accurate than the odometry,
    so covariances of observations that are too large or too small have little effect. Errors of
    observations and of clocks do not grow with the length of a span. Spans of several lengths are
    therefore compared, and the smallest factor counts.

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
        difference, S, C = _differences(log.odometry, sigma, observed)
        is_accurate = np.all(_diagonal(S) < _diagonal(C), axis=1)
        if np.count_nonzero(is_accurate) < _LEAST_MOTIONS:
            continue
        difference, S, C = difference[is_accurate], S[is_accurate], C[is_accurate]
        if not factors:  # the shortest spans are the most
            # sign test: more squared distances than by chance exceed the median
            median = chi_square_bound(0.5, len(_MEASURED))
            n_larger = int(np.count_nonzero(_squared_distances(difference, S + C) > median))
            by_chance = scipy.special.bdtrc(n_larger - 1, len(difference), 0.5)
            exceeds = n_larger > 0 and float(by_chance) < _NOISE_FALSE_ALARM
            stated = np.median(sigma[observed.end[is_accurate]][:, _MEASURED], axis=0)
        _, _, C_walks = _differences(log.odometry, walks, observed)
        terms = difference, S, C_walks[is_accurate]
        medians.append(_factor(*terms, 0.5))
        factors.append(max(medians[-1], _factor(*terms, _UPPER)))
    if not factors:
        return OdometryNoise(np.nan, False, np.full(2, np.nan), n_observed)
    is_larger = exceeds and min(medians) > _IGNORED_FACTOR
    return OdometryNoise(min(factors), is_larger, stated, n_observed)


def _standard_deviations(odometry: Float, noise: MotionNoise) -> Float:
    return np.array([noise.standard_deviations(each) for each in odometry]).reshape(-1, 3)


def _differences(odometry: Float, sigma: Float, observed: Motions) -> tuple[Float, Float, Float]:
    """Return the differences (N, 2) from observed motions, and both covariances (N, 2, 2)."""
    T, C, _ = odometry_over_spans(odometry, sigma, observed)
    difference = observed.motion[:, PLANAR] - T
    difference[:, 2] = wrap(difference[:, 2])
    S = observed.covariance[:, PLANAR][:, :, PLANAR]
    measured = np.ix_(range(len(S)), _MEASURED, _MEASURED)
    return difference[:, _MEASURED], S[measured], C[measured]


def _diagonal(covariance: Float) -> Float:
    return np.diagonal(covariance, axis1=1, axis2=2)


def _squared_distances(difference: Float, covariance: Float) -> Float:
    return np.sum(difference * np.linalg.solve(covariance, difference[:, :, None])[:, :, 0], axis=1)


def _factor(difference: Float, S: Float, C: Float, probability: float) -> float:
    """Return the factor f at which a quantile of the squared distances is that of chi-square."""
    target = chi_square_bound(probability, len(_MEASURED))

    def excess(factor: float) -> float:
        squares = _squared_distances(difference, S + factor**2 * C)
        return float(np.quantile(squares, probability)) - target

    # Without S the distances are larger, so f is at most this factor.
    largest = float(np.sqrt(np.quantile(_squared_distances(difference, C), probability) / target))
    smallest = _SMALLEST_SHARE * largest
    if not smallest > 0 or excess(smallest) <= 0:
        return 0.0
    return float(scipy.optimize.brentq(excess, smallest, 2 * largest))


class LogConsistency(NamedTuple):
    """Result of the consistency checks of a log.

    Attributes:
        findings: contradictions; empty for a sound log.
        jumps: single increments that are not used.
        noise: noise of the odometry; meaningless if the odometry as a whole is wrong.
        direction: systematic error of the odometry's direction.
        unchecked: reason why the odometry could not be compared; empty if it was.
    """

    findings: tuple[Finding, ...]
    jumps: tuple[Jump, ...]
    noise: OdometryNoise
    direction: DirectionError = DirectionError()
    unchecked: str = ""


def check_log(log: RobotLog, noise: MotionNoise) -> LogConsistency:
    """Compare a log's odometry with the motion that its observations show.

    Observations without labels, tracks and descriptors are tracked by their positions.

    Args:
        log: log with measured odometry. Odometry that was estimated from the observations agrees
            with them by construction.
        noise: stated noise of the odometry.
    """
    seen = log.observations
    named = any(each is not None for each in (seen.label, seen.track, seen.descriptor))
    spans = observed_spans(log if named else tracked_by_position(log))
    mistakes = odometry_mistakes(log.odometry)
    subject = "the odometry contradicts the motion that the observations show"
    finding = disagreement(
        "odometry", subject, spans, ReportedMotions(mistakes[""], noise), mistakes
    )
    estimated_noise = estimate_odometry_noise(log, spans, noise)
    if finding is not None:
        noisier = estimated_noise.is_larger and ReportedMotions(
            mistakes[""], noise.scaled(estimated_noise.factor)
        )
        if not (noisier and _agrees_on_average(spans[0], noisier)):
            return LogConsistency((finding,), (), estimated_noise)
    used_noise = noise.scaled(estimated_noise.factor) if estimated_noise.is_larger else noise
    direction, text = find_direction_error(log.odometry, spans, used_noise)
    findings = list[Finding]()
    if text:
        findings.append(Finding("direction", -1, text))
        log = replace(log, odometry=direction.corrected(log.odometry))
        estimated_noise = estimate_odometry_noise(log, spans, noise)
    jumps, unchecked, needed = tuple(find_jumps(log, spans[0], noise)), "", links_needed(log)
    if estimated_noise.n_observed < MIN_MOTIONS:
        counts = np.bincount(log.iteration, minlength=len(log))
        n_full = int(np.count_nonzero(counts >= needed))
        unchecked = (
            f"the odometry is not checked: {n_full} of {len(log)} frames show {needed} points or "
            f"more, and {estimated_noise.n_observed} share as many with the frame before"
        )
    findings += [jump.finding for jump in jumps]
    return LogConsistency(tuple(findings), jumps, estimated_noise, direction, unchecked)


def outside_gate(log: RobotLog, landmark: np.ndarray) -> tuple[int, int]:
    """Count the reobservations that the filter's gate rejected.

    A reobservation has the label or the track of an earlier observation, so both show the same
    landmark.

    Args:
        log: log that was filtered.
        landmark: first observation of the landmark that each observation was associated with,
            negative for none, shape (N,).

    Returns:
        Number of reobservations that were dropped or started a new landmark, and number of all
        reobservations.
    """
    observations = log.observations
    identity = observations.track if observations.label is None else observations.label
    if identity is None:
        return 0, 0
    order = np.argsort(identity, kind="stable")  # by label or track, then by time
    earlier, later = order[:-1], order[1:]
    reobserved = (identity[earlier] == identity[later]) & (identity[later] != NO_TRACK)
    missed = (landmark[later] < 0) | (landmark[later] == later)
    return int(np.count_nonzero(reobserved & missed)), int(np.count_nonzero(reobserved))


def gate_finding(log: RobotLog, landmark: np.ndarray) -> Finding | None:
    """Return the finding about a map that most observations contradict; None if there is none.

    `landmark` is that of `outside_gate`.
    """
    n_outside, n_expected = outside_gate(log, landmark)
    if n_outside <= _MAX_OUTSIDE * n_expected:
        return None
    share = f"{n_outside} of {n_expected} observations ({n_outside / n_expected:.0%})"
    return Finding("gate", -1, f"{share} fell outside the gate of the landmark that they show")
