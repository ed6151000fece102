"""The probability that an alignment is right, from the signs that its verdict rests on.

Right means within 0.5 m and 0.1 rad. A logistic model whose coefficients are fitted over worlds, of
which some fool every test of support (`fitted.py`); what is more than chance has one.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.evidence.fitted import INTERCEPT, WEIGHTS
from mapfusion.se2 import Float

# Decades: beyond them it is as sure as anything the model was fitted to.
_MOST_EVIDENCE, _LEAST_CHANCE = 3.0, 10.0
_CONTRADICTION = 3.0  # regions that confirm make good for one that contradicts
_FEW = 2.0  # regions: a share of so few is drawn to nothing
_MOST_EXTENT_M = 12.0  # of support: beyond a hall it is as good as anywhere


class Signs(NamedTuple):
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


def probability(signs: Signs) -> float:
    """That the alignment is right."""
    return float(1 / (1 + np.exp(-(INTERCEPT + signs.features() @ np.array(WEIGHTS)))))
