"""The report and `mapfusion statistics` show the same numbers for the same run."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.reports.report.charts import rounded
from experiments.reports.report.document import contents_of
from experiments.studies.run_tables import find_runs
from experiments.studies.statistics import Summary, summarise

SUCCESS_TABLES = {
    "true pairs among the correspondences": "success_by_true_pairs",
    "share of false correspondences": "success_by_outliers",
    "common landmarks, share of the smaller map": "success_by_overlap_share",
    "iteration": "success_by_iteration",
}


@pytest.fixture(scope="module")
def result(trio_result: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps without common ground, others with too few true pairs, and an aligner not installed."""
    folder = tmp_path_factory.mktemp("same") / "result"
    shutil.copytree(trio_result, folder)
    path = tables.table_path(folder, "errors")
    rows = tables.read(path, "errors")
    first, second, third = np.unique(rows["iteration"])[:3]
    rows.loc[rows["iteration"] == first, ["n_common", "n_true"]] = [2, 0]
    rows.loc[rows["iteration"] == second, ["n_common", "n_true"]] = [10, 2]
    rows.loc[rows["iteration"] == third, ["n_common", "n_true"]] = [2, 4]
    rows.loc[rows["aligner"] == "svd", ["status", "refined_status"]] = "absent"
    tables.write(path, "errors", rows)
    return folder


@pytest.fixture(scope="module")
def contents(result: Path) -> dict[str, Any]:
    return contents_of(result)


@pytest.fixture(scope="module")
def summary(result: Path) -> Summary:
    return summarise(find_runs(result))


def with_ground(table: pd.DataFrame) -> pd.DataFrame:
    return table[table["n_maps"] > table["n_apart"]].sort_values("from")


def test_the_same_aligners_are_judged(contents: dict[str, Any], summary: Summary) -> None:
    printed = summary.tables["success_at_the_end"]["aligner"].unique().tolist()
    assert printed == list(contents["styles"])
    assert printed[-1] == "oracle"
    assert contents["absent"] == ["svd"]
    assert "svd" not in printed


def test_success_in_the_charts(contents: dict[str, Any], summary: Summary) -> None:
    figure = contents["charts"]["success"]
    labels = {axis.anchor: axis.title.text for axis in figure.select_xaxes()}
    assert set(labels.values()) == set(SUCCESS_TABLES)
    for trace in figure.data:
        table = with_ground(summary.tables[SUCCESS_TABLES[labels[trace.yaxis]]])
        rows = table[table["aligner"] == trace.name]
        low, high, n = np.array(trace.customdata, dtype=float).T
        there = n > 0
        for shown, column in ((np.array(trace.y, float), ""), (low, "_low"), (high, "_high")):
            printed = 100 * rows[f"refined_success{column}"]
            np.testing.assert_allclose(shown[there], printed, rtol=1e-4, err_msg=trace.name)
        assert n[there].tolist() == list(rows["n_maps"] - rows["n_apart"])


def test_success_in_the_ranking(contents: dict[str, Any], summary: Summary) -> None:
    table = with_ground(summary.tables["success_by_overlap"])
    for standing in contents["ranking"].standings:
        rows = table[table["aligner"] == standing.aligner]
        n_maps = rows["n_maps"] - rows["n_apart"]
        assert standing.n_maps == n_maps.sum()
        assert standing.rate == pytest.approx(np.average(rows["refined_success"], weights=n_maps))


def test_median_errors_against_the_iteration(contents: dict[str, Any], summary: Summary) -> None:
    table = summary.tables["errors_by_iteration"]
    figure = contents["charts"]["errors"]
    buttons = figure.layout.updatemenus[0].buttons
    for button in buttons[:-1]:  # the last one pools the pairs of robots
        pair = button.label.split(" – ")
        of_pair = table[(table["robot_a"] == pair[0]) & (table["robot_b"] == pair[1])]
        for place, trace in enumerate(figure.data):
            rows = of_pair[of_pair["aligner"] == trace.name].sort_values("iteration")
            column = {
                "translation_estimated": "translation_error_m",
                "translation_refined": "refined_translation_error_m",
            }.get(trace.meta)
            if column:
                assert list(button.args[0]["y"][place]) == rounded(rows[column]), trace.name
                assert list(button.args[0]["x"][place]) == list(rows["iteration"])


def test_errors_over_the_oracle(contents: dict[str, Any], summary: Summary) -> None:
    table = summary.tables["error_over_oracle"].set_index("aligner")
    for standing in contents["ranking"].standings:
        printed = table.loc[standing.aligner, "refined_ratio"]
        assert np.isfinite(printed)
        assert standing.over_oracle == pytest.approx(printed)
