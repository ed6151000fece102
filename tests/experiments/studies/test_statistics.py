"""Figures of many teams, against counts by hand; and what two versions are compared in."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.path_errors import STATISTICS
from experiments.studies.comparison import compare
from experiments.studies.intervals import wilson
from experiments.studies.statistics import team_alignments, team_paths
from mapfusion.fusion.team_graph import EdgeStatus
from tests.helpers import made_up_runs
from tests.helpers.made_up_runs import Tables, two_sweeps
from tests.helpers.tiny_scenario import command


def team_of(seed: int, rmse: float = 0.1) -> pd.DataFrame:
    """A table `team`: three of four robots merged, the others too few for a second map."""
    value = rmse * np.exp(0.1 * np.random.default_rng(seed).normal())
    row = {"component": 1, "n_robots": 3, "n_team": 4, "n": 99} | dict.fromkeys(STATISTICS, value)
    rows = [row | {"source": "final"}, row | {"source": "odometry", "rmse": 9.0}]
    return pd.DataFrame([*rows, row | {"source": "final", "component": 2, "rmse": 7.0}])


def pairs_of(seed: int, off_m: float = 0.1) -> pd.DataFrame:
    """A table `team_pairs`: right, right and not believed, wrong and believed, and apart."""
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
    """Of two believed one is right; of three that met one is right and believed."""
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
    """The team is three times as far off, and believes one more alignment, which is right."""
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
