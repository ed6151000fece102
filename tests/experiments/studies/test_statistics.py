"""Tests of the statistics over many runs."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from experiments.evaluation.path_errors import STATISTICS
from experiments.studies.comparison import compare
from experiments.studies.intervals import wilson
from experiments.studies.statistics import (
    ALL_SCENARIOS,
    _each,
    alignment_nees,
    error_bands,
    fuser_summary,
    medians_of_run,
    nees_of_maps,
    nees_of_pairs,
    path_summary,
    scarce_spans,
    team_alignments,
    team_paths,
    time_bands,
)
from mapfusion.fusion.team_graph import EdgeStatus
from tests.helpers import made_up_runs
from tests.helpers.made_up_runs import Tables, two_sweeps
from tests.helpers.tiny_scenario import command


def team_of(seed: int, rmse: float = 0.1) -> pd.DataFrame:
    """Return a table `team` in which three of four robots are merged."""
    value = rmse * np.exp(0.1 * np.random.default_rng(seed).normal())
    row = {"component": 1, "n_robots": 3, "n_team": 4, "n": 99} | dict.fromkeys(STATISTICS, value)
    rows = [row | {"source": "final"}, row | {"source": "odometry", "rmse": 9.0}]
    return pd.DataFrame([*rows, row | {"source": "final", "component": 2, "rmse": 7.0}])


def pairs_of(seed: int, off_m: float = 0.1) -> pd.DataFrame:
    """Return a table `team_pairs`: right, right but not used, wrong but used, and apart."""
    value = off_m * np.exp(0.1 * np.random.default_rng(seed).normal())
    rows = [
        ("A", "B", EdgeStatus.CONFIRMED, True, 40, 2 * value, value),
        ("A", "C", EdgeStatus.UNCONFIRMED, True, 40, 2 * value, np.nan),
        ("B", "C", EdgeStatus.BRIDGE, True, 40, 3.0, 3.0),
        ("A", "D", EdgeStatus.REFUSED, False, 0, np.nan, np.nan),
    ]
    names = ["robot_a", "robot_b", "place", "accepted", "n_common"]
    names += ["refined_translation_error_m", "team_translation_error_m"]
    frame = pd.DataFrame(rows, columns=pd.Index(names)).astype({"place": str})
    return frame.assign(refined_rotation_error_rad=0.01, team_rotation_error_rad=-0.02)


def of_runs(make: object, n: int) -> pd.DataFrame:
    return pd.concat([make(seed).assign(run_id=f"w-{seed}") for seed in range(n)])  # type: ignore[operator]


def test_paths_are_medians_over_the_largest_sets_of_the_runs() -> None:
    team = of_runs(team_of, 9)
    final, odometry = team_paths(team, np.random.default_rng(0)).to_dict("records")
    own = team[(team["source"] == "final") & (team["component"] == 1)]["rmse"]
    assert (final["n_runs"], final["n_robots"], final["n_team"]) == (9, 27, 36)
    assert final["rmse"] == np.median(own)
    assert own.min() <= final["rmse_low"] < final["rmse"] < final["rmse_high"] <= own.max()
    assert odometry["rmse"] == 9.0


def test_shares_of_alignments_are_those_counted_by_hand() -> None:
    """One of two used alignments is right; one of three pairs that met is right and used."""
    (row,) = team_alignments(of_runs(pairs_of, 6), np.random.default_rng(0)).to_dict("records")
    assert (row["n_runs"], row["n_pairs"], row["n_met"], row["n_believed"]) == (6, 24, 18, 12)
    assert (row["precision"], row["recall"]) == pytest.approx((1 / 2, 1 / 3))
    # the rows of a run may share one fate: six trials, one a run
    for name in ("precision", "recall"):
        low, high = map(float, wilson(6 * row[name], 6))
        assert (row[f"{name}_low"], row[f"{name}_high"]) == pytest.approx((low, high))
    pairs = of_runs(pairs_of, 6)
    placed = pairs[pairs["place"].isin(["confirmed", "bridge"])]
    assert row["team_m"] == np.median(placed["team_translation_error_m"])
    assert row["alone_m"] == np.median(placed["refined_translation_error_m"])
    assert row["team_rad"] == 0.02


def test_nothing_believed_and_nobody_met_is_unknown() -> None:
    rows = pairs_of(0).assign(place=str(EdgeStatus.REFUSED), n_common=0, run_id="w")
    rows["team_translation_error_m"] = np.nan
    (row,) = team_alignments(rows, np.random.default_rng(0)).to_dict("records")
    assert np.isnan([row["precision"], row["recall"], row["team_m"]]).all()


def worse(seed: int, made: Tables) -> Tables:
    """The team's error is three times larger, and one more alignment, a right one, is used."""
    made["team"] = team_of(seed, 0.3)
    made["team_pairs"] = pairs_of(seed, 0.15)
    made["team_pairs"].loc[1, "place"] = str(EdgeStatus.BRIDGE)
    return made


