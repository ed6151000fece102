import numpy as np
import pandas as pd
import pytest
import scipy.stats

from experiments.studies.intervals import (
    MAPS_OF_ONE_RUN,
    RUN,
    Clusters,
    WeightedMedian,
    clusters_of,
    percentile_interval,
    weighted_mean_interval,
)


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
    """How often the interval of a median holds the truth: 20 runs of 20 rows with a common part."""
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
