"""The report's verdicts and rivals are those of the tables."""

import re
from pathlib import Path

from experiments.evaluation import tables
from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.report.document import verdicts_and_places
from tests.helpers.report_page import page_of


def test_verdicts_and_places_are_of_the_last_maps(trio_result: Path) -> None:
    rivals = tables.read(tables.table_path(trio_result, "rivals"), "rivals")
    estimates = tables.read(tables.table_path(trio_result, "estimates"), "estimates")
    found = list(verdicts_and_places(ResultTables(trio_result)))
    assert [each["robots"] for each in found] == ["R1 – R2", "R1 – R3", "R2 – R3"]
    last = estimates[estimates["iteration"] == estimates["iteration"].max()]
    ransac = last[(last["aligner"] == "ransac") & (last["repetition"] == 0)]
    assert [each["probability"] for each in found] == ransac["probability"].tolist()
    for each in found:
        a, b = each["robots"].split(" – ")
        own = rivals[(rivals["robot_a"] == a) & (rivals["robot_b"] == b) & (rivals["of"] == "a b")]
        own = own[own["iteration"] == rivals["iteration"].max()]
        assert len(each["places"]) == len(own)
        assert each["places"][0]["n_support"] == own["n_support"].iloc[0]


def test_they_stand_in_the_page(trio_result: Path, tmp_path: Path) -> None:
    words = re.sub(r"\s+", " ", page_of(trio_result, tmp_path / "r.html").words)
    assert "Where the maps fit each other" in words
    assert re.search("R2 – R3 ?accepted", words)
