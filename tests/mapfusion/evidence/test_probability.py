"""The probability that an alignment is right: monotone in each sign, and of the verdict."""

import numpy as np
import pytest

from mapfusion.verification import likelihood as model
from mapfusion.verification.likelihood import Signs, probability

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


@pytest.mark.parametrize(
    ("n_confirmed", "n_contradicted", "net"),
    [
        (0, 0, 0.0),
        (3, 1, 0.0),  # three regions that confirm make good for one that contradicts
        (6, 2, 0.0),
        (2, 0, 1 / 2),  # two regions more count as undecided
        (8, 0, 4 / 5),
        (0, 1, -3 / 5),
        (9, 1, 3 / 7),
    ],
)
def test_a_contradiction_weighs_as_much_as_three_confirmations(
    n_confirmed: int, n_contradicted: int, net: float
) -> None:
    signs = FAIR._replace(n_confirmed=n_confirmed, n_contradicted=n_contradicted)
    assert signs.features()[2] == pytest.approx(net, abs=1e-15)


@pytest.mark.parametrize(("n_support", "decades"), [(0, 0.0), (9, 1.0), (99, 2.0)])
def test_support_counts_by_its_decades(n_support: int, decades: float) -> None:
    assert FAIR._replace(n_support=n_support).features()[3] == pytest.approx(decades)


def test_coefficients_belong_to_their_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one coefficient set, the log odds are this coefficient times its feature."""
    signs = FAIR._replace(log10_false_alarms=-4.0, extent_m=7.0, n_contradicted=1, repeats=True)
    expected = [4.0, 1.0, 1 / 9, np.log10(51), 7.0, 1.0, 0.0]
    monkeypatch.setattr(model, "INTERCEPT", -0.25)
    for k, feature in enumerate(expected):
        monkeypatch.setattr(model, "WEIGHTS", tuple(0.5 * (i == k) for i in range(7)))
        p = probability(signs)
        assert np.log(p / (1 - p)) == pytest.approx(0.5 * feature - 0.25)
