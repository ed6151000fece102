"""Error over the oracle, methods on the same maps, bands."""

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from experiments.evaluation.criteria import RICH_PAIRS, summarise_alignments
from experiments.evaluation.metrics import compute
from experiments.studies.intervals import (
    change_of_each_run,
    clusters_of,
    holm,
    mean_change,
    median_interval,
)
from experiments.studies.method_comparison import compare_methods, oracle_ratios
from experiments.studies.statistics import (
    BAND,
    error_bands,
    medians_of_run,
    scarce_spans,
    time_bands,
)
from tests.helpers.made_up_runs import many_errors


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def rich(errors: pd.DataFrame) -> pd.DataFrame:
    return errors.assign(n_true=50)


def test_ratio_over_the_oracle_agrees_with_the_checks_metric() -> None:
    errors = rich(many_errors(10))
    errors.loc[errors.index[::7], "translation_error_m"] = np.nan
    table = oracle_ratios(summarise_alignments(errors), rng()).set_index("aligner")
    for aligner in ("ransac", "icp"):
        row = table.loc[aligner]
        for stage in ("refined", "estimated"):
            expected = compute(f"{aligner}.{stage}_over_oracle", {"errors": errors})
            assert row[f"{stage}_ratio"] == pytest.approx(expected)
            assert row[f"{stage}_ratio_low"] <= expected <= row[f"{stage}_ratio_high"]
    assert table.loc["oracle", "refined_ratio_low"] == 1
    assert table.loc["oracle", "refined_ratio_high"] == 1


def test_ratio_resamples_method_and_oracle_together() -> None:
    """A drift that differs from run to run, and is common to both, cancels in the ratio."""
    errors = rich(many_errors(10, methods={"exact": (1.3, 0.0, 0.0)}))
    row = oracle_ratios(summarise_alignments(errors), rng()).set_index("aligner").loc["exact"]
    assert row["estimated_ratio"] == pytest.approx(1.3)
    assert row["estimated_ratio_high"] - row["estimated_ratio_low"] == pytest.approx(0, abs=1e-9)


def test_scarce_maps_are_left_out() -> None:
    errors = many_errors(3)
    table = oracle_ratios(summarise_alignments(errors), rng())
    maps = errors[errors["n_true"] >= RICH_PAIRS]
    keys = ["run_id", "robot_a", "robot_b", "iteration"]
    assert (table["n_maps"] == maps.groupby(keys).ngroups).all()


def test_methods_on_the_same_maps() -> None:
    errors = rich(many_errors(12))
    table = compare_methods(summarise_alignments(errors), rng())
    assert table[["first", "second"]].to_numpy().tolist() == [["ransac", "icp"]]
    row = table.iloc[0]
    wide = errors.pivot_table(
        "translation_error_m",
        ["run_id", "robot_a", "robot_b", "iteration"],
        "aligner",
        aggfunc="median",
    )
    ratio = np.log(wide["ransac"] / wide["icp"])
    assert row["ratio"] == pytest.approx(np.exp(ratio.median()))
    assert row["ratio_low"] < row["ratio"] < row["ratio_high"] < 1
    assert row["first_wins"] == pytest.approx(np.mean(ratio < 0) + np.mean(ratio == 0) / 2)
    per_run = ratio.groupby("run_id").median()
    expected = scipy.stats.ttest_1samp(per_run, 0)
    assert row["p"] == pytest.approx(expected[1])
    assert row["n_runs"] == 12


def test_a_method_without_answer_loses_and_two_draw() -> None:
    errors = rich(many_errors(4))
    errors.loc[errors["aligner"] == "ransac", "translation_error_m"] = np.nan
    row = compare_methods(summarise_alignments(errors), rng()).iloc[0]
    assert (row["ratio"], row["first_wins"]) == (np.inf, 0)
    errors["translation_error_m"] = np.nan
    row = compare_methods(summarise_alignments(errors), rng()).iloc[0]
    assert (row["ratio"], row["first_wins"]) == (1, 0.5)
    assert np.isnan(row["p"])


