"""Bounds that a chi-square variable keeps with a given probability."""

import functools

from scipy.stats import chi2

_KEPT = 4096  # bounds at hand: a few probabilities, each for as many degrees of freedom as come up


@functools.lru_cache(maxsize=_KEPT)
def chi_square_bound(probability: float, degrees_of_freedom: int) -> float:
    """The value that a chi-square variable stays below with this probability.

    Gates ask for the same few at every call, and scipy takes 0.1 ms for one, as long as a fit.
    """
    return float(chi2.ppf(probability, degrees_of_freedom))