def test_two_versions_are_compared_in_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def with_teams(seed: int) -> Tables:
        return {"errors": own(seed)["errors"], "team": team_of(seed), "team_pairs": pairs_of(seed)}

    own = made_up_runs.tables_of
    monkeypatch.setattr(made_up_runs, "tables_of", with_teams)
    a, b = two_sweeps(tmp_path, worse, seeds=8)
    rows = compare(a, b).table.set_index("metric")
    assert rows.loc["team ATE, m", ["change", "verdict"]].tolist() == [pytest.approx(3), "worse"]
    assert rows.loc["team's T_a_b, m", "n_rows"] == 8 * 2
    assert rows.loc["team edges found", ["a", "b"]].tolist() == pytest.approx([1 / 3, 2 / 3])
    assert rows.loc["team edges found", "n_rows"] == 8 * 3  # of those that met
    assert rows.loc["team edges false", "verdict"] == "identical"
    shown = command(capsys, "statistics", a)
    assert shown.code == 0
    assert "Path errors of teams (ATE)" in shown.out
    assert "Alignments between robots at the end" in shown.out
    assert "24/32" in shown.out


KEYS = {"run_id": "x-0", "scenario": "x", "seed": 0, "robot_a": "A", "robot_b": "B"}


def rows_of(iteration: int, off: list[float], **more: object) -> pd.DataFrame:
    """Make repetitions with these errors in m, and the negative ones in rad."""
    names = ("translation_error_m", "refined_translation_error_m")
    rows = pd.DataFrame(dict.fromkeys(names, off))
    for name in ("rotation_error_rad", "refined_rotation_error_rad"):
        rows[name] = -rows["translation_error_m"]
    counts = {"n_correspondences": 90, "n_true": 9, "n_common": 50}
    about = KEYS | {"iteration": iteration, "aligner": "icp"} | counts | more
    return rows.assign(**about, repetition=range(len(off)))


def test_the_line_is_the_median_and_the_band_holds_four_fifths() -> None:
    """The values are 0, 1, ..., 9 and 100: 10 % lie below 1 and 90 % below 9."""
    (row,) = error_bands(rows_of(5, [*map(float, range(10)), 100.0])).to_dict("records")
    names = [f"translation_error_m{end}" for end in ("_low", "", "_high")]
    assert [row[name] for name in names] == [1.0, 5.0, 9.0]
    names = [f"rotation_error_rad{end}" for end in ("_low", "", "_high")]
    assert [row[name] for name in names] == [-9.0, -5.0, -1.0]
    unsigned = error_bands(rows_of(5, [1.0, -2.0, 4.0]), absolute=True)
    assert unsigned["rotation_error_rad"].tolist() == [2.0]


