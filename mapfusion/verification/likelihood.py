"""Likelihood ratio of shared regions.

Of n landmarks of a region that are searched for, k are matched. Under a right motion k is
beta-binomial: the rate differs between regions with light, slant and texture, and is higher for
landmarks that must be seen than for those that may be seen. Under a wrong motion a region is one of
three kinds: a whole copy of the structure it is compared with (the same rates as under a right
motion), a copy of a part of it (a uniformly distributed share), or unrelated (the rates of chance).
Structure that another motion explains as well is a copy much more often, and has its own share.

A motion is only tested because some region led to it. Under a wrong motion this region is a copy;
it is therefore no evidence, and not a sample of the share of copies.
"""

from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.geometry.numerics import Float
from mapfusion.verification import fitted_rates, fitted_twins


class BetaRate(NamedTuple):
    """Beta distribution of a rate that differs between regions."""

    seen: float
    missed: float

    @property
    def mean(self) -> float:
        """Mean of the distribution."""
        return self.seen / (self.seen + self.missed)

    def with_mean(self, mean: float) -> "BetaRate":
        """Return the distribution with another mean and the same number of observations."""
        n = self.seen + self.missed
        return BetaRate(mean * n, (1 - mean) * n)

    def in_part(self) -> "BetaRate":
        """Return the beta distribution with the mean and variance of this rate times U(0, 1)."""
        n = self.seen + self.missed
        mean, square = self.mean / 2, self.mean * (self.seen + 1) / (n + 1) / 3
        total = (mean - square) / (square - mean**2)
        return BetaRate(mean * total, (1 - mean) * total)


Rates = tuple[BetaRate, BetaRate]  # of landmarks that must be seen, and that may be seen
RIGHT: Rates = (BetaRate(*fitted_rates.RIGHT[0]), BetaRate(*fitted_rates.RIGHT[1]))
WRONG: Rates = (BetaRate(*fitted_rates.WRONG[0]), BetaRate(*fitted_rates.WRONG[1]))


def rates_in_part(rates: Rates) -> Rates:
    """Return the rates of a region that is a copy in part, as at the edge of a repeated texture."""
    return rates[0].in_part(), rates[1].in_part()


# Probability that a region under a right motion looks as under a wrong one: a moved object, changed
# light, drift of one map. It limits the evidence of one region against a motion. It depends on the
# world and cannot be estimated from the maps. It is below 1 / `most_against`, so that one missing
# region is enough for a contradiction.
CHANGED = 0.05
# Parts of a region: structure that no other motion explains, and structure that another explains.
OWN, COPIED = 0, 1
# log10 likelihood ratio from which on a region counts as confirmed, or (negative) as contradicted.
# Ten to one is called strong evidence (Jeffreys 1961).
DECISIVE = 1.0


class TwinShares(NamedTuple):
    """Shares of regions that are copies under a wrong motion.

    Attributes:
        own: share in structure that no other motion explains.
        copied: share in structure that another motion explains.
    """

    own: float
    copied: float


def log_likelihood(k: np.ndarray, n: np.ndarray, rates: Rates) -> Float:
    """Return the log-likelihood of k of n under beta-binomial rates, shape (...).

    The binomial coefficients, which cancel in ratios, are left out. k and n have the shape
    (..., 2): landmarks that must be seen, and that may be seen.
    """
    by_class = [
        scipy.special.betaln(k[..., c] + rate.seen, n[..., c] - k[..., c] + rate.missed)
        - scipy.special.betaln(*rate)
        for c, rate in enumerate(rates)
    ]
    return np.sum(by_class, axis=0)


_ROUNDS = 5  # of expectation maximisation; the rates of a right motion converge in three


def rates_of_maps(k: np.ndarray, n: np.ndarray) -> Rates:
    """Estimate the rates of two maps under a motion, from k of n (R, 2) in R regions.

    Light, noise, resolution and the detector change the share of landmarks that a robot sees again,
    in all regions alike. Expectation maximisation (Dempster et al. 1977) of a mixture of regions
    with the rates of a right motion and with those of chance gives the means. The fitted means
    count as many landmarks as their beta distributions do, and are not exceeded. Half of them is
    the lower limit, below which all regions would look like partial copies. The rates differ
    between regions as much as the fitted ones.
    """
    rates = RIGHT
    for _ in range(_ROUNDS):
        log_right, log_wrong = log_likelihood(k, n, rates), log_likelihood(k, n, WRONG)
        weight = scipy.special.expit(log_right - log_wrong)
        n_found, n_searched = weight @ k, weight @ n
        means = [
            (prior_rate.seen + n_found[c]) / (prior_rate.seen + prior_rate.missed + n_searched[c])
            for c, prior_rate in enumerate(RIGHT)
        ]
        must, may = (
            prior_rate.with_mean(float(np.clip(mean, prior_rate.mean / 2, prior_rate.mean)))
            for prior_rate, mean in zip(RIGHT, means, strict=True)
        )
        rates = must, may
    return rates


def log10_against_chance(k: np.ndarray, n: np.ndarray, rates: Rates = RIGHT) -> Float:
    """Return the log10 likelihood ratio (...) of k of n (..., 2), right motion over chance."""
    return (log_likelihood(k, n, rates) - log_likelihood(k, n, WRONG)) / np.log(10.0)


def log10_ratio(k: np.ndarray, n: np.ndarray, shares: TwinShares, rates: Rates = RIGHT) -> Float:
    """Return the log10 likelihood ratio of each region, right over wrong motion, shape (R,).

    Under a wrong motion the whole region is a copy, or only its COPIED part is, or no part of it.
    A copy is complete with probability `fitted_twins.WHOLE`, otherwise partial.

    Args:
        k: matched landmarks, shape (R, 2, 2): OWN and COPIED, that must be seen and may be seen.
        n: landmarks that are searched for, shape (R, 2, 2).
        shares: shares of copies, each above 0 and below 1.
        rates: rates of a right motion; a copy has the same ones.
    """
    right, part, chance = (log_likelihood(k, n, r) for r in (rates, rates_in_part(rates), WRONG))
    log_right = right.sum(axis=1)
    log_share, log_copied = (np.log([share, 1 - share]) for share in shares)
    copies = _twin(right[:, COPIED], part[:, COPIED])
    copies = np.logaddexp(log_copied[0] + copies, log_copied[1] + chance[:, COPIED])
    twins = _twin(log_right, part.sum(axis=1))
    log_wrong = np.logaddexp(log_share[0] + twins, log_share[1] + chance[:, OWN] + copies)
    changed = np.logaddexp(np.log1p(-CHANGED) + log_right, np.log(CHANGED) + log_wrong)
    return (changed - log_wrong) / np.log(10.0)


def _twin(total: Float, part: Float) -> Float:
    """Return the log-likelihood of a copy, from those of a complete and of a partial copy."""
    return np.logaddexp(np.log(fitted_twins.WHOLE) + total, np.log1p(-fitted_twins.WHOLE) + part)


def log10_without_discovery(log10_ratios: Float) -> float:
    """Return the log10 likelihood ratio of regions (R,) without the one that led to the motion.

    Under a wrong motion this region, whichever it is, looks as under a right one, so that the ratio
    is prod_i r_i / mean_j r_j for the regions' ratios r_i. It is 0 without regions.
    """
    if not len(log10_ratios):
        return 0.0
    log10_mean = scipy.special.logsumexp(log10_ratios * np.log(10.0)) / np.log(10.0) - np.log10(
        len(log10_ratios)
    )
    return float(np.sum(log10_ratios) - log10_mean)
