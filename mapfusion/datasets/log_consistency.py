"""Consistency of a robot log: odometry, observations and truth compared with each other.

The same points seen from two frames tell how the robot moved between them. That motion is compared
with the motion that the odometry, or the truth, states for the same frames. Three questions are
answered:

- Do the two agree in most of the log (`disagreement`)? If not, the likely cause is looked for among
  the mistakes that people make: other units, other axes, poses in place of increments, a heading of
  the other sign, another order of the quaternion, another run.
- Are there single increments that contradict what is seen (`find_jumps`)? The rest of the log is
  sound then, and `without_jumps` gives a log in which these increments count for nothing.
- Did observations fall outside the gate of the landmark that they were known to show
  (`outside_gate`)?

The agreement of a stated motion u with an observed one m is, for shifts and turns alike,

    a = m . u / max(|m|^2, |u|^2),

1 where they are equal, 1 / s where one is s times the other, cos(phi) where they differ by an angle
phi, and below 0 where they are opposed. Its median over a log does not follow single jumps and
outliers. The upper end of a confidence interval of the median must lie below a limit before
anything is said: sound logs are left alone however noisy or short they are.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import between, inverse, rotation, wrap
from mapfusion.robot_log import NO_TRACK, RobotLog
from mapfusion.tables import NO_LABEL
from mapfusion.vision.visual_odometry import MIN_LINKS, RigidMotion, estimate_rigid_motion

# Probability that anything is said of a log whose agreement lies at the limit; that of sound logs
# lies far above.
_FALSE_ALARM = 0.01
# Agreement below which motions contradict each other. Wheels that wear, slip or are badly
# calibrated are off by a third of a distance at most (a P3-AT's track in simulation: 0.42 to
# 0.62 m, a third of the angle); a factor of 1.43 or an angle of 45 degrees is something else. Turns
# of skid-steered robots are known less well than distances: a factor of 2.
_LEAST_AGREEMENT = {"shift": 0.7, "turn": 0.5}
# A motion counts where it is this many standard deviations of what is observed, or stated, above
# zero: below, its direction is noise.
_SURE = 3.0
_LEAST_MOTIONS = 4  # whose median says anything
# A cause is named if with it put right the agreement is at least this, nearly as good as a sound
# log's.
_EXPLAINED = 0.8
_MOST_FRAMES_LATE = 300  # that are tried where clocks may differ
_MOST_PARTS = 2  # mistakes at once; more of them explain anything
_AND = ", and "  # between the mistakes of a cause
_MOST_SHIFTS = 3  # in time that are named, where a robot's motion repeats
_TIE = 0.03  # of two causes that explain as much, the simpler is named
# Share of true links of consecutive frames that are believed, and descriptors that are alike.
_LINK_PROBABILITY = 0.999
_MOST_UNLIKE = 0.5  # distance of unit vectors, as `FastSlamParameters.descriptor_threshold`
_PLANE = [0, 1, 5]  # x, y and the turn about z, of shifts and turns in space
_TOLERANCES = (1.0, 0.25, 0.06, 0.015, 0.0)  # of a planar fit, in sizes of what is seen
_OPEN_TURN = (
    1e12  # condition of links that all show one place: they leave open how the robot turned
)
_LEAST_PLANAR_LINKS = 2  # that fix a motion of the plane; their distance is checked as well
# A jump is a difference larger than chance makes it (Bonferroni over the frames of a log whose
# noise is as the log's own median says) and larger than any ordinary step: wheels that spin or
# lock are off by one step at most. Frames without a step allow the floor, as a bumped robot moves.
_JUMP_BY_CHANCE = 1e-3  # probability of a jump in a log without
_JUMP_STEPS = 2.0
_JUMP_FLOOR = np.array([0.2, 0.2])  # m, rad
_LEAST_JUMP_LINKS = 3  # that agree on the motion at a jump, and at least half of all
_ROUNDING = np.array([1e-3, 1e-3, 1e-3])  # m, rad: no smaller difference is a jump's
_ORDINARY = 0.9  # quantile of the steps of a log that are ordinary
# With more jumps than this share of the observed frames it is the odometry as a whole that is bad.
_MOST_JUMPS = 0.1
# Share of expected observations outside their landmark's gate, above which a map does not describe
# its log: more of them contradict it than agree with it.
MOST_OUTSIDE = 0.5
_UPRIGHT = 0.5  # cosine of a tilt that no robot on wheels has
ORDER_OF_QUATERNIONS = "its quaternions look like w x y z in place of x y z w, or the reverse"
_USUAL_AXES = 6  # of `_axes`: those that people take for the robot's
_STANDS_STILL = 0.02  # of the observed distance: stated distances that are none
# Factors on stated covariances that are tried, and frames that they are tried on, so that
# observations whose covariances are in another unit still tell how the robot moved.
_LEVELS, _TRIED_FRAMES = (1.0, 1e2, 1e4, 1e6), 40
# Units that are taken for others: how many of them make a metre, and a radian.
_UNITS_M = {1000.0: "millimetres", 100.0: "centimetres", 1 / 0.3048: "feet"}
_DEGREES = 180 / np.pi
_LIKE_A_UNIT = 0.15  # relative


class Motions(NamedTuple):
    """Motions from frame `start` to frame `end` of a log, in the robot frame at the start.

    Attributes:
        start: (N,) frames.
        end: (N,) frames.
        motion: (N, 6) shifts in m and rotation vectors in rad.
        covariance: (N, 6, 6) of their errors; of planar data zero but for x, y
            and the turn about z.
        n_links: (N,) points that both frames show.
        n_agree: (N,) how many of them agree with the motion.
    """

    start: np.ndarray
    end: np.ndarray
    motion: Float
    covariance: Float
    n_links: np.ndarray
    n_agree: np.ndarray

    @property
    def sigma(self) -> Float:
        """(N, 2) standard deviations of the shifts (m) and the turns (rad), root of the trace."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
        return np.sqrt(variance.sum(axis=2))