@pytest.mark.parametrize(
    ("off", "length_m", "angle_rad"),
    [
        ([1.0, 2.0, 9.0, np.nan], 5.5, -2.0),
        ([1.0, 2.0, np.nan, np.nan], np.inf, np.nan),  # a half is not most
        ([1.0, np.nan, np.nan], np.inf, np.nan),
    ],
)
def test_rows_without_an_estimate_are_far_off_and_have_no_side(
    off: list[float], length_m: float, angle_rad: float
) -> None:
    rows = rows_of(5, off)
    for (found,) in (
        error_bands(rows).to_dict("records"),
        medians_of_run(rows).to_dict("records"),
    ):
        assert found["refined_translation_error_m"] == length_m
        assert found["refined_rotation_error_rad"] == pytest.approx(angle_rad, nan_ok=True)


def test_a_run_counts_by_its_median() -> None:
    rows = pd.concat([rows_of(5, [1.0, 2.0, 30.0]), rows_of(6, [4.0, 4.0, 5.0], n_true=12)])
    found = medians_of_run(rows)
    assert found["translation_error_m"].tolist() == [2.0, 4.0]
    assert found["rotation_error_rad"].tolist() == [-2.0, -4.0]
    assert found["n_true"].tolist() == [9, 12]


@pytest.mark.parametrize(
    ("n_true", "spans"),
    [
        ([[2], [3], [9]], [(-5.0, 5.0)]),
        ([[2, 9], [2, 2], [2, 9]], [(5.0, 15.0)]),  # one map of two is not most
        ([[9], [9], [0]], [(15.0, 25.0)]),
    ],
)
def test_too_few_true_pairs_in_most_maps(n_true: list[list[int]], spans: list) -> None:
    rows = [
        rows_of(10 * k, [0.1, 0.2], n_true=n, robot_b=f"B{i}")
        for k, maps in enumerate(n_true)
        for i, n in enumerate(maps)
    ]
    assert scarce_spans(pd.concat(rows)) == spans


def test_times_are_medians_of_groups_of_like_overlap() -> None:
    seconds = [1.0, 2.0, 30.0, 4.0, 5.0, 60.0]
    timings = pd.DataFrame({"n_common": [1, 2, 3, 7, 8, 12], "elapsed_s": seconds})
    found = time_bands(timings.assign(aligner="icp"), groups=2)
    assert found["elapsed_s"].tolist() == [2.0, 5.0]
    assert found["elapsed_low_s"].tolist() == pytest.approx([1.2, 4.2])
    assert found["elapsed_high_s"].tolist() == pytest.approx([24.4, 49.0])
    assert found["n_common"].tolist() == [2, 8]
    assert (found["n_common_low"].tolist(), found["n_common_high"].tolist()) == ([1, 7], [3, 12])


def made_up_fusers() -> pd.DataFrame:
    rows = [
        {"run_id": f"w-{run}", "fuser": fuser, "iteration": k, "landmark_rmse_m": value}
        for run, last in enumerate((30, 40, 50))
        for fuser, at_end in (("kalman", 0.4), ("plug-in", 0.2))
        for k, value in ((10, 9.0), (20, 8.0), (last, at_end + run / 100))
    ]
    others = ("over_better_filter", "nees_per_dof", "coverage_95")
    return pd.DataFrame(rows).assign(**dict.fromkeys(others, 1.0))


def test_medians_are_of_each_run_s_last_iteration() -> None:
    rows = fuser_summary(made_up_fusers(), np.random.default_rng(0)).set_index("fuser")
    assert list(rows.index) == ["kalman", "plug-in"]
    assert (rows["n_runs"] == 3).all()
    assert rows["landmark_rmse_m"].tolist() == pytest.approx([0.41, 0.21])
    assert (rows["landmark_rmse_m_low"] <= rows["landmark_rmse_m"]).all()
    assert (rows["landmark_rmse_m_high"] < 1).all()


def test_runs_that_fused_nothing_are_no_runs_of_a_fuser() -> None:
    assert fuser_summary(made_up_fusers().iloc[:0], np.random.default_rng(0)).empty


