"""Least-squares refinement of an estimate: local, without new sampling."""

import math
import time
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from mapfusion.align.alignment import MIN_PAIRS, Alignment, Pairs, Status, undetermined
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.drift import calibration_part, drift_step
from mapfusion.align.mahalanobis_gate import (
    PlanarPairs,
    at_rows,
    farthest_m,
    is_unlike_the_others,
    leaves_margin,
    mark_inside,
    most_leverage,
    near_pairs,
    why_one_pair,
)
from mapfusion.align.method import why_one_place
from mapfusion.geometry.numerics import Float, invert, kernel, kernel_part
from mapfusion.geometry.se2 import add_turned, lever, residual, transform_points, wrap
from mapfusion.parameters import Range, require_in_range, require_shape

# A gate of three standard deviations keeps 99 % of a plane's residuals; a larger s_drift could not
# be told from false pairs spread over the gate.
_GATE_SIGMAS = 3.0
_TOLERANCE_M = 1e-8  # movement of the landmarks that counts as none
# A pair on the gate's edge could go in and out for ever, and s_drift swing to and fro between two
# values; from this round on the pair stays where it is, and steps of s_drift are halved.
_SETTLING_ROUNDS = 50
_SWINGING = 0.9  # of the last change of s_drift^2, turned back: it hardly settles by itself
# False pairs in the gate counted before any is seen: a share of exactly 1 could never be revised,
# and is approached without end.
_PRIOR_FALSE = 1.0


@dataclass(frozen=True)
class Refinement:
    """Weighted least squares within a fixed gate, repeated to a fixed point.

    The pairs inside the gate are a mixture: true ones with covariance S_a + R S_b R^T +
    s_drift^2 I, and false ones spread evenly over the gate. Each round weighs the pairs by their
    probability of being true, then takes a step for the motion (Gauss-Newton on the weighted normal
    equations), for s_drift (Fisher scoring) and for the share of true ones (expectation
    maximisation, Dempster et al. 1977); steps of s_drift that swing to and fro are halved.

    An answer that rests on one pair is refused: without the pair of most leverage the motion has to
    stay within the gate.

    Attributes:
        gate_m: distance in the plane under the estimate up to which a pair takes part. Between two
            maps drift displaces true pairs by 0.1 to 0.3 m, and the estimate adds its own error.
        least_drift_m: pairs are judged true or false with an s_drift of at least this. Drift is
            common to neighbours: a part of a map that moved as one, by the 0.1 m that are usual,
            would else pass for false pairs, and the answer depend on where the search began.
        max_rounds: an estimate that still moves then is refused.
        height: which pairs can be true by their heights (not for planar maps).
    """

    gate_m: Annotated[float, Range(1e-3, 1000, "m")] = 0.5
    least_drift_m: Annotated[float, Range(0, 100, "m")] = 0.1
    max_rounds: Annotated[int, Range(1, 100_000, "rounds")] = 500
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        require_in_range(self)

    def refine(self, pairs: Pairs, T_a_b: Float) -> Alignment:
        """Improve T_a_b (3,); an estimate of NaN stays degenerate.

        Raises:
            ValueError: T_a_b has another shape.
        """
        started_s = time.perf_counter()
        T_a_b = np.asarray(T_a_b, dtype=np.float64)
        require_shape("T_a_b", T_a_b, (3,))
        if not np.all(np.isfinite(T_a_b)):
            return undetermined("there is no estimate to refine", len(pairs), started_s)
        rows = pairs.of_one_height(self.height)
        planar = pairs[rows].in_plan()
        limits = (self._widest_m(pairs, T_a_b), self.least_drift_m, self.max_rounds)
        solved, moved_m, T_a_b, covariance, variance, truth, left_out = maximise_likelihood(
            planar, T_a_b, *limits
        )
        if not solved:
            reason = f"the pairs within {self.gate_m:g} m of the estimate determine no motion"
            return undetermined(reason, len(pairs), started_s)
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[rows] = truth > 0.5
        reason = why_one_place(pairs[inlier], variance) if np.any(inlier) else ""
        if reason:
            return undetermined(reason, len(pairs), started_s)
        if moved_m > _TOLERANCE_M:
            reason = f"still moved by {moved_m:.1e} m after {self.max_rounds} rounds"
        elif np.count_nonzero(inlier) < MIN_PAIRS:
            reason = f"{np.count_nonzero(inlier)} correspondences agree, {MIN_PAIRS} are needed"
        else:
            others = PlanarPairs(*(np.delete(part, left_out, axis=0) for part in planar))
            solved, _, T_without, sure, drift_m2, *_ = maximise_likelihood(others, T_a_b, *limits)
            may_move_m = limits[0]
            # a known identity that the motion rests on is false only if it is unlike all others
            if pairs.by_name and solved:
                rest = (T_without, sure, drift_m2)
                if is_unlike_the_others(*rest, planar, left_out):
                    may_move_m = self.gate_m
            reason = why_one_pair(T_a_b, T_without if solved else None, planar, truth, may_move_m)
        covariance = covariance + calibration_part(T_a_b, pairs[inlier], math.sqrt(variance))
        T_a_b[2] = wrap(T_a_b[2])
        return Alignment(
            T_a_b,
            covariance,
            inlier,
            time.perf_counter() - started_s,
            Status.REFUSED if reason else Status.ACCEPTED,
            reason,
            math.sqrt(variance),
        )

    def _widest_m(self, pairs: Pairs, T_a_b: Float) -> float:
        """The gate, for landmarks known by name so wide that it leaves out none that maps bend.

        None of them is false but by a name that was misread, and that lies farther off; a gate that
        cuts what is bent lays one part of such maps onto its like, and nothing else.
        """
        if not pairs.by_name or not len(pairs):
            return self.gate_m
        off = pairs.p_a[:, :2] - transform_points(T_a_b, pairs.p_b[:, :2])
        # s_drift starts at a third of the gate, three times the RMS, and none of up to 81 names is
        # left out there: no residual of n is more than sqrt(n) times their RMS
        return max(self.gate_m, _GATE_SIGMAS**2 * math.sqrt(np.mean(np.sum(off**2, axis=1))))


