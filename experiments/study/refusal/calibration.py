"""The stated number of false alarms against the measured one, on made-up maps of walls.

All correspondences are false and independent: what the bound promises can be counted. Every motion
that two correspondences determine is judged, which is more than any estimator tries.
"""

import numpy as np
import pandas as pd

from mapfusion.align.acceptance import Acceptance
from mapfusion.align.false_alarms import IndependentPairs, fewest_false_alarms, independent_pairs
from mapfusion.align.rigid import fit_rigid
from mapfusion.kernels import kernel
from mapfusion.se2 import Float

N_PAIRS_OF_MAPS = 5000
N_CORRESPONDENCES = 40
SIZE_M = (13.0, 7.0)  # as quick.yaml's hall
N_WALLS = 8
STATED = (1e-3, 1e-2, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)


def points_on_walls(rng: np.random.Generator, n: int) -> Float:
    """Points (n, 2) on random walls parallel to the axes, wall against wall as rooms have them."""
    corners = rng.uniform(0, SIZE_M, (N_WALLS, 2))
    length_m = rng.uniform(1.0, 6.0, N_WALLS)
    along_x = rng.random(N_WALLS) < 0.5
    wall = rng.integers(N_WALLS, size=n)
    offset = rng.random(n) * length_m[wall]
    return corners[wall] + np.where(along_x[wall, None], [1.0, 0.0], [0.0, 1.0]) * offset[:, None]


def calibrate(acceptance: Acceptance, rng: np.random.Generator, n_pairs: int) -> pd.DataFrame:
    """Rows of the table `calibration`, of so many pairs of maps."""
    gates = np.array(sorted(acceptance.gates_m))
    bounds = np.log10(STATED)
    counts = np.zeros((n_pairs, len(STATED)), np.int64)
    for k in range(n_pairs):
        p_a, p_b = points_on_walls(rng, N_CORRESPONDENCES), points_on_walls(rng, N_CORRESPONDENCES)
        pairs = independent_pairs(p_a, p_b, np.zeros((N_CORRESPONDENCES, 4)))
        counts[k] = accepted_motions(pairs, gates, bounds)
    columns = {"stated": STATED, "motions_a_pair": counts.mean(axis=0)}
    columns |= {"n_accepted": np.count_nonzero(counts, axis=0), "n_pairs": n_pairs}
    return pd.DataFrame(columns)


@kernel
def accepted_motions(pairs: IndependentPairs, gates_m: Float, bounds_log10: Float) -> np.ndarray:
    """How many motions of two of the pairs have an NFA up to each bound (S,)."""
    p_a, p_b = pairs.p_a, pairs.p_b
    counts = np.zeros(len(bounds_log10), np.int64)
    T_a_b = np.empty(3)
    two = np.empty(2, np.int64)
    for j in range(len(p_a)):
        for i in range(j):
            two[0], two[1] = i, j
            T_a_b[0], T_a_b[1], T_a_b[2] = fit_rigid(p_a, p_b, two)
            log10, _, _, _ = fewest_false_alarms(pairs, T_a_b, gates_m)
            for s in range(len(bounds_log10)):
                counts[s] += log10 <= bounds_log10[s]
    return counts