def made_up_nees(n_runs: int, factor: float, drift: float = 0.0) -> pd.DataFrame:
    """Tables `landmark_nees` of maps whose variances are `factor` times too small."""
    rng = np.random.default_rng(0)
    rows = []
    for run in range(n_runs):
        n, dof = int(rng.integers(200, 400)), 3
        nees = factor * np.exp(drift * rng.normal()) * rng.chisquare(dof, n)
        rows.append(
            {
                "run_id": f"w-{run}",
                "landmarks": "own",
                "n_landmarks": n,
                "degrees_of_freedom": dof,
                "nees_mean": nees.mean(),
                "share_in_gate": np.mean(nees <= chi2.ppf(0.95, dof)),
            }
        )
    return pd.DataFrame(rows)


def test_consistent_maps_keep_to_the_band() -> None:
    row = nees_of_maps(made_up_nees(20, 1.0), np.random.default_rng(1)).iloc[0]
    assert row["band_low"] < row["nees_per_dof"] < row["band_high"]
    assert row["nees_per_dof_low"] < 1 < row["nees_per_dof_high"]
    assert row["share_in_gate"] == pytest.approx(0.95, abs=0.01)
    width = 2 * 1.96 * np.sqrt(2 / (3 * row["n_landmarks"]))
    assert row["band_high"] - row["band_low"] == pytest.approx(width, rel=0.01)


def test_overconfident_maps_do_not() -> None:
    row = nees_of_maps(made_up_nees(20, 2.0), np.random.default_rng(1)).iloc[0]
    assert row["nees_per_dof"] == pytest.approx(2, rel=0.05)
    assert row["nees_per_dof_low"] > row["band_high"]
    assert row["share_in_gate_high"] < 0.9


def test_the_interval_over_runs_sees_drift_that_the_band_does_not() -> None:
    row = nees_of_maps(made_up_nees(20, 1.0, drift=0.5), np.random.default_rng(1)).iloc[0]
    interval = row["nees_per_dof_high"] - row["nees_per_dof_low"]
    assert interval > 5 * (row["band_high"] - row["band_low"])


def test_maps_without_truth_are_left_out() -> None:
    rows = made_up_nees(2, 1.0).assign(n_landmarks=0, nees_mean=np.nan)
    assert nees_of_maps(rows, np.random.default_rng(0)).empty


def test_pairs_fused_with_drift_and_without() -> None:
    rng = np.random.default_rng(3)
    nees = rng.chisquare(2, 3000)
    fusion = pd.DataFrame({"run_id": np.repeat(["a", "b", "c"], 1000), "nees_with_drift": nees})
    fusion = fusion.assign(nees_without_drift=9 * nees, degrees_of_freedom=2, true_pair=True)
    false = fusion.assign(true_pair=False, nees_with_drift=1e6)
    table = nees_of_pairs(pd.concat([fusion, false]), rng).set_index("landmarks")
    assert table.loc["fused in pairs, with drift", "nees_per_dof"] == pytest.approx(nees.mean() / 2)
    assert table.loc["fused in pairs, without drift", "nees_per_dof"] == pytest.approx(
        9 * nees.mean() / 2
    )
    assert (table["n_landmarks"] == 3000).all()


def test_path_statistics_are_medians_over_paths() -> None:
    rng = np.random.default_rng(4)
    names = ("rmse", "mean", "median", "std", "min", "max", "sse")
    rows = pd.DataFrame({name: rng.uniform(size=30) for name in names})
    rows = rows.assign(
        run_id=np.repeat([f"r{i}" for i in range(10)], 3),
        source="final",
        quantity="ate_m",
        delta=np.nan,
        delta_unit="",
    )
    row = path_summary(rows, rng).iloc[0]
    assert (row["n_runs"], row["n_paths"]) == (10, 30)
    for name in names:
        assert row[name] == np.median(rows[name])
    assert row["rmse_low"] < row["rmse"] < row["rmse_high"]


