"""Agreement of reported motions with observed ones, and the likely cause of a disagreement.

The agreement of a reported motion u with an observed motion m is, for shifts and rotations alike,

    a = m . u / max(|m|^2, |u|^2).

The agreement is 1 for equal motions, 1 / s if one motion is s times the other, cos(phi) if they
differ by an angle phi, and negative if they are opposed. Its median over a log is robust to single
jumps and outliers. Motions contradict each other if the upper end of a confidence interval of the
median lies below a limit. Sound logs are therefore accepted however noisy or short they are.

The cause of a disagreement is searched among common mistakes: other units, other axes, poses in
place of increments, a heading of the other sign, another order of the quaternion, another run.
"""

import itertools
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from mapfusion.datasets.relative_motion import (
    MIN_MOTIONS,
    PLANAR,
    Motions,
    motions_of_poses,
    poses_from_increments,
)
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, inverse, rotation

# Probability of a finding for a log whose agreement lies at the limit. The agreement of sound logs
# is far above the limit.
FALSE_ALARM = 0.01
# Agreement below which motions contradict each other. Wheels that wear, slip or are badly
# calibrated change a distance by a third at most; the limit is a factor of 1.43 or an angle of 45
# degrees. Rotations of skid-steered robots are less accurate than distances: a factor of 2.
MIN_AGREEMENT = {"shift": 0.7, "turn": 0.5}
# A motion counts if its observed or reported length exceeds this many standard deviations; the
# direction of a shorter motion is dominated by noise.
MIN_SIGMAS = 3.0
# Agreement after a mistake is corrected that is nearly as good as that of a sound log.
_EXPLAINED = 0.8
_MAX_FRAMES_LATE = 300  # tried offsets of the clocks
_MAX_MISTAKES = 2  # at once; combinations of more mistakes explain any data
_AND = ", and "  # between the mistakes of a cause
_MAX_OFFSETS = 3  # in time that are named if a robot's motion is periodic
_TIE = 0.03  # the simpler of two causes is named unless the other one explains more by this
UPRIGHT = 0.5  # smallest cosine of the tilt of a wheeled robot
ORDER_OF_QUATERNIONS = "its quaternions look like w x y z in place of x y z w, or the reverse"
_COMMON_AXES = 6  # of `_axis_conventions`, which are often confused with the robot's axes
_STANDS_STILL = 0.02  # reported distance over observed distance of a robot that stands still
# Units that are often confused: number of units in a metre, and in a radian.
_UNITS_M = {1000.0: "millimetres", 100.0: "centimetres", 1 / 0.3048: "feet"}
_DEGREES = 180 / np.pi
_LEAST_CHORD = 0.05  # chord over arc; shorter chords are dominated by noise
_UNIT_TOLERANCE = 0.15  # relative deviation of a ratio from that of a unit
# Largest factor between a ratio and that of a unit which is suggested, where noise keeps the unit
# from explaining the motions.
_UNIT_FACTOR = 2.0


class Agreement(NamedTuple):
    """Agreement of reported motions with observed ones, for shifts or for rotations.

    Attributes:
        n: number of motions that count.
        median: median agreement, -1 to 1; NaN if no motion counts.
        upper: upper end of the confidence interval of the median; infinite if too few count.
        ratio: median reported length over the observed length; NaN if no motion counts.
    """

    n: int
    median: float
    upper: float
    ratio: float

    @property
    def is_defined(self) -> bool:
        """Return True if enough motions count for a median."""
        return self.n >= MIN_MOTIONS


