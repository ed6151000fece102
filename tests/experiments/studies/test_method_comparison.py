"""Tests of success rates, of the comparison of methods, and of the recommendation."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from scipy.stats import binomtest

from experiments.evaluation.alignment_criteria import (
    RICH_PAIRS,
    RIGHT_WITHIN_M,
    RIGHT_WITHIN_RAD,
    summarise_alignments,
    with_common_ground_at_any_time,
)
from experiments.evaluation.metrics import compute
from experiments.evaluation.tables import SHOWN, Shown
from experiments.studies.intervals import (
    MAPS_OF_ONE_RUN,
    RUN,
    change_of_each_run,
    clusters_of,
    holm,
    mean_change,
    median_interval,
    wilson,
)
from experiments.studies.method_comparison import (
    LAST,
    aligner_summary,
    compare_methods,
    oracle_ratios,
    recommend,
    success_rates,
)
from experiments.studies.run_tables import find_runs
from experiments.studies.statistics import (
    BAND,
    error_bands,
    medians_of_run,
    scarce_spans,
    time_bands,
    with_overlap_share,
)
from mapfusion.align.refinement import Refinement
from tests.helpers.made_up_runs import (
    ITERATIONS,
    LOST_M,
    many_errors,
    robots_of,
    tables_of,
    write_result,
)


def made_up(errors_m: dict[str, list[float]], n_common: list[int] | None = None) -> pd.DataFrame:
    """One run, one pair of robots: each aligner's errors, iteration by iteration."""
    rows = []
    for aligner, values in {
        **errors_m,
        "oracle": [0.05] * len(next(iter(errors_m.values()))),
    }.items():
        for k, value in enumerate(values):
            found = np.isfinite(value)
            rows.append(
                {
                    "run_id": "run-0",
                    "scenario": "run",
                    "seed": 0,
                    "robot_a": "R1",
                    "robot_b": "R2",
                    "iteration": k,
                    "aligner": aligner,
                    "repetition": 0,
                    "accepted": found,
                    "translation_error_m": value,
                    "rotation_error_rad": 0.001,
                    "refined_translation_error_m": value,
                    "refined_rotation_error_rad": 0.001 if found else np.nan,
                    "n_correspondences": 50,
                    "n_common": 60 if n_common is None else n_common[k],
                    "n_true": 30,
                }
            )
    return pd.DataFrame(rows)


def timings(**ms: float) -> pd.DataFrame:
    return pd.DataFrame([{"aligner": name, "elapsed_s": 1e-3 * t} for name, t in ms.items()])


def verdict_of(errors: pd.DataFrame, times: pd.DataFrame | None = None):
    order = list(dict.fromkeys(errors["aligner"]))
    maps = summarise_alignments(errors)
    return recommend(maps, pd.DataFrame() if times is None else times, order)


def test_the_more_often_correct_wins() -> None:
    verdict = verdict_of(made_up({"poor": [0.01] * 4 + [9.0] * 16, "good": [0.1] * 19 + [9.0]}))
    assert verdict.best is not None
    assert verdict.best.aligner == "good"
    assert verdict.equals == ()
    assert verdict.best.rate == pytest.approx(0.95)
    # Wilson's interval of 19 in 20, from a table
    assert (verdict.best.low, verdict.best.high) == pytest.approx((0.764, 0.991), abs=1e-3)
    assert verdict.best.n_false == 1


def test_of_equally_correct_ones_the_more_accurate_wins() -> None:
    verdict = verdict_of(
        made_up({"coarse": [0.2] * 20, "fine": [0.1] * 20}), timings(coarse=1, fine=9)
    )
    assert [s.aligner for s in verdict.standings] == ["fine", "coarse"]
    assert verdict.equals == ()
    assert verdict.best is not None
    assert verdict.best.over_oracle == pytest.approx(2)


def test_of_equal_ones_the_fastest_wins_and_the_others_are_equals() -> None:
    near = [0.1 + 0.01 * (-1) ** k for k in range(20)]
    verdict = verdict_of(made_up({"slow": near, "fast": [0.1] * 20}), timings(slow=5, fast=1))
    assert [s.aligner for s in verdict.standings] == ["fast", "slow"]
    assert verdict.equals == ("slow",)


