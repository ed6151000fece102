"""The few of many pairs that can come within a gate while a motion changes a little.

Kernels that look at pairs within a gate, round after round, need not look at the others as long as
the motion has not gone farther than a margin.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.align.mahalanobis_gate import PlanarPairs
from mapfusion.kernels import inner_kernel, kernel, kernel_part
from mapfusion.planar import residual
from mapfusion.se2 import Float

_MARGIN = 0.25  # of a gate; a motion that has found its pairs goes less far
_ROUNDING = 1e-6  # of a gate, more than rounding may move a point by


class NearPairs(NamedTuple):
    """n pairs in reach of a gate, and room for what is worked out of each.

    Attributes:
        rows: (n,) among all pairs.
        pairs: themselves.
        e: (n, 2) residuals.
        S: (n, 2, 2) their covariances.
        inside: (n,) bool, whether they lie within the gate.
        truth: (n,) probabilities of being true; 0 at first.
    """

    rows: np.ndarray
    pairs: PlanarPairs
    e: Float
    S: Float
    inside: np.ndarray
    truth: Float


@kernel
def near_pairs(T_a_b: Float, pairs: PlanarPairs, gate_m: float, inside: np.ndarray) -> NearPairs:
    """The pairs in reach under a motion, and those `inside` (N,) already, which stay so."""
    rows = rows_in_reach(T_a_b, pairs, gate_m, inside)
    n = len(rows)
    room = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty(n, np.bool_), np.zeros(n)
    near = NearPairs(rows, those_of(pairs, rows), room[0], room[1], room[2], room[3])
    for k in range(n):
        near.inside[k] = inside[rows[k]]
    return near


@inner_kernel
def at_rows(values: np.ndarray, rows: np.ndarray, among: np.ndarray) -> None:
    """Put values (n,) at rows (n,) of others (N,)."""
    for k in range(len(rows)):
        among[rows[k]] = values[k]


@kernel_part
def rows_in_reach(T_a_b: Float, pairs: PlanarPairs, gate_m: float, also: np.ndarray) -> np.ndarray:
    """Rows (n,) of pairs that lie within the gate or its margin, and of those marked (N,)."""
    p_a, p_b = pairs.p_a, pairs.p_b
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    rows, n, reach_m = np.empty(len(p_a), np.int64), 0, (1 + _MARGIN + _ROUNDING) * gate_m
    for i in range(len(p_a)):
        ex, ey = residual(T_a_b, cos, sin, p_a, p_b, i)
        if also[i] or ex * ex + ey * ey <= reach_m * reach_m:
            rows[n] = i
            n += 1
    return rows[:n]


@kernel_part
def those_of(pairs: PlanarPairs, rows: np.ndarray) -> PlanarPairs:
    """Some of the pairs, by their rows (n,)."""
    p_a, p_b, S_a, S_b = pairs
    n = len(rows)
    some = PlanarPairs(np.empty((n, 2)), np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 2, 2)))
    for m in range(n):
        i = rows[m]
        for k in range(2):
            some.p_a[m, k], some.p_b[m, k] = p_a[i, k], p_b[i, k]
            for j in range(2):
                some.S_a[m, k, j], some.S_b[m, k, j] = S_a[i, k, j], S_b[i, k, j]
    return some


@inner_kernel
def farthest_m(p: Float) -> float:
    """Distance from the origin of the farthest of points (N, 2)."""
    square = 0.0
    for i in range(len(p)):
        square = max(square, p[i, 0] * p[i, 0] + p[i, 1] * p[i, 1])
    return math.sqrt(square)


@kernel_part
def leaves_margin(T_a_b: Float, before: Float, gate_m: float, farthest_m: float) -> bool:
    """Whether two motions may lay a point no farther off than that apart by more than the margin.

    Pairs beyond the margin of a gate under the one may then lie within the gate under the other.
    """
    dx, dy, turned = T_a_b[0] - before[0], T_a_b[1] - before[1], abs(T_a_b[2] - before[2])
    return math.sqrt(dx * dx + dy * dy) + turned * farthest_m > _MARGIN * gate_m


@kernel_part
def mark_inside(e: Float, gate_m: float, inside: np.ndarray) -> None:
    """Mark which residuals (n, 2) lie within the gate."""
    for i in range(len(e)):
        inside[i] = e[i, 0] * e[i, 0] + e[i, 1] * e[i, 1] <= gate_m * gate_m