def agreement(
    observed: Float, reported: Float, sigma_observed: Float, sigma: Float, false_alarm: float
) -> Agreement:
    """Compare reported vectors with observed ones.

    Two one-sided confidence intervals of the median of n values are computed; the result is the
    lower one of their upper ends. The first interval uses the standard error
    sqrt(pi / 2) s / sqrt(n) and the quantile of Student's t with n - 1 degrees of freedom. The
    spread s is estimated by the median absolute deviation; s is at least the spread that the errors
    of the observations cause. The second interval ends at the order statistic of the sign test
    (binomial distribution, probability 0.5); it holds for any distribution and needs a dozen
    values.

    Args:
        observed: observed vectors, shape (N, 3).
        reported: reported vectors, shape (N, 3); NaN where unknown.
        sigma_observed: standard deviations of the observed vectors, shape (N,).
        sigma: standard deviations of the differences, shape (N,).
        false_alarm: probability that the true median lies above the interval.

    Returns:
        Agreement of the vectors longer than MIN_SIGMAS standard deviations.
    """
    from scipy.special import bdtr, stdtrit

    lengths = np.stack([np.linalg.norm(values, axis=1) for values in (observed, reported)])
    significant = np.isfinite(lengths).all(axis=0) & (lengths > MIN_SIGMAS * sigma).any(axis=0)
    n = int(significant.sum())
    if not n:
        return Agreement(0, np.nan, np.inf, np.nan)
    longest = lengths[:, significant].max(axis=0)
    values = np.sum(observed[significant] * reported[significant], axis=1) / longest**2
    median = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - median)))
    spread = max(spread, float(np.median(sigma_observed[significant] / longest)))
    upper = np.inf
    if n >= MIN_MOTIONS:
        # Largest number of values above the median with that probability; zero for few values.
        n_above = int(np.searchsorted(bdtr(np.arange(n), n, 0.5), false_alarm / 2, side="right"))
        quantile = float(stdtrit(n - 1, 1 - (false_alarm / 2 if n_above else false_alarm)))
        upper = median + quantile * np.sqrt(np.pi / 2) * spread / np.sqrt(n)
        if n_above:
            upper = min(upper, float(np.sort(values)[n - n_above]))

    # Ratio of lengths, with observed vectors projected onto reported ones if most directions agree.
    square = np.sum(reported[significant] ** 2, axis=1)
    if not np.median(square) > 0:
        return Agreement(n, median, upper, 0.0)
    moving = square > 0
    products = np.sum(observed[significant] * reported[significant], axis=1)
    projection = float(np.median(products[moving] / square[moving]))
    if projection > 0:
        return Agreement(n, median, upper, 1.0 / projection)
    length_observed, length_reported = (
        float(np.median(values_of_kind)) for values_of_kind in lengths[:, significant]
    )
    ratio = length_reported / length_observed if length_observed > 0 else np.inf
    return Agreement(n, median, upper, ratio)


class Comparison(NamedTuple):
    """Agreement of shifts and rotations."""

    shift: Agreement
    turn: Agreement

    def contradicts(self, name: str) -> bool:
        """Return True if the interval of the shifts or of the rotations lies below the limit."""
        return getattr(self, name).upper < MIN_AGREEMENT[name]

    @property
    def n(self) -> int:
        """Number of shifts and rotations that count."""
        return self.shift.n + self.turn.n

    @property
    def worst(self) -> float:
        """Smaller one of the known medians; -1 if none is known."""
        return min((each.median for each in self if each.is_defined), default=-1.0)


class ReportedMotions(NamedTuple):
    """Motions reported by odometry or truth.

    Attributes:
        poses: shape (T, 3) or (T, 4, 4), NaN where unknown.
        noise: noise of odometry; None for the truth.
    """

    poses: Float
    noise: MotionNoise | None = None

    def sigma(self, observed: Motions) -> Float:
        """Return standard deviations of the differences from observed motions, shape (N, 2).

        The noise is computed from the observed motions because reported ones may be in any unit.
        """
        if self.noise is None:
            return observed.sigma
        sigma_odometry = np.array(
            [self.noise.standard_deviations(m) for m in observed.motion[:, PLANAR]]
        )
        x, y, turn = sigma_odometry.reshape(-1, 3).T ** 2
        # An error of the heading displaces the end of the motion sideways.
        squared_length = np.sum(observed.motion[:, :3] ** 2, axis=1)
        return np.sqrt(np.column_stack([x + y + turn * squared_length, turn]) + observed.sigma**2)


def compare(
    observed: Motions, reported: ReportedMotions, false_alarm: float = FALSE_ALARM
) -> Comparison:
    """Compare observed motions with reported ones.

    Args:
        observed: observed motions.
        reported: motions reported by odometry or truth.
        false_alarm: probability that sound motions contradict each other.

    Returns:
        Agreement of shifts and of rotations.
    """
    motions = motions_of_poses(reported.poses, observed.start, observed.end)
    return _compare_vectors(observed, *motions, reported.sigma(observed), false_alarm)


def _compare_vectors(
    observed: Motions, shift: Float, turn: Float, sigma: Float, false_alarm: float = FALSE_ALARM
) -> Comparison:
    """Compare observed motions with reported shifts (N, 3) and rotation vectors (N, 3)."""
    false_alarm_each = false_alarm / len(MIN_AGREEMENT)
    sigma_observed = observed.sigma
    return Comparison(
        agreement(
            observed.motion[:, :3], shift, sigma_observed[:, 0], sigma[:, 0], false_alarm_each
        ),
        agreement(
            observed.motion[:, 3:], turn, sigma_observed[:, 1], sigma[:, 1], false_alarm_each
        ),
    )


class _Cause(NamedTuple):
    """Mistake that could explain the reported motions.

    Attributes:
        text: name of the mistake.
        comparison: comparison after the mistake is corrected.
        ratio: reported distance over observed distance.
    """

    text: str
    comparison: Comparison
    ratio: float

    @property
    def n_mistakes(self) -> int:
        """Number of mistakes that are combined."""
        return len(self.text.split(_AND)) + (self.ratio != 1)


