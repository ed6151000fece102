"""RANSAC with a gate from the landmarks' covariances."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.alignment import Pairs
from mapfusion.align.consensus import Consensus, drift_needed, packed_rows, pair_spread
from mapfusion.align.mahalanobis_gate import PlanarPairs, mark_supporters, refit_to_support
from mapfusion.align.method import Fit, Undetermined
from mapfusion.align.ransac import draw_pair
from mapfusion.align.rigid_motion import fit_two
from mapfusion.geometry.numerics import Float, chi_square_bound, kernel
from mapfusion.parameters import Probability, Range


@dataclass(frozen=True)
class RansacMahalanobis(Consensus):
    """Motion of a random minimal set with the smallest sum of truncated squared residuals.

    A pair supports a motion if e^T (S_a + R S_b R^T + s_drift^2 I)^-1 e is below a chi-square
    quantile, so that the gate is narrow for precise landmarks. Motions are compared by the
    truncated cost (MSAC: Torr and Zisserman 2000), since a count would prefer many loose supporters
    to fewer exact ones.

    Attributes:
        min_baseline_m: smallest distance within a minimal set; at 1 m an error of 0.1 m turns the
            map by 6 degrees.
        confidence: probability that at least one set of two supporters of the result was drawn.
        max_draws: largest number of minimal sets.
    """

    randomised: ClassVar[bool] = True
    min_baseline_m: Annotated[float, Range(1e-3, 1000, "m")] = 1.0
    confidence: Probability = 0.9999
    max_draws: Annotated[int, Range(1, 100_000_000, "draws")] = 100_000

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Estimate T_a_b with the largest s_drift, and refit to the support."""
        planar = pairs.in_plan()
        if RansacMahalanobis not in pairs.kept:
            pairs.kept[RansacMahalanobis] = packed_rows(planar)
        _, T_a_b = least_truncated_squares(
            planar,
            pair_spread(pairs).own_m2,
            pairs.kept[RansacMahalanobis],
            self.variances_m2[-1],
            self.bound,
            chi_square_bound(self.probability, 1),
            self.min_baseline_m,
            math.log1p(-self.confidence),
            self.max_draws,
            rng.integers(1, 2**64, dtype=np.uint64),
        )
        return self.refitted(T_a_b, pairs, planar)


@kernel
def least_truncated_squares(
    pairs: PlanarPairs,
    own_m2: Float,
    rows: Float,
    variance_m2: float,
    bound: float,
    agreement: float,
    min_baseline_m: float,
    log_miss: float,
    max_draws: int,
    seed: np.uint64,
) -> tuple[int, Float]:
    """Draw minimal sets until two supporters of the best motion were drawn with the confidence.

    Args:
        pairs: N correspondences.
        own_m2: `mean_variances` without s_drift, shape (N,).
        rows: the pairs as `packed_rows`.
        variance_m2: s_drift^2.
        bound: largest e^T C^-1 e of a supporter.
        agreement: largest squared difference of the two lengths of a set over its variance.
        min_baseline_m: smallest distance within a minimal set.
        log_miss: logarithm of the accepted probability of drawing no two supporters.
        max_draws: largest number of draws.
        seed: state of the generator, not 0.

    Returns:
        Number of draws and T_a_b (3,), NaN without a motion.
    """
    p_a, p_b = pairs.p_a, pairs.p_b
    n = len(p_a)
    best_T, T_a_b, inside = np.full(3, np.nan), np.empty(3), np.empty(n, np.bool_)
    best_score, best_raw = 0.0, 0.0
    needed, draws, state = float(max_draws), 0, seed
    while draws < needed:
        draws += 1
        state, i, j = draw_pair(state, n)
        if drift_needed(rows, i, j, agreement) > variance_m2:
            continue
        if fit_two(p_a, p_b, i, j, T_a_b) < min_baseline_m:
            continue
        count, score = mark_supporters(T_a_b, pairs, own_m2, variance_m2, bound, inside)
        if count < 2 or score <= best_raw:
            continue
        best_raw = score
        count = refit_to_support(T_a_b, pairs, own_m2, variance_m2, bound, inside)
        count, score = mark_supporters(T_a_b, pairs, own_m2, variance_m2, bound, inside)
        if count >= 2 and score > best_score:
            for k in range(3):
                best_T[k] = T_a_b[k]
            best_score = score
            hit = count * (count - 1) / (n * (n - 1))
            needed = min(needed, log_miss / math.log1p(-hit)) if hit < 1 else 0.0
    return draws, best_T
