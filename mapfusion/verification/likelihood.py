"""Likelihood ratio of shared regions, and the probability that an alignment is right.

Of the n landmarks of a region that are looked for, k are found. If the motion is right, k is
beta-binomial: each region has a rate of its own, since light, slant and texture differ; it is high
where landmarks must be seen and middling where they may be. If it is wrong, a region is either the
twin of what is there (a poster, a room that repeats), and then no different, or the twin covers a
part of it, any share as likely as any other, or it is what chance leaves. What another motion lays
on its like is a twin much more often than the rest, and counts apart.

No motion is judged that nothing led to. A wrong one was found by a twin: that this region agrees is
no evidence for it, and no sample of how often wrong motions lay regions on their like.

Right means within 0.5 m and 0.1 rad. A logistic model whose coefficients are fitted over worlds, of
which some fool every test of support (`fitted.py`); what is more than chance has one.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import betaln, logsumexp

from mapfusion.geometry.numerics import Float
from mapfusion.verification import fitted_rates, fitted_twins
from mapfusion.verification.fitted import INTERCEPT, WEIGHTS


class BetaRate(NamedTuple):
    """A rate that varies from region to region: the beta distribution's two parameters."""

    seen: float
    missed: float

    @property
    def mean(self) -> float:
        """The mean rate."""
        return self.seen / (self.seen + self.missed)

    def in_part(self) -> "BetaRate":
        """This rate times a share that is any between 0 and 1: the beta of that mean and spread."""
        n = self.seen + self.missed
        mean, square = self.mean / 2, self.mean * (self.seen + 1) / (n + 1) / 3
        total = (mean - square) / (square - mean**2)
        return BetaRate(mean * total, (1 - mean) * total)


Rates = tuple[BetaRate, BetaRate]  # of what must be seen and of what may be
RIGHT: Rates = (BetaRate(*fitted_rates.RIGHT[0]), BetaRate(*fitted_rates.RIGHT[1]))
WRONG: Rates = (BetaRate(*fitted_rates.WRONG[0]), BetaRate(*fitted_rates.WRONG[1]))
# Of a region of which a twin covers a part: the edge of a poster, a wall that hangs elsewhere.
PART: Rates = (RIGHT[0].in_part(), RIGHT[1].in_part())
# Regions of a right alignment that are as a wrong one's: a picture that was moved, light that
# changed, a stretch in which one of the maps drifted. It bounds what one region can say against it.
# Of simulated worlds, in which nothing moves, the fit says a tenth of this: it is of the world, no
# map tells it. Less than one in ten (`most_against`): one region that is gone contradicts.
CHANGED = 0.05
# Parts of a region: where no other motion lays it on its like, and where another does.
OWN, COPIED = 0, 1
# Decades by which a region is likelier as found if the motion is right than by chance, for counts
# and words: confirmed from so many on, contradicted from as many against it. Ten to one is called
# strong evidence (Jeffreys 1961).
DECISIVE = 1.0


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
    nothing of it; of what is, `fitted_twins.WHOLE` is so throughout, the rest in part.

    Args:
        k: (R, 2, 2) landmarks that were found: OWN and COPIED, of those that must be seen
            and that may be.
        n: (R, 2, 2) landmarks that are looked for.
        shares: each above 0 and below 1.
    """
    right, part, chance = (log_likelihood(k, n, rates) for rates in (RIGHT, PART, WRONG))
    whole = right.sum(axis=1)
    own, copied = (np.log([share, 1 - share]) for share in shares)
    copies = _twin(right[:, COPIED], part[:, COPIED])
    copies = np.logaddexp(copied[0] + copies, copied[1] + chance[:, COPIED])
    twins = _twin(whole, part.sum(axis=1))
    wrong = np.logaddexp(own[0] + twins, own[1] + chance[:, OWN] + copies)
    changed = np.logaddexp(np.log1p(-CHANGED) + whole, np.log(CHANGED) + wrong)
    return (changed - wrong) / np.log(10.0)


def _twin(whole: Float, part: Float) -> Float:
    """Natural logarithm of the likelihood of twins, from those of whole ones and of parts."""
    return np.logaddexp(np.log(fitted_twins.WHOLE) + whole, np.log1p(-fitted_twins.WHOLE) + part)


def log10_without_discovery(log10_ratios: Float) -> float:
    """log10 of how much likelier regions (R,) are if right than if wrong and found by one of them.

    The one, whichever of them, is then as under a right motion: of ratios r_i it is
    prod_i r_i / mean_j r_j. 0 of none.
    """
    if not len(log10_ratios):
        return 0.0
    one = logsumexp(log10_ratios * np.log(10.0)) / np.log(10.0) - np.log10(len(log10_ratios))
    return float(np.sum(log10_ratios) - one)


# Decades: beyond them it is as sure as anything the model was fitted to.
_MOST_EVIDENCE, _LEAST_CHANCE = 3.0, 10.0
_CONTRADICTION = 3.0  # regions that confirm make good for one that contradicts
_FEW = 2.0  # regions: a share of so few is drawn to nothing
_MOST_EXTENT_M = 12.0  # of support: beyond a hall it is as good as anywhere


class EvidenceFeatures(NamedTuple):
    """What speaks for and against one alignment.

    Attributes:
        log10_false_alarms: of the test against chance; infinite where it has no answer.
        log10_evidence: of the regions.
        n_confirmed: regions that are seen again.
        n_contradicted: regions that are not.
        n_support: correspondences that support it.
        extent_m: the longer side of where its support lies.
        repeats: whether either map holds something twice.
        one_place: whether the maps show little else than the place that they share.
    """

    log10_false_alarms: float
    log10_evidence: float
    n_confirmed: int
    n_contradicted: int
    n_support: int
    extent_m: float
    repeats: bool
    one_place: bool

    def features(self) -> Float:
        """What the model weighs (7,)."""
        against = _CONTRADICTION * self.n_contradicted
        net = (self.n_confirmed - against) / (self.n_confirmed + against + _FEW)
        return np.array(
            [
                np.clip(-self.log10_false_alarms, 0.0, _LEAST_CHANCE),
                np.clip(self.log10_evidence, -_MOST_EVIDENCE, _MOST_EVIDENCE),
                net,
                # at one extent more of them are denser, as a copy of one picture is
                math.log10(self.n_support + 1),
                min(self.extent_m, _MOST_EXTENT_M),
                float(self.repeats),
                float(self.one_place),
            ]
        )


def probability_correct(signs: EvidenceFeatures) -> float:
    """That the alignment is right."""
    return float(1 / (1 + np.exp(-(INTERCEPT + signs.features() @ np.array(WEIGHTS)))))
