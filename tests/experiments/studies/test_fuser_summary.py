"""Fusers over several runs: the last iteration of each alone counts, whatever the others'."""

import numpy as np
import pandas as pd
import pytest

from experiments.studies.statistics import fuser_summary


def made_up() -> pd.DataFrame:
    rows = [
        {"run_id": f"w-{run}", "fuser": fuser, "iteration": k, "landmark_rmse_m": value}
        for run, last in enumerate((30, 40, 50))
        for fuser, at_end in (("kalman", 0.4), ("plug-in", 0.2))
        for k, value in ((10, 9.0), (20, 8.0), (last, at_end + run / 100))
    ]
    others = ("over_better_filter", "nees_per_dof", "coverage_95")
    return pd.DataFrame(rows).assign(**dict.fromkeys(others, 1.0))


def test_medians_are_of_each_run_s_last_iteration() -> None:
    rows = fuser_summary(made_up(), np.random.default_rng(0)).set_index("fuser")
    assert list(rows.index) == ["kalman", "plug-in"]
    assert (rows["n_runs"] == 3).all()
    assert rows["landmark_rmse_m"].tolist() == pytest.approx([0.41, 0.21])
    assert (rows["landmark_rmse_m_low"] <= rows["landmark_rmse_m"]).all()
    assert (rows["landmark_rmse_m_high"] < 1).all()


def test_runs_that_fused_nothing_are_no_runs_of_a_fuser() -> None:
    assert fuser_summary(made_up().iloc[:0], np.random.default_rng(0)).empty
