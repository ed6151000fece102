import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from experiments.studies.statistics import nees_of_maps, nees_of_pairs, path_summary


def made_up(n_runs: int, factor: float, drift: float = 0.0) -> pd.DataFrame:
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
    row = nees_of_maps(made_up(20, 1.0), np.random.default_rng(1)).iloc[0]
    assert row["band_low"] < row["nees_per_dof"] < row["band_high"]
    assert row["nees_per_dof_low"] < 1 < row["nees_per_dof_high"]
    assert row["share_in_gate"] == pytest.approx(0.95, abs=0.01)
    width = 2 * 1.96 * np.sqrt(2 / (3 * row["n_landmarks"]))
    assert row["band_high"] - row["band_low"] == pytest.approx(width, rel=0.01)


def test_overconfident_maps_do_not() -> None:
    row = nees_of_maps(made_up(20, 2.0), np.random.default_rng(1)).iloc[0]
    assert row["nees_per_dof"] == pytest.approx(2, rel=0.05)
    assert row["nees_per_dof_low"] > row["band_high"]
    assert row["share_in_gate_high"] < 0.9


def test_the_interval_over_runs_sees_drift_that_the_band_does_not() -> None:
    row = nees_of_maps(made_up(20, 1.0, drift=0.5), np.random.default_rng(1)).iloc[0]
    interval = row["nees_per_dof_high"] - row["nees_per_dof_low"]
    assert interval > 5 * (row["band_high"] - row["band_low"])


def test_maps_without_truth_are_left_out() -> None:
    rows = made_up(2, 1.0).assign(n_landmarks=0, nees_mean=np.nan)
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
    """One of NEES 3 per degree of freedom and nine of 1 are 1.2; in the gate are none and all."""
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
