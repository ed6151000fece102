"""Least-squares refinement of an estimate: local, without new sampling.

The oracle refines the motion of the true correspondences: the best result that the maps allow.
"""

import math
import time
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from mapfusion.align.alignment import (
    MIN_PAIRS,
    Alignment,
    Pairs,
    Status,
    undetermined,
    why_angle_is_open,
    why_too_few,
)
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.covariance import alignment_covariance, drift_step
from mapfusion.align.geometric_matching import mutually_nearest
from mapfusion.align.mahalanobis_gate import (
    PlanarPairs,
    highest_leverage_pair,
    is_outlier_to_others,
    why_rests_on_one_pair,
)
from mapfusion.align.rigid_motion import fit_rigid, residual_covariances
from mapfusion.geometry.numerics import Float, invert, kernel, require_shape
from mapfusion.geometry.se2 import (
    add_turned,
    lever,
    motion_jacobian,
    residual,
    transform_points,
    wrap,
)
from mapfusion.parameters import Range, require_in_range

# A gate of three standard deviations contains 99 % of planar residuals. A larger s_drift could not
# be distinguished from false pairs that are uniform over the gate.
_GATE_SIGMAS = 3.0
_TOLERANCE_M = 1e-8  # movement of the landmarks at convergence
# Relative change of s_drift^2 and of the share of true pairs at convergence: the covariance then
# has about four digits. Exact maps determine the motion before s_drift has left its start.
_MIXTURE_TOLERANCE = 1e-4
# Round from which on the pairs inside the gate are fixed and oscillating steps of s_drift are
# halved, so that neither a pair on the gate's edge nor s_drift oscillates forever.
_SETTLING_ROUNDS = 50
_SWINGING = 0.9  # reversed share of the last change of s_drift^2 that counts as an oscillation
# Prior number of false pairs in the gate: a share of true pairs of exactly 1 could not decrease.
_PRIOR_FALSE = 1.0


