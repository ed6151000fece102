"""Tests of the screens of `statistics` and `compare` on made-up tables."""

import numpy as np
import pandas as pd
import pytest

from experiments.reports.statistics_screen import print_comparison, print_summary
from experiments.studies.comparison import VersionComparison
from experiments.studies.statistics import Summary


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")


def with_interval(name: str, values: list[float], share: float) -> dict[str, list[float]]:
    low, high = ([value * factor for value in values] for factor in (1 - share, 1 + share))
    return {name: values, f"{name}_low": low, f"{name}_high": high}


def over_oracle() -> pd.DataFrame:
    aligners = ["icp", "ransac", "oracle"]
    rows = {"scenario": "hall", "aligner": aligners, "estimated_m": [0.4, 0.1, 0.05]}
    rows |= {"estimated_share": [0.75, 1, 1], "refined_share": [0.5, 1, 1]}
    rows |= {"refined_m": [0.06, 0.05, 0.05]} | with_interval("refined_ratio", [1.2, 1, 1], 0.1)
    return pd.DataFrame(rows | with_interval("estimated_ratio", [8.0, 2.0, 1.0], 0.25))


def compared() -> pd.DataFrame:
    rows = {"scenario": "hall", "first": ["icp"], "second": ["ransac"], "p_holm": [0.012]}
    rows |= with_interval("ratio", [4.0], 0.25) | with_interval("first_wins", [0.2], 0.5)
    return pd.DataFrame(rows)


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]


def summary(n_runs: int, n_worlds: int | None = None, **tables: pd.DataFrame) -> Summary:
    worlds = n_runs if n_worlds is None else n_worlds
    failed = pd.DataFrame({"scenario": ["hall"], "seed": [7], "reason": ["R1 hit a wall"]})
    return Summary(n_runs, worlds, tables, pd.DataFrame(), pd.DataFrame(), ("robots",), failed)


def test_the_best_method_is_held_against_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    made = summary(9, error_over_oracle=over_oracle(), methods_compared=compared())
    print_summary(made, None, [])
    lines = said(capsys)
    assert "icp 75% 0.400 8.00 (6.00–10.00)" in lines
    assert "icp 50% 0.060 1.20 (1.08–1.32)" in lines
    assert "ransac against each other method on the same maps, as estimated" in lines
    # icp's four times larger error, from the other side
    assert "icp 0.25 (0.20–0.33) 80% (70–90) 0.012" in lines
    assert lines[-2:] == ["failed, left out: hall seed 7: R1 hit a wall", "No run has: robots"]


@pytest.mark.parametrize(
    ("n_runs", "beginning"),
    [(1, "One run: the intervals are"), (5, "5 runs in 5 worlds (scenario and seed): bootstrap")],
)
def test_few_runs_are_a_caveat_and_tables_may_be_missing(
    n_runs: int, beginning: str, capsys: pytest.CaptureFixture[str]
) -> None:
    print_summary(summary(n_runs), None, ["figure 6: no times"])
    lines = said(capsys)
    assert lines[0].startswith(beginning)
    assert lines[-1] == "not drawn: figure 6: no times"


def test_success_counts_maps_without_common_ground_apart(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = {"scenario": "hall", "aligner": ["ransac"], "n_apart": [4], "n_maps": [24]}
    for name, share in (("estimated_success", 0.75), ("refined_success", 0.9), ("accepted", 0.8)):
        rows |= with_interval(name, [share], 0.1)
    rows |= with_interval("false_accepted", [0.0], 0.1) | with_interval("refused_apart", [1.0], 0.0)
    bins = {"scenario": "hall", "aligner": "ransac", "from": [0.0, 30.0], "to": [30.0, np.inf]}
    by_pairs = pd.DataFrame(bins | {"estimated_success": [0.5, 1.0]})
    tables = {"success_at_the_end": pd.DataFrame(rows), "success_by_true_pairs": by_pairs}
    print_summary(summary(9, **tables), None, [])
    lines = said(capsys)
    assert "ransac 75% (68–82) 90% (81–99)" in lines
    assert any("without the 4 of 24 pairs of maps that have no common" in line for line in lines)
    assert "ransac 80% (72–88) 0% (0–0) 100% (100–100)" in lines
    assert "method 0 30+" in lines
    assert "ransac 50% 100%" in lines


def test_what_got_worse_comes_first_and_all_is_counted(capsys: pytest.CaptureFixture[str]) -> None:
    columns = ["metric", "method", "scale", "a", "b", "change", "low", "high", "p", "verdict"]
    rows = [
        ("success refined", "icp", "share", 0.5, 0.9, 0.4, 0.3, 0.5, 0.001, "better"),
        ("time, s", "icp", "ratio", 0.01, 0.01, 1.0, 0.9, 1.1, 0.9, "no difference beyond noise"),
        ("path RMSE, m", "", "ratio", 0.1, 0.2, 2.0, 1.5, 2.5, 0.002, "worse"),
        ("true pairs", "oracle", "ratio", 40.0, 40.0, 1.0, 1.0, 1.0, np.nan, "identical"),
    ]
    table = pd.DataFrame(rows, columns=pd.Index(columns)).assign(n_better=[9, 4, 0, 0], n_units=9)
    found = VersionComparison(table, "run", 9, ("a note",))
    print_comparison(found, show_all=False, written=None)
    lines = said(capsys)
    shown = [line for line in lines if line.startswith(("path RMSE", "icp"))]
    assert shown == [
        "path RMSE, m 0.1 0.2 2.00 (1.50–2.50) 0 of 9 worse",
        "icp success refined 50% 90% +40% (+30 to +50) 9 of 9 better",
    ]
    ways = "1 worse, 1 better, 1 no difference beyond noise, 1 identical"
    assert lines[-2:] == [f"9 runs compared in 4 ways: {ways}", "a note"]
    assert any("5 % over 3 tests" in line for line in lines)
    print_comparison(found, show_all=True, written=None)
    assert "oracle true pairs 40 40 0 of 9 same" in said(capsys)


def test_many_runs_in_few_worlds_are_a_caveat(capsys: pytest.CaptureFixture[str]) -> None:
    print_summary(summary(20, n_worlds=2), None, [])
    assert any(line.startswith("20 runs in 2 worlds") for line in said(capsys))
    print_summary(summary(20, n_worlds=6), None, [])
    assert not any("worlds" in line for line in said(capsys))
