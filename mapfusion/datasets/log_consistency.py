"""Consistency checks of a robot log: odometry, observations and truth are compared.

- Odometry or truth that contradicts the observed motion in most of a log (`disagreement`) gives a
  finding with the likely cause.
- Such odometry may be sound, and noisier than stated (`odometry_noise`): it agrees with the
  observed motion on average.
- Single increments of the odometry that contradict the observations are jumps (`find_jumps`). The
  rest of such a log is sound: `without_jumps` replaces these increments by the observed motion.
- `outside_gate` counts the observations outside the gate of the landmark that they are known to
  show, by label or track.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mapfusion.datasets.motion_agreement import (
    FALSE_ALARM,
    MIN_AGREEMENT,
    MIN_SIGMAS,
    ORDER_OF_QUATERNIONS,
    UPRIGHT,
    Stated,
    compare,
    likely_cause,
    odometry_mistakes,
    pose_mistakes,
)
from mapfusion.datasets.odometry_noise import OdometryNoise, estimate_odometry_noise
from mapfusion.datasets.relative_motion import (
    PLANAR,
    Motions,
    motions_of_poses,
    observed_spans,
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


class Finding(NamedTuple):
    """Contradiction within a log.

    Attributes:
        kind: "odometry", "truth", "jump", "noise", "association" or "gate".
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
        text = f"odometry moved {moved[0]:.2f} m, the observations {moved[1]:.2f} m"
        if abs(moved[0] - moved[1]) < abs(float(wrap(turned[0] - turned[1]))):
            text = f"odometry turned {turned[0]:.2f} rad, the observations {turned[1]:.2f} rad"
        return Finding(
            "jump", self.frame, f"frame {self.frame}: {text}; this increment is not used"
        )


def disagreement(
    kind: str, subject: str, spans: Sequence[Motions], stated: Stated, mistakes: Mapping[str, Float]
) -> Finding | None:
    """Return the finding about stated motions that contradict observed ones; None if they agree.

    Args:
        kind: kind of the finding.
        subject: beginning of its text.
        spans: observed motions over spans of several lengths.
        stated: stated motions.
        mistakes: corrected poses by mistake, see `likely_cause`.
    """
    comparisons = [compare(observed, stated, FALSE_ALARM / len(spans)) for observed in spans]
    # Shifts or rotations count if they lie below the limit in at least half of the spans: noise and
    # the resolution of stated motions affect short spans only.
    quantities = []
    for name, limit in MIN_AGREEMENT.items():
        medians = [found.median for found in (getattr(c, name) for c in comparisons) if found.known]
        if 2 * sum(median < limit for median in medians) >= len(medians) > 0:
            quantities.append(name)
    wrong = [k for k, found in enumerate(comparisons) if any(map(found.contradicts, quantities))]
    if not wrong:
        return None
    most = max(wrong, key=lambda k: comparisons[k].n)
    shown = [
        f"{name}s {found.median:.2f}"
        for name, found in comparisons[most]._asdict().items()
        if found.known
    ]
    cause = likely_cause(spans[most], mistakes, stated.noise)
    text = f"{subject} in most frames (agreement of {', '.join(shown)}; 1 is full): {cause}"
    return Finding(kind, -1, text)


def _agrees_on_average(observed: Motions, stated: Stated) -> bool:
    """Return True if noise alone explains the differences between stated and observed motions.

    Noise has the mean zero: the regression u = b m of stated motions u on observed motions m has a
    slope b of 1. Mistakes change it. Shifts or rotations without information on b do not count.
    """
    sigma, slopes = stated.sigma(observed), list[tuple[float, float]]()
    moved = motions_of_poses(stated.poses, observed.start, observed.end)
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
    known = np.isfinite(poses.reshape(len(poses), -1)).all(axis=1)
    if poses.ndim == 3 and known.any() and np.median(poses[known, 2, 2]) < UPRIGHT:
        text = f"the truth stands on end or on its head in most frames: {ORDER_OF_QUATERNIONS}"
        return Finding("truth", -1, text)
    subject = f"the truth contradicts {reference}"
    return disagreement("truth", subject, spans, Stated(poses), pose_mistakes(poses))


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


class LogConsistency(NamedTuple):
    """Result of the consistency checks of a log.

    Attributes:
        findings: contradictions; empty for a sound log.
        jumps: single increments that are not used.
        noise: noise of the odometry; meaningless if the odometry as a whole is wrong.
    """

    findings: tuple[Finding, ...]
    jumps: tuple[Jump, ...]
    noise: OdometryNoise


def check_log(log: RobotLog, noise: MotionNoise) -> LogConsistency:
    """Compare a log's odometry with the motion that its observations show.

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
    finding = disagreement("odometry", subject, spans, Stated(mistakes[""], noise), mistakes)
    found = estimate_odometry_noise(log, spans, noise)
    if finding is not None:
        noisier = found.is_larger and Stated(mistakes[""], noise.scaled(found.factor))
        if not (noisier and _agrees_on_average(spans[0], noisier)):
            return LogConsistency((finding,), (), found)
    jumps = tuple(find_jumps(log, spans[0], noise)) if named else ()
    return LogConsistency(tuple(jump.finding for jump in jumps), jumps, found)


def outside_gate(log: RobotLog, landmark: np.ndarray) -> tuple[int, int]:
    """Count the observations outside the gate of the landmark that they are known to show.

    An observation is known to show the landmark of earlier observations with the same label or
    track.

    Args:
        log: log that was filtered.
        landmark: first observation of the landmark that each observation was associated with,
            negative for none, shape (N,).

    Returns:
        Number of observations that were dropped or started a new landmark in spite of an earlier
        one, and number of observations with an earlier one.
    """
    seen = log.observations
    names = seen.track if seen.label is None else seen.label
    if names is None:
        return 0, 0
    order = np.argsort(names, kind="stable")  # by name, then by time
    before, after = order[:-1], order[1:]
    again = (names[before] == names[after]) & (names[after] != NO_TRACK)
    missed = (landmark[after] < 0) | (landmark[after] == after)
    return int(np.count_nonzero(again & missed)), int(np.count_nonzero(again))


def gate_finding(log: RobotLog, landmark: np.ndarray) -> Finding | None:
    """Return the finding about a map that most observations contradict; None if there is none.

    `landmark` is that of `outside_gate`.
    """
    n_outside, n_expected = outside_gate(log, landmark)
    if n_outside <= _MAX_OUTSIDE * n_expected:
        return None
    share = f"{n_outside} of {n_expected} observations ({n_outside / n_expected:.0%})"
    return Finding("gate", -1, f"{share} fell outside the gate of the landmark that they show")
