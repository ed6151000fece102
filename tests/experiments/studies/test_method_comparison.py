"""The ranking, on errors whose right verdict is plain."""

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.criteria import summarise_alignments
from experiments.evaluation.tables import SHOWN, Shown
from experiments.studies.method_comparison import aligner_summary, recommend
from tests.helpers.made_up_runs import many_errors


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
    """A world of its own kind is one piece of evidence, however many maps it has."""
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
    """The numbers are skewed, so that their mean is another number."""
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
    """The other is half as far off on three maps of five; five maps prove nothing in the t test."""
    first, other = [0.05, 0.06, 0.1, 0.3, 0.32], [0.4, 0.4, 0.05, 0.14, 0.15]
    verdict = verdict_of(made_up({"first": first, "other": other}), timings(first=9, other=1))
    assert [s.aligner for s in verdict.standings] == ["first", "other"]
    assert verdict.equals == ()
