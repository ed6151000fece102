"""Bounds that a chi-square variable keeps with a given probability."""

from functools import cache


@cache  # a filter asks for its gate in every step
def chi_square_bound(probability: float, degrees_of_freedom: float) -> float:
    """The value that a chi-square variable stays below with this probability.

    Its distribution function is P(k / 2, x / 2), the regularised incomplete gamma function, whose
    inverse comes without scipy.stats: that alone takes half a second to import, in every worker.
    """
    # Here, so that a process without gates does not pay for it.
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(degrees_of_freedom / 2, probability))
