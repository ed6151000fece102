"""Tests of confidence intervals and of the test of a difference."""

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from experiments.studies.intervals import (
    CONFIDENCE,
    MAPS_OF_ONE_RUN,
    RUN,
    Clusters,
    WeightedMedian,
    change_of_each_run,
    clusters_of,
    effective_trials,
    holm,
    log_ratio,
    mean_change,
    percentile_interval,
    signed_rank,
    weighted_mean_interval,
    wilson,
)


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


def test_weighted_median_is_the_median_of_repeated_rows() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        values = np.round(rng.normal(size=12), 1)
        values[rng.uniform(size=12) < 0.1] = np.nan
        codes = rng.integers(0, 5, 12)
        counts = rng.integers(0, 4, 5)
        repeated = np.repeat(values, counts[codes])
        repeated = repeated[~np.isnan(repeated)]
        expected = np.median(repeated) if len(repeated) else np.nan
        np.testing.assert_allclose(WeightedMedian(values, codes)(counts[None]), [expected])


def test_weighted_median_counts_missing_answers_as_infinitely_far() -> None:
    one_each = WeightedMedian(np.array([1.0, np.inf, np.inf, 2.0, 3.0]), np.arange(5))
    counts = np.array([[1, 1, 1, 1, 1], [1, 1, 1, 1, 0], [1, 1, 1, 0, 0], [0, 0, 0, 0, 0]])
    # between 2 and infinity: the lower
    np.testing.assert_array_equal(one_each(counts), [3.0, 2.0, np.inf, np.nan])


def test_weighted_medians_are_the_same_in_however_many_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(9)
    median = WeightedMedian(rng.normal(size=50), rng.integers(0, 10, 50))
    counts = rng.multinomial(10, np.full(10, 0.1), size=40)
    whole = median(counts)
    monkeypatch.setattr("experiments.studies.intervals._MAX_CELLS", 60)
    np.testing.assert_array_equal(median(counts), whole)


def test_percentile_interval_agrees_with_scipys_where_clusters_are_rows() -> None:
    values = np.random.default_rng(1).exponential(size=40)
    ours = percentile_interval(
        WeightedMedian(values, np.arange(40)), 40, np.random.default_rng(2), resamples=20_000
    )
    theirs = scipy.stats.bootstrap(
        (values,), np.median, method="percentile", n_resamples=20_000, rng=np.random.default_rng(3)
    ).confidence_interval
    assert ours.value == np.median(values)
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), rel=0.05)


def coverage(resample_runs: bool, trials: int) -> float:
    """Return the coverage of the interval of a median: 20 runs of 20 rows with a common part."""
    rng = np.random.default_rng(5)
    inside = 0
    for _ in range(trials):
        codes = np.repeat(np.arange(20), 20)
        values = rng.normal(size=20)[codes] + 0.3 * rng.normal(size=400)
        clusters = codes if resample_runs else np.arange(400)
        median = WeightedMedian(values, clusters)
        _, low, high = percentile_interval(median, clusters.max() + 1, rng, resamples=200)
        inside += low <= 0 <= high
    return inside / trials


def test_resampling_runs_covers_and_resampling_rows_does_not() -> None:
    # at 95 %: standard deviation 1.5 %; with 20 clusters a percentile falls a bit short
    assert coverage(resample_runs=True, trials=200) > 0.89
    # some 40 %: standard deviation 6 %
    assert coverage(resample_runs=False, trials=60) < 0.6


def test_weighted_mean_is_of_rows_in_resampled_clusters() -> None:
    rng = np.random.default_rng(6)
    values, weights = rng.normal(size=60), rng.uniform(size=60)
    runs = Clusters(np.repeat(np.arange(6), 10), 6, RUN)
    found = weighted_mean_interval(values, weights, runs, np.random.default_rng(8))
    assert found.value == pytest.approx(np.average(values, weights=weights))
    assert found.low < found.value < found.high
    again = weighted_mean_interval(values, weights, runs, np.random.default_rng(8))
    assert again == found  # the same generator, the same interval
    assert found.columns("x") == {"x": found[0], "x_low": found[1], "x_high": found[2]}
    alone = weighted_mean_interval(values, weights, Clusters(np.zeros(60, int), 1, RUN), rng)
    assert np.isnan([alone.low, alone.high]).all()


