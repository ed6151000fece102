"""The report and `mapfusion statistics` say the same of the same run."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.reports.report.charts import rounded
from experiments.reports.report.contents import contents_of
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
    assert printed == [aligner["name"] for aligner in contents["aligners"]]
    assert printed[-1] == "oracle"
    assert contents["absent"] == ["svd"]
    assert "svd" not in printed


def test_success_in_the_charts(contents: dict[str, Any], summary: Summary) -> None:
    assert {curves["label"] for curves in contents["success"]} == set(SUCCESS_TABLES)
    for curves in contents["success"]:
        table = with_ground(summary.tables[SUCCESS_TABLES[curves["label"]]])
        for aligner, own in curves["aligners"].items():
            rows = table[table["aligner"] == aligner]
            there = [place for place, n in enumerate(own["n"]) if n]
            for shown, column in (("rate", ""), ("low", "_low"), ("high", "_high")):
                printed = rounded(rows[f"refined_success{column}"])
                assert [own[shown][place] for place in there] == printed, (aligner, column)
            assert [own["n"][place] for place in there] == list(rows["n_maps"] - rows["n_apart"])


def test_success_in_the_ranking(contents: dict[str, Any], summary: Summary) -> None:
    table = with_ground(summary.tables["success_by_overlap"])
    for standing in contents["ranking"].standings:
        rows = table[table["aligner"] == standing.aligner]
        n_maps = rows["n_maps"] - rows["n_apart"]
        assert standing.n_maps == n_maps.sum()
        assert standing.rate == pytest.approx(np.average(rows["refined_success"], weights=n_maps))


def test_median_errors_against_the_iteration(contents: dict[str, Any], summary: Summary) -> None:
    table = summary.tables["errors_by_iteration"]
    for group in contents["groups"][:-1]:  # the last one pools the pairs of robots
        pair = group["label"].split(" – ")
        of_pair = table[(table["robot_a"] == pair[0]) & (table["robot_b"] == pair[1])]
        for aligner, curves in group["curves"]["aligners"].items():
            rows = of_pair[of_pair["aligner"] == aligner].sort_values("iteration")
            for curve, column in (
                ("translation_estimated", "translation_error_m"),
                ("translation_refined", "refined_translation_error_m"),
            ):
                assert curves[curve]["median"] == rounded(rows[column]), (aligner, column)


def test_errors_over_the_oracle(contents: dict[str, Any], summary: Summary) -> None:
    table = summary.tables["error_over_oracle"].set_index("aligner")
    for standing in contents["ranking"].standings:
        printed = table.loc[standing.aligner, "refined_ratio"]
        assert np.isfinite(printed)
        assert standing.over_oracle == pytest.approx(printed)
