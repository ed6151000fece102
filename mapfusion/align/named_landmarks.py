"""The test against chance for landmarks whose identities are known.

No correspondence can be false then. What chance could do is lay k of n named landmarks on their
namesakes by geometry alone: under a motion that is wrong, as of a map that is distorted, each of
them lies anywhere on the ground that the landmarks span, and so within r of its namesake with the
probability p = pi r^2 / A. A motion that two of them determine finds k - 2 supporters among the
others with the binomial's tail B(k - 2; n - 2, p); it is one motion however many pairs of its
supporters determine it, so that of all n (n - 1) / 2 pairs

    NFA = gates * n (n - 1) / (k (k - 1)) * B(k - 2; n - 2, p).

Three of three that agree to a decimetre on 100 m^2 are evidence. So are nine of nine that agree to
0.7 m, as in maps whose paths bend: a gate twice the widest for unnamed landmarks is tried as well.
"""

import math

import numpy as np

from mapfusion.align.false_alarms import log10_tail, residuals_m
from mapfusion.align.pairs import MIN_PAIRS
from mapfusion.se2 import Float

# Times the widest gate: the next of gates that double. Either map may be bent by what the widest
# allows for both; and what a gate more costs is counted, as chance has one more to try.
_BENT = 2.0


def named_false_alarms(
    p_a: Float, p_b: Float, T_a_b: Float, gates_m: Float
) -> tuple[float, float, int, int]:
    """log10 of the smallest NFA over the gates, and the gate, number and supporters behind it.

    Args:
        p_a: (N, 2) positions in metres, in frame a.
        p_b: (N, 2) of their namesakes, in frame b.
        T_a_b: (3,).
        gates_m: (G,) ascending.

    Returns:
        Infinite, the widest gate, N and the supporters within it where these are too few.
    """
    gates_m = np.append(gates_m, _BENT * gates_m[-1])
    n, distance = len(p_a), residuals_m(T_a_b, p_a, p_b)
    best = math.inf, float(gates_m[-1]), n, int(np.sum(distance <= gates_m[-1]))
    for gate_m in gates_m:
        k = int(np.sum(distance <= gate_m))
        if k < MIN_PAIRS:
            continue
        width, depth = np.ptp(p_a, axis=0) + 2 * gate_m
        p = min(math.pi * gate_m**2 / (width * depth), 1.0)
        motions = n * (n - 1) / (k * (k - 1))
        log10 = math.log10(len(gates_m) * motions) + log10_tail(k - 2, n - 2, p)
        if log10 < best[0]:
            best = log10, float(gate_m), n, k
    return best