def test_one_run_has_no_test_and_one_method_no_other() -> None:
    row = compare_methods(summarise_alignments(rich(many_errors(1))), rng()).iloc[0]
    assert np.isnan(row["p"])
    assert np.isnan(row["p_holm"])
    alone = rich(many_errors(2, methods={"svd": (1.0, 0.1, 0.0)}))
    assert compare_methods(summarise_alignments(alone), rng()).empty


def test_same_rows_same_table_whatever_their_order() -> None:
    maps = summarise_alignments(rich(many_errors(5)))
    again = compare_methods(maps, rng())
    pd.testing.assert_frame_equal(compare_methods(maps, rng()), again)


def test_holm_against_the_definition() -> None:
    """Reject the k-th smallest p only if all smaller ones are, at level / (m - k)."""
    generator = np.random.default_rng(2)
    for _ in range(100):
        p = generator.uniform(0, 0.2, 7)
        for level in (0.05, 0.2):
            rejected = np.zeros(7, bool)
            for k, place in enumerate(np.argsort(p)):
                if p[place] > level / (7 - k):
                    break
                rejected[place] = True
            np.testing.assert_array_equal(holm(p) <= level, rejected)
    np.testing.assert_array_equal(holm(np.array([0.01, np.nan, 0.5])), [0.02, np.nan, 0.5])


def test_the_test_is_students_and_its_interval_agrees_with_it() -> None:
    generator = np.random.default_rng(6)
    for n in (2, 6, 30):
        changes = generator.normal(0.4, 1, n)
        found = mean_change(changes)
        t = changes.mean() / (changes.std(ddof=1) / np.sqrt(n))
        assert found.p == pytest.approx(2 * scipy.stats.t.sf(abs(t), n - 1))
        half = scipy.stats.t.ppf(0.975, n - 1) * changes.std(ddof=1) / np.sqrt(n)
        ends = (changes.mean() - half, changes.mean() + half)
        assert (found.change, found.low, found.high) == pytest.approx((changes.mean(), *ends))
        assert (found.p < 0.05) == (found.low > 0 or found.high < 0)


def test_the_interval_covers_a_mean_of_changes() -> None:
    generator = np.random.default_rng(6)
    runs = generator.normal(size=(400, 6))
    inside = [found.low <= 0 <= found.high for found in map(mean_change, runs)]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.03)
    skewed = generator.exponential(size=(400, 25))
    inside = [found.low <= 1 <= found.high for found in map(mean_change, skewed)]
    assert np.mean(inside) > 0.88  # known to fall short of 95 % by a few percent at 25 values


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([], (np.nan,) * 4),
        ([2.0], (2.0, np.nan, np.nan, np.nan)),
        ([0.0] * 9, (0.0, 0.0, 0.0, np.nan)),  # nothing changed: no test
        ([3.0] * 9, (3.0, 3.0, 3.0, 2.0**-8)),  # all signs agree
        ([-np.inf] * 12, (-np.log(1e3),) * 3 + (2.0**-11,)),  # no estimate: very far off
    ],
)
def test_changes_that_do_not_scatter(changes: list[float], expected: tuple) -> None:
    np.testing.assert_allclose(mean_change(np.array(changes)), expected)


def test_each_run_is_one_change() -> None:
    changes, runs = np.array([1.0, 2.0, 9.0, -np.inf, 3.0]), np.array(list("aaabb"))
    assert change_of_each_run(changes, runs, 2).tolist() == [2.0, -np.inf]
    assert change_of_each_run(changes[:3], runs[:3], 2, mean=True).tolist() == [4.0]
    assert change_of_each_run(changes[:3], runs[:3], 1).tolist() == [1.0, 2.0, 9.0]


def test_bands_are_quantiles_over_runs() -> None:
    errors = many_errors(9)
    bands = error_bands(pd.concat(medians_of_run(own) for _, own in errors.groupby("run_id")))
    keys = ["robot_a", "robot_b", "aligner", "iteration"]
    for row in bands.sample(10, random_state=0).to_dict("records"):
        own = errors[np.all([errors[key] == row[key] for key in keys], axis=0)]
        medians = own.groupby("run_id")["rotation_error_rad"].median()
        assert row["rotation_error_rad"] == pytest.approx(medians.median())
        assert row["rotation_error_rad_low"] == pytest.approx(medians.quantile(BAND[0]))
        assert row["n_runs"] == 9