def test_every_landmark_counts_once_however_they_are_spread_over_maps() -> None:
    """NEES 3 for one landmark and 1 for nine give 1.2 per degree of freedom."""
    runs = {"run_id": ["x", "y"], "landmarks": "own", "degrees_of_freedom": 3}
    maps = {"n_landmarks": [1, 9], "nees_mean": [9.0, 3.0], "share_in_gate": [0.0, 1.0]}
    (row,) = nees_of_maps(pd.DataFrame(runs | maps), np.random.default_rng(0)).to_dict("records")
    assert (row["n_runs"], row["n_landmarks"]) == (2, 10)
    assert (row["nees_per_dof"], row["share_in_gate"]) == pytest.approx((1.2, 0.9))


def test_planar_maps_and_others_are_pooled_by_their_degrees_of_freedom() -> None:
    """200 landmarks with 2 degrees of freedom and 100 with 3 have 700 degrees together."""
    runs = {"run_id": ["x", "y"], "landmarks": "own", "degrees_of_freedom": [2, 3]}
    maps = {"n_landmarks": [200, 100], "nees_mean": [1.6, 6.0], "share_in_gate": [1.0, 0.7]}
    (row,) = nees_of_maps(pd.DataFrame(runs | maps), np.random.default_rng(0)).to_dict("records")
    assert row["nees_per_dof"] == pytest.approx((200 * 1.6 + 100 * 6.0) / 700)
    assert row["share_in_gate"] == pytest.approx(0.9)  # of landmarks, whatever their degrees
    band = chi2.ppf([0.025, 0.975], 700) / 700
    assert (row["band_low"], row["band_high"]) == pytest.approx(tuple(band))


def test_consistent_planar_maps_and_others_keep_to_the_band_together() -> None:
    rng, rows = np.random.default_rng(5), []
    for run in range(20):
        dof, n = 2 + run % 2, 300
        nees = rng.chisquare(dof, n)
        row = {"run_id": f"w-{run}", "landmarks": "own", "n_landmarks": n}
        row |= {"degrees_of_freedom": dof, "nees_mean": nees.mean()}
        rows.append(row | {"share_in_gate": np.mean(nees <= chi2.ppf(0.95, dof))})
    row = nees_of_maps(pd.DataFrame(rows), np.random.default_rng(1)).iloc[0]
    assert row["band_low"] < row["nees_per_dof"] < row["band_high"]
    assert row["nees_per_dof_low"] < 1 < row["nees_per_dof_high"]
    fusion = pd.DataFrame({"run_id": ["a"] * 2000 + ["b"] * 1000})
    fusion["degrees_of_freedom"], fusion["true_pair"] = [2] * 2000 + [3] * 1000, True
    fusion["nees_with_drift"] = rng.chisquare(fusion["degrees_of_freedom"])
    fusion["nees_without_drift"] = 4 * fusion["nees_with_drift"]
    table = nees_of_pairs(fusion, rng).set_index("landmarks")["nees_per_dof"]
    expected = fusion["nees_with_drift"].sum() / fusion["degrees_of_freedom"].sum()
    assert table.tolist() == pytest.approx([expected, 4 * expected])


def test_counts_stay_integers_where_a_scenario_accepts_nothing() -> None:
    rows = pd.DataFrame(
        {
            "run_id": ["x", "y"],
            "scenario": ["apart", "quick"],
            "aligner": "ransac",
            "repetition": 0,
            "accepted": [False, True],
            "lower_bound": False,
            "alignment_nees": [np.nan, 2.4],
        }
    )
    found = _each(rows, alignment_nees, "alignment_nees")
    assert found["scenario"].tolist() == ["quick", ALL_SCENARIOS]
    assert found["n_maps"].dtype == np.int64
    assert found["nees_per_dof"].tolist() == pytest.approx([0.8, 0.8])
