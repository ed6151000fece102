"""Error over the oracle, methods on the same maps, bands."""

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from experiments.judge.metrics import MIN_TRUE_PAIRS, refined_over_oracle
from experiments.study.statistics.error_bands import BAND, error_bands, medians_of_run, time_bands
from experiments.study.statistics.judged_maps import Criteria, maps_of
from experiments.study.statistics.oracle_ratio import oracle_ratios
from experiments.study.statistics.paired import compare_methods, holm, signed_rank_p
from tests.helpers.made_up_runs import many_errors


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def rich(errors: pd.DataFrame) -> pd.DataFrame:
    return errors.assign(n_true=50)


def test_ratio_over_the_oracle_agrees_with_the_checks_metric() -> None:
    errors = rich(many_errors(10, repetitions=1))
    table = oracle_ratios(maps_of(errors, Criteria()), rng()).set_index("aligner")
    for aligner in ("ransac", "icp"):
        expected = refined_over_oracle({"errors": errors}, aligner)
        row = table.loc[aligner]
        assert row["refined_ratio"] == pytest.approx(expected)
        assert row["refined_ratio_low"] <= expected <= row["refined_ratio_high"]
    assert table.loc["oracle", "refined_ratio_low"] == 1
    assert table.loc["oracle", "refined_ratio_high"] == 1


def test_ratio_resamples_method_and_oracle_together() -> None:
    """A drift that differs from run to run, and is common to both, cancels in the ratio."""
    errors = rich(many_errors(10, methods={"exact": (1.3, 0.0, 0.0)}))
    row = oracle_ratios(maps_of(errors, Criteria()), rng()).set_index("aligner").loc["exact"]
    assert row["estimated_ratio"] == pytest.approx(1.3)
    assert row["estimated_ratio_high"] - row["estimated_ratio_low"] == pytest.approx(0, abs=1e-9)


def test_scarce_maps_are_left_out() -> None:
    errors = many_errors(3)
    table = oracle_ratios(maps_of(errors, Criteria()), rng())
    maps = errors[errors["n_true"] >= MIN_TRUE_PAIRS]
    keys = ["run_id", "robot_a", "robot_b", "iteration"]
    assert (table["n_maps"] == maps.groupby(keys).ngroups).all()


def test_methods_on_the_same_maps() -> None:
    errors = rich(many_errors(12))
    table = compare_methods(maps_of(errors, Criteria()), rng())
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
    expected = scipy.stats.wilcoxon(per_run, zero_method="pratt")
    assert row["p_wilcoxon"] == pytest.approx(expected[1])
    assert row["n_runs"] == 12


def test_a_method_without_answer_loses_and_two_draw() -> None:
    errors = rich(many_errors(4))
    errors.loc[errors["aligner"] == "ransac", "translation_error_m"] = np.nan
    row = compare_methods(maps_of(errors, Criteria()), rng()).iloc[0]
    assert (row["ratio"], row["first_wins"]) == (np.inf, 0)
    errors["translation_error_m"] = np.nan
    row = compare_methods(maps_of(errors, Criteria()), rng()).iloc[0]
    assert (row["ratio"], row["first_wins"], row["p_wilcoxon"]) == (1, 0.5, 1)


def test_one_run_has_no_test_and_one_method_no_other() -> None:
    row = compare_methods(maps_of(rich(many_errors(1)), Criteria()), rng()).iloc[0]
    assert np.isnan(row["p_wilcoxon"])
    assert np.isnan(row["p_holm"])
    alone = rich(many_errors(2, methods={"svd": (1.0, 0.1, 0.0)}))
    assert compare_methods(maps_of(alone, Criteria()), rng()).empty


def test_same_rows_same_table_whatever_their_order() -> None:
    maps = maps_of(rich(many_errors(5)), Criteria())
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


def test_signed_ranks_of_draws_and_of_infinities() -> None:
    assert signed_rank_p(np.zeros(9)) == 1
    assert signed_rank_p(np.full(12, -np.inf)) < 0.01


def test_bands_are_quantiles_over_runs() -> None:
    errors = many_errors(9)
    parts = [medians_of_run(own).reset_index() for _, own in errors.groupby("run_id")]
    bands = error_bands(pd.concat(parts))
    keys = ["robot_a", "robot_b", "aligner", "iteration"]
    for row in bands.sample(10, random_state=0).to_dict("records"):
        own = errors[np.all([errors[key] == row[key] for key in keys], axis=0)]
        medians = own.groupby("run_id")["rotation_error_rad"].median()
        assert row["rotation_error_rad"] == pytest.approx(medians.median())
        assert row["rotation_error_rad_low"] == pytest.approx(medians.quantile(BAND[0]))
        assert row["n_runs"] == 9


def test_times_in_groups_along_the_overlap() -> None:
    timings = pd.DataFrame({"run_id": "x", "aligner": "svd", "n_common": np.arange(80)})
    table = time_bands(timings.assign(elapsed_s=np.arange(80) * 1e-3))
    assert len(table) == 8
    assert (table["n_maps"] == 10).all()
    assert table["elapsed_s"].tolist() == pytest.approx(1e-3 * (4.5 + 10 * np.arange(8)))
    assert (table["elapsed_low_s"] < table["elapsed_s"]).all()