@kernel_part
def residuals_under(T_a_b: Float, pairs: PlanarPairs, e: Float, S: Float) -> None:
    """Fill e = p_a - T p_b (N, 2) and S = S_a + R S_b R^T (N, 2, 2)."""
    p_a, p_b, S_a, S_b = pairs
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    for i in range(len(p_a)):
        e[i, 0], e[i, 1] = residual(T_a_b, cos, sin, p_a, p_b, i)
        S[i, 0, 0], turned_xy, S[i, 1, 1] = add_turned(
            S_a[i, 0, 0], 0.0, S_a[i, 1, 1], cos, sin, S_b[i, 0, 0], S_b[i, 0, 1], S_b[i, 1, 1]
        )
        S[i, 0, 1] = S[i, 1, 0] = S_a[i, 0, 1] + turned_xy


@kernel_part
def truth_probabilities(
    e: Float,
    S: Float,
    variance_m2: float,
    share: float,
    gate_m: float,
    inside: np.ndarray,
    truth: Float,
) -> tuple[float, int]:
    """Fill the probability (N,) of being true of each pair inside the gate, 0 of the others.

    Returns their sum, and how many are inside.
    """
    false_density = (1 - share) / (math.pi * gate_m * gate_m)
    total, count = 0.0, 0
    for i in range(len(e)):
        truth[i] = 0.0
        if not inside[i]:
            continue
        xx, xy, yy = S[i, 0, 0] + variance_m2, S[i, 0, 1], S[i, 1, 1] + variance_m2
        det = xx * yy - xy * xy
        square = (yy * e[i, 0] ** 2 - 2 * xy * e[i, 0] * e[i, 1] + xx * e[i, 1] ** 2) / det
        true_density = share * math.exp(-square / 2) / (2 * math.pi * math.sqrt(det))
        if true_density > 0:
            truth[i] = true_density / (true_density + false_density)
        total += truth[i]
        count += 1
    return total, count


