"""Maximum clique of pairwise consistent correspondences."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.consensus import Consensus
from mapfusion.align.consistency import consistency
from mapfusion.align.mahalanobis_gate import PlanarPairs, settle, settle_at_best_scale
from mapfusion.align.max_clique import greedy_clique, larger_clique
from mapfusion.align.method import Fit, Undetermined
from mapfusion.align.pairs import Pairs
from mapfusion.align.rigid import fit_rigid
from mapfusion.arguments import Probability, Range
from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float

_GREEDY_STARTS = 100  # a walk costs microseconds, and a large clique spares the search most


@dataclass(frozen=True)
class Clique(Consensus):
    """The largest set of correspondences of which any two agree.

    Two agree when their landmarks lie equally far apart in both maps, as far as covariances and
    s_drift can tell (PCM: Mangelson et al. 2018; TEASER++: Yang et al. 2021; CLIPPER: Lusk et al.
    2021). True pairs all agree; false ones rarely do by threes. Both with s_drift and without, a
    greedy clique is fitted and its support counted, then cliques larger than that are looked for.

    Attributes:
        agreement_probability: of two true pairs to agree (chi-square, 1 degree of freedom). Closer
            to 1 than `probability`, since a clique needs all its pairs to agree.
        max_nodes: of branch and bound at each s_drift; beyond them the largest clique found counts.
            Where most pairs are true the last vertices of a clique take many and change nothing.
    """

    randomised: ClassVar[bool] = False
    agreement_probability: Probability = 0.999
    max_nodes: Annotated[int, Range(1, 10_000_000, "nodes")] = 1000

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """T_a_b under which the residuals are likeliest; nothing is drawn from `rng`."""
        del rng
        planar = pairs.in_plan()
        return self.settled(self._likeliest(planar), pairs, planar)

    def _likeliest(self, pairs: PlanarPairs) -> Float:
        """T_a_b (3,) of the likeliest clique, NaN when no two correspondences agree."""
        agreement = chi_square_bound(self.agreement_probability, 1)
        scales = self.variances_m2[[0, -1]]
        best_T, best_log, inside = np.full(3, np.nan), -np.inf, np.empty(len(pairs.p_a), np.bool_)
        for variance, graph in zip(scales, consistency(pairs, scales, agreement), strict=True):
            support = 0
            for search in (_greedy, self._exact):
                clique = search(graph, support)
                if len(clique) < 2:
                    continue
                T_a_b = np.array(fit_rigid(pairs.p_a, pairs.p_b, clique))
                log, _ = settle_at_best_scale(T_a_b, pairs, self.variances_m2, self.bound, inside)
                if log > best_log:
                    best_T, best_log = T_a_b, log
                support = settle(best_T.copy(), pairs, variance, self.bound, inside)
                support = max(support, len(clique))
        return best_T

    def _exact(self, graph: np.ndarray, at_least: int) -> np.ndarray:
        return larger_clique(graph, at_least, self.max_nodes)[0]


def _greedy(graph: np.ndarray, at_least: int) -> np.ndarray:
    del at_least
    return greedy_clique(graph, _GREEDY_STARTS)