@dataclass(frozen=True)
class Refinement:
    """Weighted least squares within a fixed gate, iterated to convergence.

    The pairs inside the gate are a mixture of true pairs with covariance S_a + R S_b R^T +
    s_drift^2 I and false pairs that are uniform over the gate. Expectation maximisation (Dempster
    et al. 1977): each round weights the pairs by their probability of being true, and takes a
    Gauss-Newton step of the motion and a Fisher scoring step of s_drift. Oscillating steps of
    s_drift are halved.

    Precise maps have an s_drift below `least_drift_m`. A second pass, from the result of the first,
    then judges the pairs by the s_drift of the first pass. With the larger bound a false pair in
    the gate would count as true, and would move the motion if its landmarks are precise.

    A result that rests on one pair is refused: without the pair of highest leverage the motion must
    stay within the gate.

    Attributes:
        gate_m: largest distance in the plane of a pair under the estimate. Drift displaces true
            pairs of two maps by 0.1 to 0.3 m, and the estimate has an error as well.
        least_drift_m: smallest s_drift for the probability that a pair is true, in the first pass.
            Drift is common to neighbours; without this bound a part of a map that is displaced by
            0.1 m would count as false, and the result would depend on the initial estimate.
        max_rounds: largest number of rounds; an estimate that has not converged is refused.
        height: test of compatible heights (not for planar maps).
    """

    gate_m: Annotated[float, Range(1e-3, 1000, "m")] = 0.5
    least_drift_m: Annotated[float, Range(0, 100, "m")] = 0.1
    max_rounds: Annotated[int, Range(1, 100_000, "rounds")] = 500
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        require_in_range(self)

    def refine(self, pairs: Pairs, T_a_b: Float) -> Alignment:
        """Refine T_a_b (3,); the result for NaN is degenerate.

        Raises:
            ValueError: T_a_b has another shape.
        """
        started_s = time.perf_counter()
        T_a_b = np.asarray(T_a_b, dtype=np.float64)
        require_shape("T_a_b", T_a_b, (3,))
        if not np.all(np.isfinite(T_a_b)):
            return undetermined("there is no estimate to refine", len(pairs), started_s)
        gate_m = self.gate_m
        if pairs.by_name and len(pairs):
            # Labels are rarely false, and a gate that excludes the bent part of a map would align
            # the other part only. s_drift starts at a third of the gate, three times the RMS
            # residual; no residual of n exceeds sqrt(n) times the RMS, so that up to 81 labels all
            # take part. Covariances in the frame of the start can be larger than the gate; uniform
            # false pairs would then be more probable than true ones.
            residual_xy = pairs.p_a[:, :2] - transform_points(T_a_b, pairs.p_b[:, :2])
            rms_m = math.sqrt(np.mean(np.sum(residual_xy**2, axis=1)))
            stated = residual_covariances(T_a_b, pairs.covariance_a, pairs.covariance_b)
            sigma_m = math.sqrt(np.linalg.eigvalsh(stated).max())
            gate_m = max(self.gate_m, _GATE_SIGMAS**2 * rms_m, _GATE_SIGMAS * sigma_m)
        rows = pairs.of_one_height(self.height)
        planar = pairs[rows].in_plan()
        limits = (gate_m, self.least_drift_m, self.max_rounds)
        found = maximise_likelihood(planar, T_a_b, *limits)
        if found[0] and (drift_m := math.sqrt(found[4])) < self.least_drift_m:
            second_limits = (gate_m, drift_m, self.max_rounds)
            second = maximise_likelihood(planar, found[2], *second_limits)
            if second[0]:
                found, limits = second, second_limits
        solved, moved_m, T_a_b, covariance, variance, truth, left_out = found
        if not solved:
            reason = f"the pairs within {self.gate_m:g} m of the estimate determine no motion"
            return undetermined(reason, len(pairs), started_s)
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[rows] = truth > 0.5
        if pairs.by_geometry:  # several motions offered pairs, which may share a landmark
            used = pairs[inlier]
            residual_xy = used.p_a[:, :2] - transform_points(T_a_b, used.p_b[:, :2])
            apart_m = np.hypot(residual_xy[:, 0], residual_xy[:, 1])
            inlier[inlier] = mutually_nearest(used.index_a, used.index_b, apart_m)
        reason = why_angle_is_open(pairs[inlier], variance) if np.any(inlier) else ""
        if reason:
            return undetermined(reason, len(pairs), started_s)
        if moved_m > _TOLERANCE_M:
            reason = f"still moved by {moved_m:.1e} m after {self.max_rounds} rounds"
        elif np.count_nonzero(inlier) < MIN_PAIRS:
            reason = f"{np.count_nonzero(inlier)} correspondences agree, {MIN_PAIRS} are needed"
        else:
            others = PlanarPairs(*(np.delete(part, left_out, axis=0) for part in planar))
            solved, _, T_without, without_outliers, drift_m2, *_ = maximise_likelihood(
                others, T_a_b, *limits
            )
            may_move_m = gate_m
            # a labelled pair of high leverage is false only if it is an outlier to the others
            if pairs.by_name and solved:
                without_best_pair = (T_without, without_outliers, drift_m2)
                if is_outlier_to_others(*without_best_pair, planar, left_out):
                    may_move_m = self.gate_m
            reason = why_rests_on_one_pair(
                T_a_b, T_without if solved else None, planar, truth, may_move_m
            )
        drift_m, lower_bound, used = math.sqrt(variance), True, pairs[inlier]
        if len(used) >= 2:
            # derivative of the solution of the weighted normal equations by each residual
            S = residual_covariances(T_a_b, used.covariance_a, used.covariance_b)
            W = truth[inlier[rows], None, None] * np.linalg.inv(S + variance * np.eye(2))
            J = motion_jacobian(T_a_b, used.p_b)
            weighted = np.swapaxes(J, 1, 2) @ W
            gain = np.linalg.solve(np.sum(weighted @ J, axis=0), weighted)
            covariance_of_motion = alignment_covariance(T_a_b, used, gain, drift_m, covariance)
            covariance, lower_bound = covariance_of_motion
        T_a_b[2] = wrap(T_a_b[2])
        return Alignment(
            T_a_b,
            covariance,
            inlier,
            time.perf_counter() - started_s,
            Status.REFUSED if reason else Status.ACCEPTED,
            reason,
            drift_m,
            lower_bound,
        )


