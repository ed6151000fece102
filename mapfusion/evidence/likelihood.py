"""How much more likely regions are seen again as they were if a motion is right than if it is not.

Of the n landmarks of a region that must be seen, k are. If the motion is right, k is beta-binomial:
each region has a rate of its own, since light, slant and texture differ. If it is wrong, a region
is either the twin of what is there (a poster, a room that repeats), and then no different, or what
chance leaves.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import betaln

from mapfusion.se2 import Float


class BetaRate(NamedTuple):
    """A rate that varies from region to region: the beta distribution's two parameters."""

    seen: float
    missed: float

    @property
    def mean(self) -> float:
        """The mean rate."""
        return self.seen / (self.seen + self.missed)


# The likeliest for the regions of right alignments in the suite's worlds.
RIGHT = BetaRate(10.0, 1.74)
# Of wrong ones, chosen: one landmark in ten is met by another of its look, seldom half of them.
WRONG = BetaRate(0.55, 5.0)
# Regions of a right alignment that are as a wrong one's: a picture that was moved, light that
# changed, a stretch in which one of the maps drifted. It bounds what one region can say against it.
CHANGED = 0.05
SHARE_CONFIRMED, SHARE_CONTRADICTED = 0.55, 0.30  # of what must be seen there, for words and counts


def log_likelihood(k: np.ndarray, n: np.ndarray, rate: BetaRate) -> Float:
    """Natural logarithm of the beta-binomial probability of k of n, but for the coefficient."""
    return betaln(k + rate.seen, n - k + rate.missed) - betaln(rate.seen, rate.missed)


def log10_ratio(k: np.ndarray, n: np.ndarray, twin_share: float) -> Float:
    """log10 (R,) of how much likelier each region is under a right motion than under a wrong one.

    Args:
        k: (R,) landmarks that were found.
        n: (R,) landmarks that must be there.
        twin_share: of the regions that a wrong motion lays on their like, above 0 and below 1.
    """
    right, chance = log_likelihood(k, n, RIGHT), log_likelihood(k, n, WRONG)
    wrong = np.logaddexp(np.log(twin_share) + right, np.log1p(-twin_share) + chance)
    changed = np.logaddexp(np.log1p(-CHANGED) + right, np.log(CHANGED) + wrong)
    return (changed - wrong) / np.log(10.0)