@kernel_part
def put_normal_equations(
    T_a_b: Float,
    p_b: Float,
    e: Float,
    S: Float,
    variance_m2: float,
    truth: Float,
    normal: Float,
    right: Float,
) -> None:
    """J' W J (3, 3) and J' W e (3,) with W = truth (S + s_drift^2 I)^-1 and J = d(T p_b)/dT."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    nxx = nxy = nyy = nxt = nyt = ntt = rx = ry = rt = 0.0
    for i in range(len(e)):
        if truth[i] == 0:
            continue
        ex, ey = e[i, 0], e[i, 1]
        xx, xy, yy = S[i, 0, 0] + variance_m2, S[i, 0, 1], S[i, 1, 1] + variance_m2
        scale = truth[i] / (xx * yy - xy * xy)
        wxx, wxy, wyy = scale * yy, -scale * xy, scale * xx
        jx, jy = lever(cos, sin, p_b, i)
        wx, wy = wxx * ex + wxy * ey, wxy * ex + wyy * ey
        nxx, nxy, nyy = nxx + wxx, nxy + wxy, nyy + wyy
        nxt += wxx * jx + wxy * jy
        nyt += wxy * jx + wyy * jy
        ntt += wxx * jx * jx + 2 * wxy * jx * jy + wyy * jy * jy
        rx, ry, rt = rx + wx, ry + wy, rt + (jx * wx + jy * wy)
    right[0], right[1], right[2] = rx, ry, rt
    normal[0, 0], normal[1, 1], normal[2, 2] = nxx, nyy, ntt
    normal[0, 1] = normal[1, 0] = nxy
    normal[0, 2] = normal[2, 0] = nxt
    normal[1, 2] = normal[2, 1] = nyt


@kernel_part
def take_missing_information(
    T_a_b: Float,
    p_b: Float,
    e: Float,
    S: Float,
    weighed_m2: float,
    judged_m2: float,
    truth: Float,
    information: Float,
) -> None:
    """Take from the information (3, 3) what not knowing which pairs are true takes (Louis 1982).

    When the motion moves, so do the probabilities: d truth / de = -truth (1 - truth) C^-1 e, and a
    normal matrix with certain weights would promise too much. `weighed_m2` is s_drift^2 in the
    weights, `judged_m2` in the probabilities; e and S are those of `residuals_under`.
    """
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    missing, pull, turn = np.zeros((3, 3)), np.empty(3), np.empty(3)
    for i in range(len(e)):
        share = truth[i] * (1 - truth[i])
        if share == 0:
            continue
        jx, jy = lever(cos, sin, p_b, i)
        for k in range(2):
            variance, force = (judged_m2, turn) if k else (weighed_m2, pull)
            xx, xy, yy = S[i, 0, 0] + variance, S[i, 0, 1], S[i, 1, 1] + variance
            det = xx * yy - xy * xy
            force[0] = (yy * e[i, 0] - xy * e[i, 1]) / det
            force[1] = (xx * e[i, 1] - xy * e[i, 0]) / det
            force[2] = jx * force[0] + jy * force[1]
        for row in range(3):
            for column in range(3):
                product = pull[row] * turn[column] + turn[row] * pull[column]
                missing[row, column] += share * product / 2
    for row in range(3):
        for column in range(3):
            information[row, column] -= missing[row, column]


@kernel_part
def _farthest_moved(T_a_b: Float, step: Float, p_b: Float, truth: Float) -> float:
    """How far a step (3,) moves the landmark that it moves farthest, in m."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    square = 0.0
    for i in range(len(truth)):
        if truth[i] > 0:
            jx, jy = lever(cos, sin, p_b, i)
            dx, dy = step[0] + jx * step[2], step[1] + jy * step[2]
            square = max(square, dx * dx + dy * dy)
    return math.sqrt(square)


