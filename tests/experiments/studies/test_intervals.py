import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from experiments.studies.intervals import CONFIDENCE, effective_trials, wilson


@given(n=st.integers(1, 5000), share=st.floats(0, 1))
def test_wilson_equals_scipys(n: int, share: float) -> None:
    k = round(share * n)
    expected = binomtest(k, n).proportion_ci(CONFIDENCE, method="wilson")
    assert wilson(k, n) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_nothing_tried_nothing_known_and_ends_are_exact() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    low, high = wilson([0, 10], [10, 10])
    assert low[0] == 0.0
    assert high[1] == 1.0


@pytest.mark.parametrize(("k", "n"), [(-1, 5), (6, 5)])
def test_impossible_counts_are_refused(k: int, n: int) -> None:
    with pytest.raises(ValueError, match="must lie"):
        wilson(k, n)


def test_effective_trials() -> None:
    assert effective_trials([7, 7, 7]) == pytest.approx(3)
    assert effective_trials([100, 1e-9]) == pytest.approx(1)
    assert effective_trials([]) == 0


@pytest.mark.parametrize("shared", [0.0, 0.5, 1.0])
def test_coverage_of_dependent_rows_is_never_below_the_level(shared: float) -> None:
    """Runs of unequal length whose rows share one fate with some probability."""
    rng = np.random.default_rng(3)
    truth, sizes, trials = 0.9, np.array([5, 20, 40, 40, 10, 20, 30, 30, 40, 25] * 2), 2000
    inside = 0
    for _ in range(trials):
        fate = np.repeat(rng.uniform(size=len(sizes)), sizes)
        alone = rng.uniform(size=sizes.sum())
        success = np.where(rng.uniform(size=len(fate)) < shared, fate, alone) < truth
        n = effective_trials(sizes)
        low, high = wilson(success.mean() * n, n)
        inside += low <= truth <= high
    # 2000 trials at 95 %: standard deviation 0.5 %; the score interval itself wavers by 2 %
    assert inside / trials > 0.93


def test_taking_all_rows_for_independent_would_claim_far_too_much() -> None:
    rng = np.random.default_rng(4)
    inside = 0
    for _ in range(500):
        rate = (rng.uniform(size=20) < 0.9).mean()  # each run's 50 rows share one fate
        low, high = wilson(rate * 1000, 1000)
        inside += low <= 0.9 <= high
    assert inside / 500 < 0.5
