from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from experiments.evaluation.criteria import (
    RIGHT_WITHIN_M,
    RIGHT_WITHIN_RAD,
    summarise_alignments,
    with_common_ground_at_any_time,
)
from experiments.studies.intervals import MAPS_OF_ONE_RUN, RUN, wilson
from experiments.studies.method_comparison import LAST, success_rates
from experiments.studies.run_tables import find_runs
from experiments.studies.statistics import with_overlap_share
from mapfusion.align.refinement import Refinement
from tests.helpers.made_up_runs import (
    ITERATIONS,
    LOST_M,
    many_errors,
    robots_of,
    tables_of,
    write_result,
)


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
    """Of 12 worlds 4 share 2 landmarks: by luck right there, and accepted in one of three."""
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