@kernel
def maximise_likelihood(
    pairs: PlanarPairs, T_start: Float, gate_m: float, least_drift_m: float, max_rounds: int
) -> tuple[bool, float, Float, np.ndarray, float, Float, int]:
    """Expectation maximisation for motion, s_drift and share of true pairs.

    Returns:
        Whether the pairs determine a motion and its covariance, how far the last step moved a
        landmark (m), T_a_b (3,), its covariance (3, 3), s_drift^2, each pair's probability of being
        true (N,), and which one has most leverage.
    """
    n, farthest = len(pairs.p_a), farthest_m(pairs.p_b)
    T_a_b, T_near = T_start.copy(), T_start.copy()
    inside_of_all, truth_of_all = np.zeros(n, np.bool_), np.zeros(n)
    near = near_pairs(T_a_b, pairs, gate_m, inside_of_all)
    widest = (gate_m / _GATE_SIGMAS) ** 2
    variance, share = widest, 0.5
    step_share, last_change = 1.0, 0.0
    covariance, step, right = np.empty((3, 3)), np.empty(3), np.empty(3)
    for k in range(9):
        covariance[k // 3, k % 3] = math.nan
    moved, determined = math.inf, True
    judged, weighed, normal, at = variance, variance, np.empty((3, 3)), np.empty(3)
    for rounds in range(max_rounds):
        if leaves_margin(T_a_b, T_near, gate_m, farthest):
            at_rows(near.inside, near.rows, inside_of_all)
            near, T_near = near_pairs(T_a_b, pairs, gate_m, inside_of_all), T_a_b.copy()
        _, some, e, S, inside, truth = near
        residuals_under(T_a_b, some, e, S)
        if rounds < _SETTLING_ROUNDS:
            mark_inside(e, gate_m, inside)
        weighed, judged = variance, max(variance, least_drift_m * least_drift_m)
        total, count = truth_probabilities(e, S, judged, share, gate_m, inside, truth)
        put_normal_equations(T_a_b, some.p_b, e, S, variance, truth, normal, right)
        determined = not total < 1.0 and invert(normal, covariance)
        if not determined:
            break
        share = total / (count + _PRIOR_FALSE)
        change = min(drift_step(e, S, truth, variance, gate_m), widest) - variance
        # few pairs far surer than the rest can throw it from one side to the other
        turned_back = change * last_change < 0 and abs(change) > _SWINGING * abs(last_change)
        if turned_back and rounds >= _SETTLING_ROUNDS:
            step_share /= 2
        variance += step_share * change
        last_change = change
        _times(covariance, right, step)
        moved = _farthest_moved(T_a_b, step, some.p_b, truth)
        for k in range(3):
            at[k] = T_a_b[k]
            T_a_b[k] += step[k]
        if moved <= _TOLERANCE_M:
            break
    if determined:
        _, some, e, S, _, truth = near
        take_missing_information(at, some.p_b, e, S, weighed, judged, truth, normal)
        determined = invert(normal, covariance)
    at_rows(near.truth, near.rows, truth_of_all)
    most = most_leverage(T_a_b, pairs, variance, truth_of_all, covariance)
    return determined, moved, T_a_b, covariance, variance, truth_of_all, most


@kernel_part
def _times(matrix: Float, vector: Float, product: Float) -> None:
    """Fill the product (3,) of a matrix (3, 3) and a vector (3,)."""
    for k in range(3):
        product[k] = matrix[k, 0] * vector[0] + matrix[k, 1] * vector[1] + matrix[k, 2] * vector[2]