class Finding(NamedTuple):
    """Something that a log says against itself.

    Attributes:
        kind: "odometry", "truth", "jump" or "gate".
        frame: of a jump, else -1.
        text: one line without the robot's name.
    """

    kind: str
    frame: int
    text: str


@dataclass(frozen=True)
class Jump:
    """One increment of the odometry that contradicts the observations.

    Attributes:
        frame: at whose odometry.
        observed: (3,) motion since the frame before by the observations.
        covariance: (3, 3) of its error.
        odometry: (3,) as recorded.
    """

    frame: int
    observed: Float
    covariance: Float
    odometry: Float

    @property
    def finding(self) -> Finding:
        """The same in one line."""
        moved = [float(np.hypot(*motion[:2])) for motion in (self.odometry, self.observed)]
        turned = [float(motion[2]) for motion in (self.odometry, self.observed)]
        told = f"odometry moved {moved[0]:.2f} m, the observations {moved[1]:.2f} m"
        if abs(moved[0] - moved[1]) < abs(float(wrap(turned[0] - turned[1]))):
            told = f"odometry turned {turned[0]:.2f} rad, the observations {turned[1]:.2f} rad"
        return Finding(
            "jump", self.frame, f"frame {self.frame}: {told}; this increment is not used"
        )


def links(
    log: RobotLog, starts: np.ndarray, first: int, second: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the log's observations (n,), (n,) that show the same points in two frames.

    By labels where there are any, else by tracks, else by descriptors that are each other's
    nearest. `starts` are the log's `frame_starts`.
    """
    seen = log.observations
    a, b = (np.arange(starts[k], starts[k + 1]) for k in (first, second))
    for names, none in ((seen.label, NO_LABEL), (seen.track, NO_TRACK)):
        if names is not None:
            a, b = a[names[a] != none], b[names[b] != none]
            _, own, other = np.intersect1d(names[a], names[b], return_indices=True)
            return a[own], b[other]
    if seen.descriptor is None or not len(a) or not len(b):
        return a[:0], b[:0]
    likeness = seen.descriptor[a] @ seen.descriptor[b].T
    other, back = likeness.argmax(axis=1), likeness.argmax(axis=0)
    alike = likeness.max(axis=1) > 1 - _MOST_UNLIKE**2 / 2
    mutual = alike & (back[other] == np.arange(len(a)))
    return a[mutual], b[other[mutual]]


class _Observed(NamedTuple):
    """One motion T_first_second (4, 4) by what both frames show; the rest as of `Motions`."""

    T: Float
    covariance: Float
    n_links: int
    n_agree: int


def _closed_form(p_before: Float, p_after: Float, weight: Float) -> Float:
    """Motion (3,) of the plane with the least weighted squares (Umeyama 1991)."""
    share = weight / weight.sum()
    middle_before, middle_after = share @ p_before, share @ p_after
    a, b = p_before - middle_before, p_after - middle_after
    sine = share @ (b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0])
    theta = float(np.arctan2(sine, share @ np.sum(a * b, axis=1)))
    return np.array([*(middle_before - rotation(theta) @ middle_after), theta])


def _planar_motion(
    p_before: Float, S_before: Float, p_after: Float, S_after: Float
) -> _Observed | None:
    """Motion of the plane by n links; None where fewer than two agree, or leave the turn open.

    As `estimate_rigid_motion` does: least squares over the links inside the gate, while a
    tolerance that is added to all covariances falls to nothing.
    """
    n = len(p_before)
    size = float(np.sqrt(np.mean(np.var(p_after, axis=0)))) or 1.0
    weight, agree, gate = np.ones(n), np.ones(n, dtype=bool), chi_square_bound(_LINK_PROBABILITY, 2)
    for tolerance in _TOLERANCES:
        motion = _closed_form(p_before[agree], p_after[agree], weight[agree])
        R = rotation(motion[2])
        residual = p_before - p_after @ R.T - motion[:2]
        spread = S_before + R @ S_after @ R.T + (tolerance * size) ** 2 * np.eye(2)
        information = np.linalg.inv(spread)
        square = np.einsum("ni,nij,nj->n", residual, information, residual)
        agree, weight = square <= gate, 1.0 / np.trace(spread, axis1=1, axis2=2)
        if np.count_nonzero(agree) < _LEAST_PLANAR_LINKS:
            return None
    lever = p_after[agree] @ R.T
    J = np.zeros((len(lever), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -lever[:, 1], lever[:, 0]
    # of the weighted closed form, as of any least squares: G S G'
    normal = np.einsum("nia,n,nib->ab", J, weight[agree], J)
    if np.linalg.cond(normal) > _OPEN_TURN:
        return None
    gain = np.einsum("ab,nib,n->nai", np.linalg.inv(normal), J, weight[agree])
    covariance = np.zeros((6, 6))
    covariance[np.ix_(_PLANE, _PLANE)] = np.einsum("nai,nij,nbj->ab", gain, spread[agree], gain)
    return _Observed(se3.from_planar(motion), covariance, n, int(np.count_nonzero(agree)))


def _observed_motion(
    log: RobotLog, starts: np.ndarray, first: int, second: int, level: float
) -> _Observed | None:
    """Motion between two frames; None where the links tell none.

    Stated covariances are multiplied by `level`.
    """
    a, b = links(log, starts, first, second)
    seen = log.observations
    p, S = seen.position_m, level * seen.covariance_m2
    if log.planar and len(a) >= _LEAST_PLANAR_LINKS:
        return _planar_motion(p[a, :2], S[a, :2, :2], p[b, :2], S[b, :2, :2])
    if log.planar or len(a) < MIN_LINKS:
        return None
    _, found = estimate_rigid_motion(p[a], S[a], p[b], S[b], _LINK_PROBABILITY)
    if found is None:
        return None
    return _Observed(found.T_before_after, found.covariance, len(a), found.n_links)


def _vectors(T: Float) -> Float:
    """Shifts and rotation vectors (N, 6) of motions (N, 4, 4), NaN where unknown."""
    from scipy.spatial.transform import Rotation  # takes a quarter of a second to import

    made = np.full((len(T), 6), np.nan)
    known = np.isfinite(T).all(axis=(1, 2))
    made[known, :3] = T[known, :3, 3]
    if known.any():
        made[known, 3:] = Rotation.from_matrix(T[known, :3, :3]).as_rotvec()
    return made


def observed_motions(log: RobotLog, lag: int = 1, level: float = 1.0) -> Motions:
    """Motions over every `lag` frames by what both ends show, where they show enough.

    Stated covariances are multiplied by `level`.
    """
    starts, frames, found = log.frame_starts(), [], list[_Observed]()
    for end in range(lag, len(log), lag):
        seen = _observed_motion(log, starts, end - lag, end, level)
        if seen is not None:
            frames.append((end - lag, end))
            found.append(seen)
    start, end = np.array(frames, dtype=np.int64).reshape(-1, 2).T
    T = np.array([seen.T for seen in found]).reshape(-1, 4, 4)
    covariance = np.array([seen.covariance for seen in found]).reshape(-1, 6, 6)
    counts = np.array([(seen.n_links, seen.n_agree) for seen in found], dtype=np.int64)
    return Motions(start, end, _vectors(T), covariance, *counts.reshape(-1, 2).T)


def motions_between_frames(each: Sequence[tuple[int, RigidMotion]]) -> Motions:
    """Motions from frame to frame that were found already, by the frame that each ends at."""
    end = np.array([k for k, _ in each], dtype=np.int64)
    T = np.array([motion.T_before_after for _, motion in each]).reshape(-1, 4, 4)
    covariance = np.array([motion.covariance for _, motion in each]).reshape(-1, 6, 6)
    n_links = np.array([motion.n_links for _, motion in each], dtype=np.int64)
    return Motions(end - 1, end, _vectors(T), covariance, n_links, n_links)


def spanned(each: Motions, lag: int) -> Motions:
    """Motions over every `lag` frames, composed of those from frame to frame without a gap."""
    T_step = se3.pose(np.eye(3), np.zeros((int(each.end.max(initial=0)) + 1, 3)))
    covariance = np.full((len(T_step), 6, 6), np.nan)
    T_step[each.end], covariance[each.end] = _matrices(each.motion), each.covariance
    ends = np.arange(lag, len(T_step), lag)
    T = np.tile(np.eye(4), (len(ends), 1, 1))
    total = np.zeros((len(ends), 6, 6))
    for k in range(lag):
        T = T @ T_step[ends - lag + 1 + k]
        total += covariance[ends - lag + 1 + k]
    known = np.isfinite(total).all(axis=(1, 2))
    none = np.zeros(int(known.sum()), dtype=np.int64)
    return Motions(ends[known] - lag, ends[known], _vectors(T[known]), total[known], none, none)


def _matrices(motion: Float) -> Float:
    """Motions (N, 4, 4) of shifts and rotation vectors (N, 6)."""
    from scipy.spatial.transform import Rotation

    if not len(motion):
        return np.empty((0, 4, 4))
    return se3.pose(Rotation.from_rotvec(motion[:, 3:]).as_matrix(), motion[:, :3])


def odometry_motions(log: RobotLog, noise: MotionNoise) -> Motions:
    """Motions from frame to frame as the odometry has them, with their stated noise."""
    n = len(log) - 1
    motion, covariance = np.zeros((n, 6)), np.zeros((n, 6, 6))
    motion[:, _PLANE] = log.odometry[1:]
    sigma = np.array([noise.standard_deviations(each) for each in log.odometry[1:]]).reshape(-1, 3)
    covariance[:, _PLANE, _PLANE] = sigma**2
    end, none = np.arange(1, n + 1), np.zeros(n, dtype=np.int64)
    return Motions(end - 1, end, motion, covariance, none, none)


def chained(increments: Float) -> Float:
    """Poses (T, 3) since the start of increments (T, 3), the first of which is no motion."""
    heading = np.cumsum(increments[:, 2]) - increments[0, 2]
    before = np.concatenate([[0.0], heading[:-1]])
    step = np.einsum("nij,nj->ni", rotation(before), increments[:, :2])
    return np.column_stack([np.cumsum(step, axis=0) - step[0], wrap(heading)])


def stated_motions(poses: Float, start: np.ndarray, end: np.ndarray) -> tuple[Float, Float]:
    """Shifts (N, 3) and rotation vectors (N, 3) between poses (T, 3) or (T, 4, 4)."""
    if poses.ndim == 3:
        made = _vectors(se3.between(poses[start], poses[end]))
        return made[:, :3], made[:, 3:]
    moved = between(poses[start], poses[end])
    shift, turn = np.zeros((len(moved), 3)), np.zeros((len(moved), 3))
    shift[:, :2], turn[:, 2] = moved[:, :2], moved[:, 2]
    return shift, turn


class Agreement(NamedTuple):
    """Agreement of stated motions with observed ones, for shifts or for turns.

    Attributes:
        n: motions that are sure enough to count.
        median: of their agreement, -1 to 1; NaN where none counts.
        upper: end of the confidence interval of the median; infinite where too few count.
        ratio: median of the stated length over the observed one; NaN where none counts.
    """

    n: int
    median: float
    upper: float
    ratio: float

    @property
    def known(self) -> bool:
        """Return True if enough motions count for a median."""
        return self.n >= _LEAST_MOTIONS


def agreement(
    observed: Float, stated: Float, sigma_observed: Float, sigma: Float, false_alarm: float
) -> Agreement:
    """Compare stated vectors with observed ones.

    The interval of the median of n values is the better of two. One has the standard error
    sqrt(pi / 2) s / sqrt(n), with s their spread by the median absolute deviation, and Student's
    quantile for n - 1 degrees of freedom; s is at least what the observations' own errors make of
    it. The other ends at the ordered value that the sign test leaves (binomial of n halves): it
    holds for any distribution and needs a dozen values.

    Args:
        observed: (N, 3).
        stated: (N, 3), NaN where unknown.
        sigma_observed: (N,) standard deviations of the observed ones.
        sigma: (N,) of the differences of both.
        false_alarm: probability that the true median lies above the interval.
    """
    from scipy.special import bdtr, stdtrit

    lengths = np.stack([np.linalg.norm(values, axis=1) for values in (observed, stated)])
    sure = np.isfinite(lengths).all(axis=0) & (lengths > _SURE * sigma).any(axis=0)
    n = int(sure.sum())
    if not n:
        return Agreement(0, np.nan, np.inf, np.nan)
    longest = lengths[:, sure].max(axis=0)
    values = np.sum(observed[sure] * stated[sure], axis=1) / longest**2
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    spread = max(spread, float(np.median(sigma_observed[sure] / longest)))
    upper = np.inf
    if n >= _LEAST_MOTIONS:
        # so many values may lie above the median by chance; of few values it is none
        n_above = int(np.searchsorted(bdtr(np.arange(n), n, 0.5), false_alarm / 2, side="right"))
        quantile = float(stdtrit(n - 1, 1 - (false_alarm / 2 if n_above else false_alarm)))
        upper = middle + quantile * np.sqrt(np.pi / 2) * spread / np.sqrt(n)
        if n_above:
            upper = min(upper, float(np.sort(values)[n - n_above]))
    return Agreement(n, middle, upper, _ratio(observed[sure], stated[sure]))


def _ratio(observed: Float, stated: Float) -> float:
    """Median length of stated vectors (N, 3) over that of the observed ones along them."""
    square = np.sum(stated**2, axis=1)
    if not np.median(square) > 0:
        return 0.0
    along = float(np.median(np.sum(observed * stated, axis=1)[square > 0] / square[square > 0]))
    if along > 0:
        return 1.0 / along
    lengths = [float(np.median(np.linalg.norm(values, axis=1))) for values in (stated, observed)]
    return lengths[0] / lengths[1] if lengths[1] > 0 else np.inf


class Comparison(NamedTuple):
    """Agreement of shifts and turns."""

    shift: Agreement
    turn: Agreement

    def contradicts(self, name: str) -> bool:
        """Return True if the interval of shifts or turns lies below the limit."""
        return getattr(self, name).upper < _LEAST_AGREEMENT[name]

    @property
    def n(self) -> int:
        """Shifts and turns that count."""
        return self.shift.n + self.turn.n

    @property
    def worst(self) -> float:
        """The smaller median of those that are known; -1 where none is."""
        return min((each.median for each in self if each.known), default=-1.0)


class Stated(NamedTuple):
    """Motions as odometry or truth states them.

    Attributes:
        poses: (T, 3) or (T, 4, 4), NaN where unknown.
        noise: of odometry; None of the truth.
    """

    poses: Float
    noise: MotionNoise | None = None

    def sigma(self, observed: Motions) -> Float:
        """(N, 2) standard deviations of the differences from observed motions.

        The noise is that of the observed motions: stated ones may be in any unit.
        """
        if self.noise is None:
            return observed.sigma
        own = np.array([self.noise.standard_deviations(m) for m in observed.motion[:, _PLANE]])
        x, y, turn = own.reshape(-1, 3).T ** 2
        arm = np.sum(
            observed.motion[:, :3] ** 2, axis=1
        )  # errors of the heading move the end aside
        return np.sqrt(np.column_stack([x + y + turn * arm, turn]) + observed.sigma**2)


def compare(observed: Motions, stated: Stated, false_alarm: float = _FALSE_ALARM) -> Comparison:
    """Compare observed motions with stated ones, with a probability that sound ones contradict."""
    motions = stated_motions(stated.poses, observed.start, observed.end)
    return _compared(observed, *motions, stated.sigma(observed), false_alarm)


def _compared(
    observed: Motions, shift: Float, turn: Float, sigma: Float, false_alarm: float = _FALSE_ALARM
) -> Comparison:
    each = false_alarm / len(_LEAST_AGREEMENT)
    own = observed.sigma
    return Comparison(
        agreement(observed.motion[:, :3], shift, own[:, 0], sigma[:, 0], each),
        agreement(observed.motion[:, 3:], turn, own[:, 1], sigma[:, 1], each),
    )


class _Cause(NamedTuple):
    """A mistake that would explain what is stated.

    Attributes:
        text: what people call it.
        comparison: with the mistake put right.
        ratio: stated distance over observed one.
    """

    text: str
    comparison: Comparison
    ratio: float

    @property
    def n_parts(self) -> int:
        """Mistakes that it consists of."""
        return len(self.text.split(_AND)) + (self.ratio != 1)


def likely_cause(
    observed: Motions, mistakes: Mapping[str, Float], noise: MotionNoise | None = None
) -> str:
    """The mistake that explains stated motions best, in words.

    Args:
        observed: what they are compared with.
        mistakes: by what is said of each, the poses (T, 3) or (T, 4, 4) with the mistake put right.
            The first has none. Each is tried with all axes exchanged and in all units, too.
        noise: of odometry; None of the truth.

    Returns:
        What people would call it; of none that explains enough, that it is another log's.
    """
    sigma = Stated(mistakes[""], noise).sigma(observed)
    best: _Cause | None = None
    for several in _simplest_first(mistakes):
        for text, axes, poses in several:
            cause = _put_right(text, observed, axes, poses, sigma)
            if best is None or cause.comparison.worst > best.comparison.worst + _TIE:
                best = cause
        if best is not None and best.comparison.worst >= _EXPLAINED:
            break
    if best is None or best.comparison.worst < _EXPLAINED or best.n_parts > _MOST_PARTS:
        if late := _frames_late(observed, mistakes[""]):
            each = (f"{abs(n)} frames too {'late' if n > 0 else 'early'}" for n in late)
            return f"its times look {' or '.join(itertools.islice(each, _MOST_SHIFTS))}"
        plain = compare(observed, Stated(mistakes[""], noise))
        if plain.shift.ratio < _STANDS_STILL:
            return "it says that the robot stands still"
        if scaled := _scaled_text(observed, mistakes[""], plain, sigma):
            return scaled
        return "no common mistake explains it: is it another run's, or the calibration another's?"
    units = _unit_text(best.ratio)
    return _AND.join(text for text in (best.text, units) if text)


def _frames_late(observed: Motions, poses: Float) -> list[int]:
    """Return by how many frames stated poses (T, ...) may lag behind observed motions.

    Motions that repeat agree at several shifts. The shifts whose agreement is a local maximum, and
    about as good as the best, are returned, the smallest first; none if no shift explains them.
    """
    most, worst = min(len(poses) // 2, _MOST_FRAMES_LATE), dict[int, float]()
    for shift in range(-most, most + 1):
        inside = (observed.start + shift >= 0) & (observed.end + shift < len(poses))
        part = Motions(*(values[inside] for values in observed))
        if 2 * len(part.start) < len(observed.start):
            continue
        moved = stated_motions(poses, part.start + shift, part.end + shift)
        found = _compared(part, *moved, part.sigma)
        if found.shift.known and found.turn.known:
            worst[shift] = found.worst
    least = max(_EXPLAINED, max(worst.values(), default=0.0) - _TIE)
    peaks = [
        shift
        for shift, value in worst.items()
        if value > least and value >= max(worst.get(shift + by, -1.0) for by in (-1, 1))
    ]
    return sorted(peaks, key=abs)


def _simplest_first(mistakes: Mapping[str, Float]) -> Iterator[list[tuple[str, Float, Float]]]:
    """Text, axes and poses of causes: none or usual axes, mistakes, other axes, both together."""
    axes = list(_axes())
    usual, others = axes[:_USUAL_AXES], axes[_USUAL_AXES:]
    right, *wrong = mistakes.items()
    yield [(text, R, right[1]) for R, text in usual]
    yield [(text, usual[0][0], poses) for text, poses in wrong]
    yield [(text, R, right[1]) for R, text in others]
    yield [(f"{text}, and {own}", R, poses) for R, own in axes[1:] for text, poses in wrong]


def _scaled_text(observed: Motions, poses: Float, plain: Comparison, sigma: Float) -> str:
    """Words for stated motions whose distances and angles are both in another unit; else none."""
    if not (plain.shift.median > 0 and plain.turn.median > 0):
        return ""
    shift, turn = stated_motions(poses, observed.start, observed.end)
    scaled = _compared(observed, shift / plain.shift.ratio, turn / plain.turn.ratio, sigma)
    if scaled.worst < _EXPLAINED:
        return ""
    told = f"distances are {plain.shift.ratio:.3g} and turns {plain.turn.ratio:.3g} times those"
    return f"{told} that are observed: are units, focal length and baseline right?"


def _put_right(text: str, observed: Motions, axes: Float, poses: Float, sigma: Float) -> _Cause:
    """A cause with axes R_robot_stated (3, 3) and the unit put right."""
    shift, turn = stated_motions(poses, observed.start, observed.end)
    # a rotation vector of a frame with mirrored axes has the other sign, too
    moved, turned = shift @ axes.T, np.linalg.det(axes) * turn @ axes.T
    ratio = _compared(observed, moved, turned, sigma).shift.ratio
    if not ratio > 0 or abs(np.log(ratio)) < np.log1p(_LIKE_A_UNIT):
        ratio = 1.0
    return _Cause(text, _compared(observed, moved / ratio, turned, sigma), ratio)


def _axes() -> Iterator[tuple[Float, str]]:
    """R_robot_stated (3, 3) of all ways to name axes, the usual ones first, with their texts."""
    named: dict[tuple[int, ...], str] = {
        (0, 1, 2, 1, 1, 1): "",
        (0, 1, 2, 1, -1, 1): "the heading has the other sign (clockwise, or y to the right)",
        (2, 0, 1, 1, -1, -1): "the axes are a camera's (z ahead, x right, y down)",
        (1, 0, 2, 1, -1, 1): "the axes are turned: y points ahead (are x and y exchanged?)",
        (0, 1, 2, -1, -1, 1): "x points back",
        (0, 1, 2, 1, -1, -1): "z points down and y right",
    }
    ways = [
        (*order, *signs)
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    ]
    for way in sorted(ways, key=lambda each: list(named).index(each) if each in named else 99):
        axes = np.zeros((3, 3))
        for row in range(3):
            axes[row, way[row]] = way[3 + row]
        ahead = f"{'-' if way[3] < 0 else ''}{'xyz'[way[0]]}"
        up = f"{'-' if way[5] < 0 else ''}{'xyz'[way[2]]}"
        yield axes, named.get(way, f"the axes are others: {ahead} points ahead, {up} up")


def _unit_text(ratio: float) -> str:
    """Words for stated distances that are `ratio` times the observed ones."""
    if ratio == 1:
        return ""
    told = f"distances are {ratio:.3g} times those that are observed"
    for many, unit in _UNITS_M.items():
        if abs(np.log(ratio / many)) < np.log1p(_LIKE_A_UNIT):
            return f"{told}: {unit}?"
        if abs(np.log(ratio * many)) < np.log1p(_LIKE_A_UNIT):
            return f"{told}: are the observed ones {unit}?"
    return f"{told}: are units, focal length and baseline right?"


def odometry_mistakes(increments: Float) -> dict[str, Float]:
    """Poses (T, 3) of increments (T, 3) with each common mistake put right, by its words."""
    differences = np.zeros_like(increments)
    differences[1:] = between(increments[:-1], increments[1:])
    in_radians = increments / [1, 1, _DEGREES]
    return {
        "": chained(increments),
        "its columns look like poses since the start, not increments": chained(differences),
        "odometry_theta_rad looks like degrees (factor 57.3)": chained(in_radians),
        "its increments look inverted (T_after_before)": chained(inverse(increments)),
        "its columns look like poses since the start, with degrees": in_radians,
        "only its heading has the other sign": chained(increments * [1, 1, -1]),
    }


def pose_mistakes(poses: Float) -> dict[str, Float]:
    """Poses (T, 3) or (T, 4, 4) with each common mistake put right, by its words."""
    if poses.ndim == 2:
        return {
            "": poses,
            "its heading looks like degrees (factor 57.3)": poses / [1, 1, _DEGREES],
            "its poses look inverted (T_robot_world)": inverse(poses),
            "only its heading has the other sign": poses * [1, 1, -1],
            "only its y has the other sign": poses * [1, -1, 1],
        }
    known = np.isfinite(poses).all(axis=(1, 2))
    made = {"": poses}
    for order in ([1, 2, 3, 0], [3, 0, 1, 2]):
        own = np.full_like(poses, np.nan)
        quaternions = se3.quaternions(poses[known])[:, order]
        own[known] = se3.from_quaternions(poses[known, :3, 3], quaternions)
        if np.median(own[known, 2, 2]) > _UPRIGHT:  # robots stand
            made[ORDER_OF_QUATERNIONS] = own
    made["its poses look inverted (T_robot_world)"] = se3.inverse(poses)
    return made


def observed_spans(log: RobotLog) -> list[Motions]:
    """Observed motions from frame to frame, and over spans of 2, 4, 8, ... frames.

    Where stated covariances are far too small for what was observed, as those in another unit are,
    they are enlarged until most frames that share points tell a motion.
    """
    level = 1.0
    each = observed_motions(log)
    least = _LEAST_PLANAR_LINKS if log.planar else MIN_LINKS
    if 2 * len(each) < len(log) - 1:
        starts = log.frame_starts()
        tried = np.unique(np.linspace(1, len(log) - 1, _TRIED_FRAMES).astype(int)).tolist()
        frames = [k for k in tried if len(links(log, starts, k - 1, k)[0]) >= least]
        for level in _LEVELS:
            told = [_observed_motion(log, starts, k - 1, k, level) for k in frames]
            if 2 * sum(one is not None for one in told) >= len(frames):
                break
        each = each if level == 1 else observed_motions(log, 1, level)
    return [each, *(observed_motions(log, lag, level) for lag in _lags(len(log)))]


def composed_spans(each: Motions, n_frames: int) -> list[Motions]:
    """Motions from frame to frame, and composed over spans of 2, 4, 8, ... frames."""
    return [each, *(spanned(each, lag) for lag in _lags(n_frames))]


def _lags(n_frames: int) -> list[int]:
    """Lengths of spans beyond one frame of which a log has enough."""
    longest = max((n_frames - 1) // _LEAST_MOTIONS, 1)
    return [2**k for k in range(1, int(np.log2(longest)) + 1)]


def _in_most_spans(each: Sequence[Comparison], name: str) -> bool:
    """Return True if shifts or turns lie below the limit in at least half of the spans.

    Noise and resolution of what is stated contradict short spans alone.
    """
    medians = [found.median for found in (getattr(c, name) for c in each) if found.known]
    n_below = sum(median < _LEAST_AGREEMENT[name] for median in medians)
    return 2 * n_below >= len(medians) > 0


def disagreement(
    kind: str, what: str, spans: Sequence[Motions], stated: Stated, mistakes: Mapping[str, Float]
) -> Finding | None:
    """Return the finding about stated motions that contradict observed ones; None if they agree.

    Args:
        kind: of the finding.
        what: beginning of its text.
        spans: observed motions, over spans of several lengths.
        stated: what they are compared with.
        mistakes: as `likely_cause` has them.
    """
    each = [compare(observed, stated, _FALSE_ALARM / len(spans)) for observed in spans]
    quantities = [name for name in _LEAST_AGREEMENT if _in_most_spans(each, name)]
    wrong = [k for k, found in enumerate(each) if any(map(found.contradicts, quantities))]
    if not wrong:
        return None
    most = max(wrong, key=lambda k: each[k].n)
    shown = [
        f"{name}s {found.median:.2f}" for name, found in each[most]._asdict().items() if found.known
    ]
    cause = likely_cause(spans[most], mistakes, stated.noise)
    text = f"{what} in most frames (agreement of {', '.join(shown)}; 1 is full): {cause}"
    return Finding(kind, -1, text)


def odometry_finding(log: RobotLog, spans: Sequence[Motions], noise: MotionNoise) -> Finding | None:
    """Return the finding about a log's odometry as a whole; None if it is sound."""
    what = "the odometry contradicts the motion that the observations show"
    mistakes = odometry_mistakes(log.odometry)
    return disagreement("odometry", what, spans, Stated(mistakes[""], noise), mistakes)


def truth_finding(kind_of_reference: str, spans: Sequence[Motions], poses: Float) -> Finding | None:
    """Return the finding about true poses (T, 3) or (T, 4, 4), NaN where unknown.

    Args:
        kind_of_reference: what tells the motions that they are compared with.
        spans: these motions, over spans of several lengths.
        poses: the truth.
    """
    known = np.isfinite(poses.reshape(len(poses), -1)).all(axis=1)
    if poses.ndim == 3 and known.any() and np.median(poses[known, 2, 2]) < _UPRIGHT:
        text = f"the truth stands on end or on its head in most frames: {ORDER_OF_QUATERNIONS}"
        return Finding("truth", -1, text)
    what = f"the truth contradicts {kind_of_reference}"
    return disagreement("truth", what, spans, Stated(poses), pose_mistakes(poses))


def find_jumps(log: RobotLog, observed: Motions, noise: MotionNoise) -> list[Jump]:
    """Single increments of the odometry that contradict what is seen, by frame.

    Args:
        log: whose odometry agrees with its observations as a whole.
        observed: from frame to frame.
        noise: as stated of the odometry.
    """
    motion, covariance = observed.motion[:, _PLANE], observed.covariance[:, _PLANE][:, :, _PLANE]
    odometry = log.odometry[observed.end]
    if not len(motion):
        return []
    off = motion - odometry
    off[:, 2] = wrap(off[:, 2])
    sigma = np.array([noise.standard_deviations(each) for each in odometry])
    spread = covariance + sigma[:, :, None] ** 2 * np.eye(3) + np.diag(_ROUNDING**2)
    square = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
    # where all noise is larger than stated, chance makes larger differences, too
    square /= max(float(np.median(square)) / chi_square_bound(0.5, 3), 1.0)
    by_chance = chi_square_bound(1 - _JUMP_BY_CHANCE / len(square), 3)
    sizes = np.stack([_sizes(motion), _sizes(odometry)])
    ordinary = np.quantile(sizes.min(axis=0), _ORDINARY, axis=0)
    least = np.maximum(_JUMP_STEPS * ordinary, _JUMP_FLOOR)
    enough = np.maximum(_LEAST_JUMP_LINKS, observed.n_links / 2)
    # a motion that is as large itself shows points that were taken for others
    wrong = (square > by_chance) & (_sizes(off) > least).any(axis=1)
    wrong &= (sizes[0] <= least).all(axis=1)
    rows = np.flatnonzero(wrong & (observed.n_agree >= enough))
    if len(rows) > max(_MOST_JUMPS * len(square), 1):
        return []
    return [
        Jump(int(observed.end[n]), motion[n], covariance[n], odometry[n]) for n in rows.tolist()
    ]


def _sizes(motion: Float) -> Float:
    """Distances and angles (N, 2) of motions (N, 3)."""
    return np.column_stack([np.hypot(motion[:, 0], motion[:, 1]), np.abs(motion[:, 2])])


def without_jumps(
    log: RobotLog, jumps: Sequence[Jump], odometry_covariance: Float | None = None
) -> tuple[RobotLog, Float | None]:
    """The log with each jump replaced by the observed motion, and the covariance of its odometry.

    Args:
        log: with the jumps.
        jumps: which they are.
        odometry_covariance: (T, 3, 3) of odometry that pictures told, or None.

    Returns:
        Both as given if there are no jumps. Otherwise the covariance is that of the observed motion
        at the jumps, and NaN where the odometry is as noisy as the filter's settings say.
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
        findings: one line each; none of a sound log.
        jumps: single increments that count for nothing.
        observed: motions that the observations show, over spans of several lengths.
    """

    findings: tuple[Finding, ...]
    jumps: tuple[Jump, ...]
    observed: Sequence[Motions]


def check_log(log: RobotLog, noise: MotionNoise) -> LogConsistency:
    """Compare a log's odometry with the motion that its observations show.

    Args:
        log: of odometry that was measured; what was taken from the observations agrees with them.
        noise: as stated of the odometry.
    """
    spans = observed_spans(log)
    finding = odometry_finding(log, spans, noise)
    if finding is not None:
        return LogConsistency((finding,), (), spans)
    jumps = tuple(find_jumps(log, spans[0], noise))
    return LogConsistency(tuple(jump.finding for jump in jumps), jumps, spans)


def outside_gate(log: RobotLog, landmark: np.ndarray) -> tuple[int, int]:
    """Observations that fell outside the gate of the landmark that they are known to show.

    An observation is known to show the landmark of those before it with the same label or track.

    Args:
        log: what was filtered.
        landmark: (N,) source of the landmark that each observation went into, negative for none.

    Returns:
        How many went into none or into one of their own, and how many were expected in one.
    """
    seen = log.observations
    names = seen.track if seen.label is None else seen.label
    if names is None:
        return 0, 0
    order = np.argsort(names, kind="stable")  # by name, and in the order of time
    before, after = order[:-1], order[1:]
    again = (names[before] == names[after]) & (names[after] != NO_TRACK)
    missed = (landmark[after] < 0) | (landmark[after] == after)
    return int(np.count_nonzero(again & missed)), int(np.count_nonzero(again))


def gate_finding(log: RobotLog, landmark: np.ndarray) -> Finding | None:
    """Return the finding about a map that most observations contradict; `landmark` as above."""
    n_outside, n_expected = outside_gate(log, landmark)
    if n_outside <= MOST_OUTSIDE * n_expected:
        return None
    share = f"{n_outside} of {n_expected} observations ({n_outside / n_expected:.0%})"
    return Finding("gate", -1, f"{share} fell outside the gate of the landmark that they show")