def likely_cause(
    observed: Motions, mistakes: Mapping[str, Float], noise: MotionNoise | None = None
) -> str:
    """Return the text of the mistake that explains reported motions best.

    Args:
        observed: observed motions.
        mistakes: corrected poses (T, 3) or (T, 4, 4) by the text of the mistake. The first entry
            has no mistake. Each entry is tried with all permutations of axes and in all units.
        noise: noise of odometry; None for the truth.

    Returns:
        Text of the cause; a text that suggests another run if no mistake explains enough.
    """
    poses = mistakes[""]
    sigma = ReportedMotions(poses, noise).sigma(observed)
    best: _Cause | None = None
    # Candidates, the simplest first: common axes, mistakes, other axes, axes and mistakes combined.
    axes = list(_axis_conventions())
    common_axes, other_axes = axes[:_COMMON_AXES], axes[_COMMON_AXES:]
    mistaken = [(text, each) for text, each in mistakes.items() if text]
    candidate_groups = (
        [(text, R, poses) for R, text in common_axes],
        [(text, common_axes[0][0], each) for text, each in mistaken],
        [(text, R, poses) for R, text in other_axes],
        [
            (f"{text}{_AND}{axes_text}", R, each)
            for R, axes_text in axes[1:]
            for text, each in mistaken
        ],
    )
    for candidates in candidate_groups:
        for text, R_robot_reported, corrected in candidates:
            # Correct the axes, then the unit. Rotation vectors are axial vectors: mirrored axes
            # change their sign.
            shift, turn = motions_of_poses(corrected, observed.start, observed.end)
            moved = shift @ R_robot_reported.T
            turned = np.linalg.det(R_robot_reported) * turn @ R_robot_reported.T
            ratio = _compare_vectors(observed, moved, turned, sigma).shift.ratio
            if not ratio > 0 or abs(np.log(ratio)) < np.log1p(_UNIT_TOLERANCE):
                ratio = 1.0
            comparison = _compare_vectors(observed, moved / ratio, turned, sigma)
            cause = _Cause(text, comparison, ratio)
            if best is None or cause.comparison.worst > best.comparison.worst + _TIE:
                best = cause
        if best is not None and best.comparison.worst >= _EXPLAINED:
            break
    explained = best is not None and best.comparison.worst >= _EXPLAINED
    if best is not None and explained and best.n_mistakes <= _MAX_MISTAKES:
        return _AND.join(text for text in (best.text, _unit_text(best.ratio)) if text)

    # No combination of axes, units and mistakes explains the motions.
    if delays := _frames_late(observed, poses):
        each = (f"{abs(n)} frames too {'late' if n > 0 else 'early'}" for n in delays)
        return f"its times look {' or '.join(itertools.islice(each, _MAX_OFFSETS))}"
    uncorrected = compare(observed, ReportedMotions(poses, noise))
    if uncorrected.shift.ratio < _STANDS_STILL:
        stands_still_text = "it says that the robot stands still"
        for per_metre, unit in _UNITS_M.items():
            if 1 / _UNIT_FACTOR < uncorrected.shift.ratio * per_metre < _UNIT_FACTOR:
                return f"{stands_still_text}, or the observed distances are {unit}"
        return stands_still_text
    if uncorrected.shift.median > 0 and uncorrected.turn.median > 0:
        shift, turn = motions_of_poses(poses, observed.start, observed.end)
        scales = uncorrected.shift.ratio, uncorrected.turn.ratio
        scaled = _compare_vectors(observed, shift / scales[0], turn / scales[1], sigma)
        if scaled.worst >= _EXPLAINED:
            text = f"distances are {scales[0]:.3g} and turns {scales[1]:.3g} times those"
            return f"{text} that are observed: are units, focal length and baseline right?"
    return "no common mistake explains it: is it another run's, or the calibration another's?"


