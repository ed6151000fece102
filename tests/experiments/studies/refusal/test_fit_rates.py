"""The fitted rates of regions: known ones are found, and the share that is as a wrong one."""

import numpy as np
import pytest

from experiments.studies.refusal.fit_rates import fit
from mapfusion.verification.likelihood import BetaRate, Rates

RIGHT = BetaRate(12.0, 2.5), BetaRate(1.8, 2.9)
WRONG = BetaRate(1.0, 15.0), BetaRate(0.9, 16.0)


def drawn(rates: Rates, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    expected = rng.integers(5, 60, (n, 2))
    share = np.stack([rng.beta(*rate, n) for rate in rates], axis=1)
    return rng.binomial(expected, share), expected


def test_known_rates_are_found_though_some_regions_have_changed() -> None:
    right, changed, wrong = drawn(RIGHT, 3800, 0), drawn(WRONG, 200, 1), drawn(WRONG, 4000, 2)
    mixed = (np.concatenate([right[0], changed[0]]), np.concatenate([right[1], changed[1]]))
    of_right, of_wrong, share = fit(mixed, wrong)
    for found, true in zip((*of_right, *of_wrong), (*RIGHT, *WRONG), strict=True):
        assert found.mean == pytest.approx(true.mean, rel=0.06)
        assert sum(found) == pytest.approx(sum(true), rel=0.2)
    assert share == pytest.approx(0.05, abs=0.01)