@kernel
def maximise_likelihood(
    pairs: PlanarPairs, T_start: Float, gate_m: float, least_drift_m: float, max_rounds: int
) -> tuple[bool, float, Float, np.ndarray, float, Float, int]:
    """Estimate the motion, s_drift and the share of true pairs by expectation maximisation.

    Returns:
        True if the pairs determine a motion and its covariance; the largest movement of a landmark
        in the last step (m); T_a_b (3,); its covariance (3, 3); s_drift^2; the probability of each
        pair to be true (N,); and the row of the pair of highest leverage.
    """
    p_a, p_b, S_a, S_b = pairs
    n = len(p_a)
    T_a_b, cos, sin = T_start.copy(), 1.0, 0.0
    # residuals p_a - T p_b and their covariances S_a + R S_b R^T, of the pairs inside the gate
    e, S = np.empty((n, 2)), np.empty((n, 2, 2))
    inside, truth = np.zeros(n, np.bool_), np.zeros(n)
    widest = (gate_m / _GATE_SIGMAS) ** 2
    variance, share = widest, 0.5
    step_share, last_change = 1.0, 0.0
    normal, covariance, step = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(9):
        covariance[k // 3, k % 3] = math.nan
    moved, determined = math.inf, True
    judged, weighed = variance, variance
    for rounds in range(max_rounds):
        cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
        weighed, judged = variance, max(variance, least_drift_m * least_drift_m)
        false_density = (1 - share) / (math.pi * gate_m * gate_m)
        total, count = 0.0, 0
        # J' W J and J' W e with W = truth (S + s_drift^2 I)^-1 and J = d(T p_b)/dT
        nxx = nxy = nyy = nxt = nyt = ntt = rx = ry = rt = 0.0
        for i in range(n):
            ex, ey = residual(T_a_b, cos, sin, p_a, p_b, i)
            if rounds < _SETTLING_ROUNDS:
                inside[i] = ex * ex + ey * ey <= gate_m * gate_m
            truth[i] = 0.0
            if not inside[i]:
                continue
            own_xx, turned_xy, own_yy = add_turned(
                S_a[i, 0, 0], 0.0, S_a[i, 1, 1], cos, sin, S_b[i, 0, 0], S_b[i, 0, 1], S_b[i, 1, 1]
            )
            xy = S_a[i, 0, 1] + turned_xy
            e[i, 0], e[i, 1] = ex, ey
            S[i, 0, 0], S[i, 0, 1], S[i, 1, 0], S[i, 1, 1] = own_xx, xy, xy, own_yy
            # the probability of being true
            xx, yy = own_xx + judged, own_yy + judged
            det = xx * yy - xy * xy
            square = (yy * ex**2 - 2 * xy * ex * ey + xx * ey**2) / det
            true_density = share * math.exp(-square / 2) / (2 * math.pi * math.sqrt(det))
            if true_density > 0:
                truth[i] = true_density / (true_density + false_density)
            total += truth[i]
            count += 1
            if truth[i] == 0:
                continue
            # the normal equations
            xx, yy = own_xx + weighed, own_yy + weighed
            scale = truth[i] / (xx * yy - xy * xy)
            wxx, wxy, wyy = scale * yy, -scale * xy, scale * xx
            jx, jy = lever(cos, sin, p_b, i)
            wx, wy = wxx * ex + wxy * ey, wxy * ex + wyy * ey
            nxx, nxy, nyy = nxx + wxx, nxy + wxy, nyy + wyy
            nxt += wxx * jx + wxy * jy
            nyt += wxy * jx + wyy * jy
            ntt += wxx * jx * jx + 2 * wxy * jx * jy + wyy * jy * jy
            rx, ry, rt = rx + wx, ry + wy, rt + (jx * wx + jy * wy)
        normal[0, 0], normal[1, 1], normal[2, 2] = nxx, nyy, ntt
        normal[0, 1] = normal[1, 0] = nxy
        normal[0, 2] = normal[2, 0] = nxt
        normal[1, 2] = normal[2, 1] = nyt
        determined = not total < 1.0 and invert(normal, covariance)
        if not determined:
            break
        share_before, share = share, total / (count + _PRIOR_FALSE)
        change = min(drift_step(e, S, truth, variance, gate_m), widest) - variance
        # a few pairs that are far more precise than the others can cause oscillation
        turned_back = change * last_change < 0 and abs(change) > _SWINGING * abs(last_change)
        if turned_back and rounds >= _SETTLING_ROUNDS:
            step_share /= 2
        variance += step_share * change
        last_change = change
        for k in range(3):
            step[k] = covariance[k, 0] * rx + covariance[k, 1] * ry + covariance[k, 2] * rt
        # largest movement of a landmark
        farthest2 = 0.0
        for i in range(n):
            if truth[i] > 0:
                jx, jy = lever(cos, sin, p_b, i)
                dx, dy = step[0] + jx * step[2], step[1] + jy * step[2]
                farthest2 = max(farthest2, dx * dx + dy * dy)
        moved = math.sqrt(farthest2)
        for k in range(3):
            T_a_b[k] += step[k]
        settled = abs(step_share * change) <= _MIXTURE_TOLERANCE * variance
        settled = settled and abs(share - share_before) <= _MIXTURE_TOLERANCE * share
        if moved <= _TOLERANCE_M and settled:
            break
    if determined:
        # Subtract the missing information about which pairs are true (Louis 1982). The
        # probabilities depend on the motion, d truth / de = -truth (1 - truth) C^-1 e; the normal
        # matrix with constant weights would underestimate the covariance.
        missing, pull, turn = np.zeros((3, 3)), np.empty(3), np.empty(3)
        for i in range(n):
            unsure = truth[i] * (1 - truth[i])
            if unsure == 0:
                continue
            jx, jy = lever(cos, sin, p_b, i)
            for k in range(2):
                drift_m2, force = (judged, turn) if k else (weighed, pull)
                xx, xy, yy = S[i, 0, 0] + drift_m2, S[i, 0, 1], S[i, 1, 1] + drift_m2
                det = xx * yy - xy * xy
                force[0] = (yy * e[i, 0] - xy * e[i, 1]) / det
                force[1] = (xx * e[i, 1] - xy * e[i, 0]) / det
                force[2] = jx * force[0] + jy * force[1]
            for row in range(3):
                for column in range(3):
                    product = pull[row] * turn[column] + turn[row] * pull[column]
                    missing[row, column] += unsure * product / 2
        for row in range(3):
            for column in range(3):
                normal[row, column] -= missing[row, column]
        determined = invert(normal, covariance)
    leverage_row = highest_leverage_pair(T_a_b, pairs, variance, truth, covariance)
    return determined, moved, T_a_b, covariance, variance, truth, leverage_row


@dataclass(frozen=True)
class Oracle:
    """Aligner that receives the true pairs, for evaluation only.

    Attributes:
        refinement: least squares, as for the estimate of every aligner.
    """

    refinement: Refinement = field(default_factory=Refinement)

    def align(self, pairs: Pairs, is_true: np.ndarray) -> Alignment:
        """Estimate T_a_b from the correspondences marked in `is_true` (N,) bool.

        Raises:
            ValueError: `is_true` has another length.
        """
        started_s = time.perf_counter()
        require_shape("is_true", is_true, (len(pairs),))
        rows = np.flatnonzero(is_true)
        reason = why_too_few(pairs.map_a, pairs.map_b, len(rows), MIN_PAIRS)
        if reason:
            return undetermined(f"true ones: {reason}", len(pairs), started_s)
        start = fit_rigid(pairs.p_a, pairs.p_b, rows)
        refined = self.refinement.refine(pairs[rows], np.array(start))
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[rows] = refined.inlier
        return replace(refined, inlier=inlier, elapsed_s=time.perf_counter() - started_s)