def _frames_late(observed: Motions, poses: Float) -> list[int]:
    """Return the possible delays, in frames, of reported poses (T, ...) behind observed motions.

    Periodic motions agree at several delays. The result holds all local maxima of the agreement
    that are about as good as the best, the smallest delay first. It is empty if no delay explains
    the motions.
    """
    max_delay, worst_agreement = min(len(poses) // 2, _MAX_FRAMES_LATE), dict[int, float]()
    for delay in range(-max_delay, max_delay + 1):
        inside = (observed.start + delay >= 0) & (observed.end + delay < len(poses))
        part = Motions(*(values[inside] for values in observed))
        if 2 * len(part.start) < len(observed.start):
            continue
        motions = motions_of_poses(poses, part.start + delay, part.end + delay)
        comparison = _compare_vectors(part, *motions, part.sigma)
        if comparison.shift.is_defined and comparison.turn.is_defined:
            worst_agreement[delay] = comparison.worst
    threshold = max(_EXPLAINED, max(worst_agreement.values(), default=0.0) - _TIE)
    peaks = [
        delay
        for delay, value in worst_agreement.items()
        if value > threshold
        and value >= max(worst_agreement.get(delay + step, -1.0) for step in (-1, 1))
    ]
    return sorted(peaks, key=abs)


def _axis_conventions() -> Iterator[tuple[Float, str]]:
    """Yield R_robot_reported (3, 3) of all axis conventions with their texts, common ones first."""
    text_of_convention: dict[tuple[int, ...], str] = {
        (0, 1, 2, 1, 1, 1): "",
        (0, 1, 2, 1, -1, 1): "the heading has the other sign (clockwise, or y to the right)",
        (2, 0, 1, 1, -1, -1): "the axes are a camera's (z ahead, x right, y down)",
        (1, 0, 2, 1, -1, 1): "the axes are turned: y points ahead (are x and y exchanged?)",
        (0, 1, 2, -1, -1, 1): "x points back",
        (0, 1, 2, 1, -1, -1): "z points down and y right",
    }
    conventions = [
        (*order, *signs)
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    ]
    for key in sorted(
        conventions,
        key=lambda each: list(text_of_convention).index(each) if each in text_of_convention else 99,
    ):
        axes = np.zeros((3, 3))
        for row in range(3):
            axes[row, key[row]] = key[3 + row]
        forward = f"{'-' if key[3] < 0 else ''}{'xyz'[key[0]]}"
        upward = f"{'-' if key[5] < 0 else ''}{'xyz'[key[2]]}"
        yield (
            axes,
            text_of_convention.get(
                key, f"the axes are others: {forward} points ahead, {upward} up"
            ),
        )


def _unit_text(ratio: float) -> str:
    """Return a text for reported distances that are `ratio` times the observed ones; "" for 1."""
    if ratio == 1:
        return ""
    text = f"distances are {ratio:.3g} times those that are observed"
    for per_metre, unit in _UNITS_M.items():
        if abs(np.log(ratio / per_metre)) < np.log1p(_UNIT_TOLERANCE):
            return f"{text}: {unit}?"
        if abs(np.log(ratio * per_metre)) < np.log1p(_UNIT_TOLERANCE):
            return f"{text}: are the observed ones {unit}?"
    return f"{text}: are units, focal length and baseline right?"


def odometry_mistakes(increments: Float) -> dict[str, Float]:
    """Return poses (T, 3) from increments (T, 3), by the mistake that was corrected."""
    differences = np.zeros_like(increments)
    differences[1:] = between(increments[:-1], increments[1:])
    in_radians = increments / [1, 1, _DEGREES]
    # An arc of heading change a has the chord r sinc(a / 2) in the direction a / 2. The chord of a
    # full turn is zero and tells no length.
    arcs, half, true_half = in_radians.copy(), increments[:, 2] / 2, in_radians[:, 2] / 2
    longer = np.sinc(true_half / np.pi) / np.maximum(np.sinc(half / np.pi), _LEAST_CHORD)
    chord = longer[:, None] * increments[:, :2]
    arcs[:, :2] = np.einsum("nij,nj->ni", rotation(true_half - half), chord)
    poses_of = poses_from_increments
    return {
        "": poses_of(increments),
        "its columns look like poses since the start, not increments": poses_of(differences),
        "odometry_theta_rad looks like degrees (factor 57.3)": poses_of(in_radians),
        "its turn rates look like degrees per second (factor 57.3)": poses_of(arcs),
        "its increments look inverted (T_after_before)": poses_of(inverse(increments)),
        "its columns look like poses since the start, with degrees": in_radians,
        "only its heading has the other sign": poses_of(increments * [1, 1, -1]),
    }


def pose_mistakes(poses: Float) -> dict[str, Float]:
    """Return poses (T, 3) or (T, 4, 4), by the mistake that was corrected."""
    if poses.ndim == 2:
        return {
            "": poses,
            "its heading looks like degrees (factor 57.3)": poses / [1, 1, _DEGREES],
            "its poses look inverted (T_robot_world)": inverse(poses),
            "only its heading has the other sign": poses * [1, 1, -1],
            "only its y has the other sign": poses * [1, -1, 1],
        }
    is_known = np.isfinite(poses).all(axis=(1, 2))
    corrected = {"": poses}
    for order in ([1, 2, 3, 0], [3, 0, 1, 2]):
        reordered = np.full_like(poses, np.nan)
        quaternions = se3.quaternions(poses[is_known])[:, order]
        reordered[is_known] = se3.from_quaternions(poses[is_known, :3, 3], quaternions)
        if np.median(reordered[is_known, 2, 2]) > UPRIGHT:
            corrected[ORDER_OF_QUATERNIONS] = reordered
    corrected["its poses look inverted (T_robot_world)"] = se3.inverse(poses)
    return corrected