@pytest.mark.parametrize("lost_m", [9.0, np.nan])
@pytest.mark.parametrize("n_maps", [6, 16, 20])
def test_one_map_does_not_decide(n_maps: int, lost_m: float) -> None:
    """Neither by its share, which is more than 5 points of 16, nor by the error that it adds."""
    near = [0.1 + 0.005 * (-1) ** k for k in range(n_maps)]
    errors = {"steady": near, "fast": [*near[:-1], lost_m]}
    verdict = verdict_of(made_up(errors), timings(steady=5, fast=1))
    assert [s.aligner for s in verdict.standings] == ["fast", "steady"]
    assert verdict.equals == ("steady",)
    errors["fast"] = [*near[:-2], lost_m, lost_m]
    verdict = verdict_of(made_up(errors), timings(steady=5, fast=1))
    assert [s.aligner for s in verdict.standings] == ["steady", "fast"]
    assert verdict.equals == ()


def test_methods_without_a_map_in_common_are_not_equal() -> None:
    errors = made_up({"one": [0.1] * 6, "other": [0.1] * 6})
    early = errors["iteration"] < 3
    apart = errors[(errors["aligner"] == "oracle") | ((errors["aligner"] == "one") == early)]
    assert verdict_of(apart).equals == ()


def test_repetitions_are_no_trials() -> None:
    errors = made_up({"one": [0.1] * 5})
    repeated = pd.concat([errors.assign(repetition=r) for r in range(20)])
    few, many = verdict_of(errors).standings[0], verdict_of(repeated).standings[0]
    assert (many.low, many.high, many.n_maps) == (few.low, few.high, few.n_maps)


def test_no_estimate_is_worse_than_any() -> None:
    verdict = verdict_of(made_up({"shy": [0.01] * 8 + [np.nan] * 12, "bold": [0.3] * 20}))
    assert verdict.best is not None
    assert verdict.best.aligner == "bold"
    assert np.isinf(verdict.standings[1].refined_m)


def test_without_common_ground_no_method_is_named() -> None:
    verdict = verdict_of(made_up({"one": [9.0] * 6}, n_common=[2] * 6))
    assert verdict.best is None
    assert verdict.n_common == 0
    assert [s.n_false for s in verdict.standings] == [6]


def test_where_nothing_works_no_method_is_named() -> None:
    verdict = verdict_of(made_up({"one": [9.0] * 6}))
    assert verdict.best is None
    assert verdict.n_common == 6


def test_a_method_that_mostly_fails_surely_does() -> None:
    best = verdict_of(made_up({"one": [0.1] * 10 + [9.0] * 90})).best
    assert best is not None
    assert best.high < 0.5  # what the report calls unreliable


def test_a_column_accepted_decides_what_is_merged() -> None:
    errors = made_up({"one": [0.1] * 5 + [9.0] * 5})
    judged = errors.assign(accepted=errors["refined_translation_error_m"] < 1)
    assert verdict_of(errors).standings[0].n_false == 5
    assert verdict_of(judged).standings[0].n_false == 0
    untested = verdict_of(errors.drop(columns="accepted")).standings[0]
    assert (untested.n_accepted, untested.n_false) == (0, 0)


def test_of_several_runs_the_run_is_the_unit() -> None:
    """A world is one piece of evidence, whatever the number of its maps."""
    errors = many_errors(8, methods={"slow": (1.2, 0.0, 0.0), "fast": (1.2, 0.0, 0.0)})
    own = (errors["aligner"] == "slow") & (errors["run_id"] == "world-0")
    errors.loc[own, "translation_error_m"] *= 0.7  # nearer on 8 maps of 64, farther on none
    times = timings(slow=9, fast=1)
    assert verdict_of(errors, times).equals == ("slow",)
    alone = errors[errors["run_id"] == "world-0"]
    assert verdict_of(alone, times).equals == ()