def test_clusters_are_runs_or_the_maps_of_a_single_one() -> None:
    frame = pd.DataFrame(
        {
            "run_id": ["x", "x", "y", "y"],
            "robot_a": "A",
            "robot_b": "B",
            "iteration": [0, 5, 0, 0],
        }
    )
    assert clusters_of(frame).unit == RUN
    assert clusters_of(frame).codes.tolist() == [0, 0, 1, 1]
    single = clusters_of(frame[frame["run_id"] == "x"])
    assert (single.n, single.unit) == (2, MAPS_OF_ONE_RUN)
    assert clusters_of(frame[["run_id"]][:2]).unit == RUN
    assert clusters_of(frame[:0]).n == 0


def test_ratios_of_equals_are_none_whatever_they_are() -> None:
    over, under = (
        np.array([2.0, 0.0, np.inf, np.inf, 1.0]),
        np.array([1.0, 0.0, np.inf, 1.0, np.inf]),
    )
    expected = [np.log(2), 0.0, 0.0, np.inf, -np.inf]
    np.testing.assert_array_equal(log_ratio(over, under), expected)


def test_students_t_worked_out_by_hand() -> None:
    """1, 2 and 3: t = 2 sqrt(3) with 2 degrees of freedom, whose 97.5 % quantile is 4.3027."""
    found = mean_change(np.array([1.0, 2.0, 3.0]))
    half = 4.3027 / np.sqrt(3)
    assert found == pytest.approx((2.0, 2 - half, 2 + half, 0.0742), abs=1e-4)


def test_without_an_estimate_an_error_is_a_thousand_times_larger() -> None:
    found = mean_change(np.array([np.inf, 0.0]))
    assert found.change == pytest.approx(np.log(1000) / 2)
    assert np.isfinite(found).all()


@pytest.mark.parametrize(
    ("changes", "p"), [([0.5] * 6, 1 / 32), ([0.0] * 6, np.nan), ([0.5], np.nan), ([], np.nan)]
)
def test_changes_that_do_not_vary(changes: list[float], p: float) -> None:
    assert mean_change(np.array(changes)).p == pytest.approx(p, nan_ok=True)


def test_holms_rule_worked_out_by_hand() -> None:
    """0.01 x 3, 0.03 x 2, and 0.04 x 1 raised to the one before; what is no test does not count."""
    np.testing.assert_allclose(
        holm(np.array([0.01, 0.04, np.nan, 0.03])), [0.03, 0.06, np.nan, 0.06]
    )


def test_a_run_has_one_change_and_a_single_run_those_of_its_maps() -> None:
    changes, runs = np.array([1.0, 2.0, 9.0, 5.0]), ["x", "x", "x", "y"]
    assert change_of_each_run(changes, runs, 2).tolist() == [2.0, 5.0]
    assert change_of_each_run(changes, runs, 2, mean=True).tolist() == [4.0, 5.0]
    assert change_of_each_run(changes, ["x"] * 4, 1).tolist() == changes.tolist()


def test_signed_ranks_hold_with_infinite_changes() -> None:
    """Each of n changes of one sign: p of the sign test; and infinite ones do not hide the rest."""
    same = np.log(np.linspace(1.1, 1.6, 10))
    assert signed_rank(same) == pytest.approx(2 / 2**10)
    assert signed_rank(np.r_[same, np.inf]) == pytest.approx(2 / 2**11)
    assert signed_rank(np.r_[same, -same]) > 0.9
    assert np.isnan(signed_rank(np.zeros(5)))
    assert np.isnan(signed_rank(np.ones(1)))