def test_bands_over_repetitions_and_over_all_pairs() -> None:
    errors = many_errors(1, repetitions=9).drop(columns=["run_id", "scenario", "seed"])
    own = errors[(errors["aligner"] == "icp") & (errors["iteration"] == 50)]
    bands = error_bands(errors, by=(), absolute=True).set_index(["aligner", "iteration"])
    row = bands.loc[("icp", 50)]
    assert row["rotation_error_rad"] == pytest.approx(own["rotation_error_rad"].abs().median())
    high = own["rotation_error_rad"].abs().quantile(BAND[1])
    assert row["rotation_error_rad_high"] == pytest.approx(high)
    assert "n_runs" not in bands


def test_scarce_spans_reach_half_way_to_the_next_iteration() -> None:
    rows = pd.DataFrame({"iteration": [0, 10, 20, 30, 50], "n_true": [0, 2, 3, 9, 2]})
    rows = rows.assign(robot_a="A", robot_b="B")
    assert scarce_spans(rows) == [(-5, 15), (40, 60)]
    other = rows.assign(robot_b="C", n_true=[0, 5, 5, 5, 5])  # at 10 and 50 just one of two
    assert scarce_spans(pd.concat([rows, other])) == [(-5, 5)]
    assert scarce_spans(rows[:1]) == [(-0.5, 0.5)]
    assert scarce_spans(rows[:0]) == []


def test_times_in_groups_along_the_overlap() -> None:
    timings = pd.DataFrame({"run_id": "x", "aligner": "svd", "n_common": np.arange(80)})
    table = time_bands(timings.assign(elapsed_s=np.arange(80) * 1e-3))
    assert len(table) == 8
    assert (table["n_maps"] == 10).all()
    assert table["elapsed_s"].tolist() == pytest.approx(1e-3 * (4.5 + 10 * np.arange(8)))
    assert (table["elapsed_low_s"] < table["elapsed_s"]).all()


def test_maps_that_one_method_did_not_see_leave_the_others_in_their_runs() -> None:
    """The interval resamples the runs of the maps that both methods saw."""
    alike = (1.1, 0.3, 0.0)  # which of them is nearer differs from map to map
    errors = rich(many_errors(5, methods={"one": alike, "other": alike}, repetitions=1))
    keys = ["run_id", "robot_a", "robot_b", "iteration"]
    unseen = errors.groupby(keys).ngroup() % 3 == 1
    errors = errors[~(unseen & (errors["aligner"] == "other"))]
    one, other = (errors[errors["aligner"] == name].set_index(keys) for name in ("one", "other"))
    both = np.log(one["translation_error_m"] / other["translation_error_m"]).dropna().sort_index()
    runs = clusters_of(both.reset_index())
    expected = np.exp(median_interval(both.to_numpy(), runs, rng()))
    (row,) = compare_methods(summarise_alignments(errors), rng()).to_dict("records")
    assert (row["n_maps"], row["n_runs"]) == (len(both), 5)
    assert [row[f"ratio{end}"] for end in ("", "_low", "_high")] == pytest.approx(expected)


def test_what_is_told_beside_the_ratio_is_a_median_too() -> None:
    errors = rich(many_errors(1, methods={"one": (1.0, 0.0, 0.0)}))
    off = np.geomspace(0.01, 2.0, errors["iteration"].nunique() * 2)
    place = errors.groupby(["robot_a", "robot_b", "iteration"]).ngroup()
    errors["translation_error_m"] = off[place]
    errors["refined_translation_error_m"] = off[place] / 3
    row = oracle_ratios(summarise_alignments(errors), rng()).set_index("aligner").loc["one"]
    assert row["estimated_m"] == pytest.approx(np.median(off))
    assert row["refined_m"] == pytest.approx(np.median(off) / 3)
