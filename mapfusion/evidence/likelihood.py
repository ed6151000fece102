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


RIGHT = (BetaRate(12.4, 2.33), BetaRate(1.80, 2.88))
WRONG = (BetaRate(1.11, 14.8), BetaRate(0.88, 16.0))
CHANGED = 0.05
# Parts of a region: where no other motion lays it on its like, and where another does.
OWN, COPIED = 0, 1
# Decades by which a region is likelier as found if the motion is right than by chance, for counts
# and words: confirmed from so many on, contradicted from as many against it.
DECISIVE = 1.0


Rates = tuple[BetaRate, BetaRate]  # of what must be seen and of what may be


class TwinShares(NamedTuple):
    """Of what a wrong motion must find, the share that it lays on its like.

    Attributes:
        own: where no other motion lays it on its like.
        copied: where another does.
    """

    own: float
    copied: float


def log_likelihood(k: np.ndarray, n: np.ndarray, rates: Rates) -> Float:
    """Natural logarithm (...) of the beta-binomial probability of k of n (..., 2).

    But for the coefficients. Last axis: landmarks that must be seen, and those that may be.
    """
    by_class = [
        betaln(k[..., c] + rate.seen, n[..., c] - k[..., c] + rate.missed) - betaln(*rate)
        for c, rate in enumerate(rates)
    ]
    return np.sum(by_class, axis=0)


def log10_against_chance(k: np.ndarray, n: np.ndarray) -> Float:
    """log10 (...) of how much likelier k of n (..., 2) are under a right motion than by chance."""
    return (log_likelihood(k, n, RIGHT) - log_likelihood(k, n, WRONG)) / np.log(10.0)


def log10_ratio(k: np.ndarray, n: np.ndarray, shares: TwinShares) -> Float:
    """log10 (R,) of how much likelier each region is under a right motion than under a wrong one.

    Under a wrong one all of a region is its like, or what another motion, too, lays on its like, or
    nothing of it.

    Args:
        k: (R, 2, 2) landmarks that were found: OWN and COPIED, of those that must be seen
            and that may be.
        n: (R, 2, 2) landmarks that are looked for.
        shares: each above 0 and below 1.
    """
    right, chance = log_likelihood(k, n, RIGHT), log_likelihood(k, n, WRONG)
    whole = right.sum(axis=1)
    own, copied = (np.log([share, 1 - share]) for share in shares)
    copies = np.logaddexp(copied[0] + right[:, COPIED], copied[1] + chance[:, COPIED])
    wrong = np.logaddexp(own[0] + whole, own[1] + chance[:, OWN] + copies)
    changed = np.logaddexp(np.log1p(-CHANGED) + whole, np.log(CHANGED) + wrong)
    return (changed - wrong) / np.log(10.0)