def test_few_runs_that_prove_nothing_do_not_make_a_poor_method_equal() -> None:
    errors = many_errors(3, methods={"good": (1.1, 0.1, 0.0), "poor": (1.1, 0.1, 0.0)})
    of_poor = errors["aligner"] == "poor"
    columns = ["translation_error_m", "refined_translation_error_m"]
    lost = {"world-0": (25, 50, 75, 100), "world-1": (25,), "world-2": (25, 50)}
    for run_id, iterations in lost.items():
        rows = of_poor & (errors["run_id"] == run_id) & errors["iteration"].isin(iterations)
        errors.loc[rows, columns] = 9.0
    verdict = verdict_of(errors, timings(good=9, poor=1))
    assert [s.aligner for s in verdict.standings] == ["good", "poor"]
    assert verdict.equals == ()


def test_a_further_column_is_shown_by_naming_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Declared in SHOWN, a column of `errors` reaches the screens' and the reports' rows."""
    errors = many_errors(2, repetitions=3).assign(accepted=True, precision=0.25)
    monkeypatch.setitem(SHOWN, "precision", Shown("prec.", ".0%", "share"))
    summary = aligner_summary(errors, timings(icp=2), ["icp", "oracle", "absent"])
    assert list(summary["aligner"]) == ["icp", "oracle", "absent"]
    rows = summary.set_index("aligner")
    assert rows.loc["icp", ["precision", "time_ms"]].tolist() == [0.25, 2]
    assert rows.loc["absent"].isna().all()
    standing = verdict_of(errors).standings[0]
    assert standing.shown["precision"] == 0.25
    for column, value in (
        ("translation_error_m", standing.estimated_m),
        ("refined_rotation_error_rad", standing.refined_rad),
    ):
        found = aligner_summary(errors, timings(), [standing.aligner])[column][0]
        assert found == value


def test_what_is_told_of_an_aligner_are_medians_over_its_maps() -> None:
    """The numbers are skewed, so their mean differs from the median."""
    errors = made_up({"one": [0.1, 0.2, 0.45, 0.15, 0.4]})
    of_oracle = errors["aligner"] == "oracle"
    for name, values in (
        ("refined_translation_error_m", [0.05, 0.06, 0.07, 0.08, 0.4]),
        ("refined_rotation_error_rad", [0.001, -0.002, 0.003, -0.004, 0.09]),
    ):
        errors.loc[of_oracle, name] = values
    errors.loc[~of_oracle, "refined_rotation_error_rad"] = [0.001, -0.002, 0.003, -0.004, 0.09]
    times = pd.concat([timings(one=t) for t in (1, 2, 30)])
    verdict = verdict_of(errors, times)
    (one,) = verdict.standings
    assert (one.estimated_m, one.refined_m, one.refined_rad) == (0.2, 0.2, 0.003)
    assert one.time_ms == pytest.approx(2)
    assert one.over_oracle == pytest.approx(0.2 / 0.07)
    assert (verdict.oracle_m, verdict.oracle_rad) == (0.07, 0.003)


def test_accepted_answers_are_counted_over_all_repetitions() -> None:
    """Two of three answers are accepted on each map; on two of five maps they are wrong."""
    right = made_up({"one": [0.1] * 3 + [9.0] * 2})
    answers = [right.assign(repetition=k, accepted=k < 2) for k in range(3)]
    (one,) = verdict_of(pd.concat(answers)).standings
    assert (one.n_accepted, one.n_false, one.n_maps) == (10, 4, 5)


def test_nearer_on_most_maps_is_not_equal_though_its_median_error_is_larger() -> None:
    """The other error is half on three of five maps; the t test needs more maps."""
    first, other = [0.05, 0.06, 0.1, 0.3, 0.32], [0.4, 0.4, 0.05, 0.14, 0.15]
    verdict = verdict_of(made_up({"first": first, "other": other}), timings(first=9, other=1))
    assert [s.aligner for s in verdict.standings] == ["first", "other"]
    assert verdict.equals == ()


def slow_rate(errors: pd.DataFrame, aligner: str, low: float, high: float) -> float:
    """Share of right maps with that many true pairs, counted one by one."""
    maps: dict[tuple, list[bool]] = {}
    for row in errors.to_dict("records"):
        if row["aligner"] == aligner and low <= row["n_true"] < high:
            key = tuple(row[name] for name in ("run_id", "robot_a", "robot_b", "iteration"))
            right = row["translation_error_m"] <= 0.5 and abs(row["rotation_error_rad"]) <= 0.1
            maps.setdefault(key, []).append(right)
    return float(np.mean([np.mean(rights) for rights in maps.values()]))


def test_rates_are_the_shares_of_right_maps() -> None:
    errors = many_errors(8)
    rates = success_rates(summarise_alignments(errors), "n_true")
    for row in rates[rates["aligner"] != "oracle"].to_dict("records"):
        expected = slow_rate(errors, row["aligner"], row["from"], row["to"])
        assert row["estimated_success"] == pytest.approx(expected)
        assert row["estimated_success_low"] <= expected <= row["estimated_success_high"]
        assert (row["n_runs"], row["unit"]) == (8, RUN) or row["n_runs"] < 8
    maps = errors.groupby(["run_id", "robot_a", "robot_b", "iteration"]).ngroups
    assert rates[rates["aligner"] == "icp"]["n_maps"].sum() == maps
    assert "accepted" not in rates


def test_at_the_end_the_trials_are_runs() -> None:
    errors = many_errors(12, methods={"ransac": (1.1, 0.1, 0.0)})
    lost = errors["run_id"].isin([f"world-{seed}" for seed in range(3)])
    lost &= errors["aligner"] == "ransac"
    errors.loc[lost, "translation_error_m"] = LOST_M
    row = success_rates(summarise_alignments(errors), LAST).set_index("aligner").loc["ransac"]
    expected = binomtest(9, 12).proportion_ci(method="wilson")
    assert row["estimated_success"] == pytest.approx(0.75)
    assert row[["estimated_success_low", "estimated_success_high"]].tolist() == pytest.approx(
        [expected.low, expected.high]
    )
    assert row["n_maps"] == 24


def test_maps_without_common_ground_are_counted_apart() -> None:
    """4 of 12 worlds share 2 landmarks; answers there are right by luck, 1 of 3 is accepted."""
    errors = many_errors(12, methods={"ransac": (1.1, 0.1, 0.0)}, repetitions=3)
    apart = errors["run_id"].isin([f"world-{seed}" for seed in range(4)])
    errors["accepted"] = ~apart | (errors["repetition"] == 0)
    lost = (errors["run_id"] == "world-5") & (errors["aligner"] == "ransac")
    errors.loc[lost, ["translation_error_m", "refined_translation_error_m"]] = LOST_M
    together = success_rates(summarise_alignments(errors), LAST).set_index("aligner").loc["ransac"]
    errors.loc[apart, "n_common"] = 2
    row = success_rates(summarise_alignments(errors), LAST).set_index("aligner").loc["ransac"]
    assert (together["n_apart"], row["n_apart"], row["n_maps"]) == (0, 8, 24)
    assert together["estimated_success"] == pytest.approx(11 / 12)
    assert row["estimated_success"] == row["refined_success"] == pytest.approx(7 / 8)
    assert together["accepted"] == pytest.approx((8 + 4 / 3) / 12)
    assert row["accepted"] == 1
    assert row["refused_apart"] == pytest.approx(2 / 3)
    assert row["false_accepted"] == pytest.approx((1 + 4 / 3) / 12)
    low, high = map(float, wilson(4 * 2 / 3, 4))
    assert row[["refused_apart_low", "refused_apart_high"]].tolist() == pytest.approx([low, high])
    bins = (
        success_rates(summarise_alignments(errors), "n_common")
        .set_index(["aligner", "from"])
        .loc["ransac"]
    )
    assert np.isnan(bins.loc[0, "estimated_success"])
    assert bins["n_apart"].tolist()[0] == bins["n_maps"].tolist()[0] == 32
    assert (bins["n_apart"].iloc[1:] == 0).all()


def test_robots_that_meet_late_belong_to_those_that_meet() -> None:
    errors = many_errors(3)
    errors.loc[errors["run_id"] == "world-0", "n_common"] = 2
    errors.loc[
        (errors["run_id"] == "world-1") & (errors["iteration"] < ITERATIONS[-1]), "n_common"
    ] = 0
    kept = with_common_ground_at_any_time(errors)
    assert kept["run_id"].unique().tolist() == ["world-1", "world-2"]
    assert len(kept) == len(errors) * 2 / 3


def test_a_single_run_says_so() -> None:
    assert (
        success_rates(summarise_alignments(many_errors(1)), "iteration")["unit"] == MAPS_OF_ONE_RUN
    ).all()


@pytest.mark.parametrize(
    ("m", "rad", "right"),
    [
        (0.5, 0.1, 1.0),
        (0.5, -0.1, 1.0),
        (0.51, 0.0, 0.0),
        (0.0, -0.11, 0.0),
        (np.nan, np.nan, 0.0),
    ],
)
def test_what_counts_as_right(m: float, rad: float, right: float) -> None:
    errors = many_errors(1, repetitions=1).assign(translation_error_m=m, rotation_error_rad=rad)
    maps = summarise_alignments(errors)
    assert (maps["estimated_success"] == right).all()


def test_right_is_what_the_refinement_reaches() -> None:
    assert Refinement().gate_m == RIGHT_WITHIN_M
    assert pytest.approx(0.1) == RIGHT_WITHIN_RAD


def test_failed_estimates_are_infinitely_far_off() -> None:
    errors = many_errors(1)
    of_icp = errors["aligner"] == "icp"
    errors.loc[of_icp & (errors["repetition"] < 2), "translation_error_m"] = np.nan
    maps = summarise_alignments(errors).set_index("aligner")
    assert np.isinf(maps.loc["icp", "translation_error_m"]).all()
    assert np.isfinite(maps.loc["ransac", "translation_error_m"]).all()
    assert maps.loc["icp", "estimated_success"].max() <= 1 / 3


def test_acceptance_and_false_acceptance() -> None:
    errors = many_errors(3).assign(accepted=True)
    rates = success_rates(summarise_alignments(errors), LAST).set_index("aligner")
    assert (rates["accepted"] == 1).all()
    np.testing.assert_allclose(rates["false_accepted"], 1 - rates["refined_success"])


def test_bins_hold_their_lower_edge_and_the_last_one_both() -> None:
    maps = summarise_alignments(many_errors(2)).assign(outlier_share=1.0)
    rates = success_rates(maps, "outlier_share")
    assert set(rates["from"]) == {0.99}
    assert set(rates["to"]) == {1.0}
    maps = maps.assign(outlier_share=0.5)
    assert set(success_rates(maps, "outlier_share")["from"]) == {0.5}


@pytest.mark.parametrize(
    ("by", "edges", "says"),
    [
        ("colour", None, "expected one of"),
        ("n_true", (3, 2), "increasing"),
        ("n_true", (3,), "two"),
    ],
)
def test_wrong_arguments(by: str, edges: tuple | None, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        success_rates(summarise_alignments(many_errors(1)), by, edges)
    with pytest.raises(ValueError, match="no overlap_share"):
        success_rates(summarise_alignments(many_errors(1)), "overlap_share")


def test_overlap_share_is_of_the_smaller_map(tmp_path: Path) -> None:
    made = tables_of(0)
    robots = robots_of(0).assign(n_landmarks=lambda t: 10 + t["iteration"])
    made["robots"] = robots.assign(iteration=robots["iteration"] * 6)  # ends at 114, R1 earlier
    last_of_r1 = (made["robots"]["robot"] == "R1") & (made["robots"]["iteration"] > 60)
    made["robots"] = made["robots"][~last_of_r1]
    runs = find_runs(write_result(tmp_path, 0, made))
    maps = with_overlap_share(summarise_alignments(runs.read("errors")), runs)
    assert sorted(maps["iteration"].unique()) == list(ITERATIONS)
    size = maps["iteration"].map({25: 10 + 4, 50: 10 + 8, 75: 10 + 10, 100: 10 + 10})
    np.testing.assert_allclose(maps["overlap_share"], maps["n_common"] / size)


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
    """A drift that both methods share in each run cancels in the ratio."""
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
