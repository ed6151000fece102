"""The fitted share of whole twins: known shares are found, and what found a motion is left out."""

import numpy as np
import pytest

from experiments.studies.refusal.fit_twins import fit
from mapfusion.verification.likelihood import PART, RIGHT, WRONG
from mapfusion.verification.regions import Regions

SHARES = 0.15, 0.25, 0.6


def drawn(n: int, seed: int) -> list[Regions]:
    """Of n motions six regions each, all of one part, the first of which found the motion."""
    rng = np.random.default_rng(seed)
    motions = []
    for _ in range(n):
        found, expected = np.zeros((6, 2, 2), np.int64), np.zeros((6, 2, 2), np.int64)
        expected[:, 0] = rng.integers(10, 60, (6, 2))
        found[0, 0] = expected[0, 0] = 60
        for region in range(1, 6):
            kind = (RIGHT, PART, WRONG)[rng.choice(3, p=SHARES)]
            share = [rng.beta(*rate) for rate in kind]
            found[region, 0] = rng.binomial(expected[region, 0], share)
        motions.append(Regions(found, expected))
    return motions


def test_known_shares_are_found_without_the_regions_that_led_to_the_motions() -> None:
    assert fit(drawn(600, 0)) == pytest.approx(SHARES, abs=0.03)
