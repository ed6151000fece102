"""The probability that an alignment is right: monotone in each sign, and of the verdict."""

import numpy as np
import pytest

from mapfusion.evidence.probability import Signs, probability

FAIR = Signs(-20.0, 1.0, 4, 0, 50, 8.0, repeats=False, one_place=False)


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ({"log10_evidence": 2.5}, {"log10_evidence": -1.0}),
        ({}, {"log10_false_alarms": -3.5}),
        ({"n_confirmed": 9}, {"n_contradicted": 2}),
        ({"extent_m": 11.0}, {"extent_m": 1.0}),
        ({}, {"one_place": True}),
        ({}, {"repeats": True}),
    ],
)
def test_it_grows_with_what_speaks_for_it(better: dict, worse: dict) -> None:
    high, low = (probability(FAIR._replace(**signs)) for signs in (better, worse))
    assert 0 < low < high < 1


def test_the_features_are_bounded_so_that_nothing_is_certain() -> None:
    most = Signs(-1e9, 1e9, 10**6, 0, 10**6, 1e9, repeats=False, one_place=False)
    assert probability(most) < 1
    assert np.isfinite(most.features()).all()
    np.testing.assert_allclose(most.features()[[0, 1, 4]], [10.0, 3.0, 12.0])
