"""Report as one HTML file: contents, safety of names, verdicts and rivals."""

import base64
import hashlib
import json
import re
from html import escape, unescape
from pathlib import Path

import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.reports.figures.drawing import draw_figure
from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.report.document import verdicts_and_places, write_report
from mapfusion.files import read_json, write_json
from tests.helpers.report_page import HOSTILE, Page, hostile, page_of
from tests.helpers.tiny_scenario import command, without_tables

MAX_BYTES = 20_000_000


@pytest.fixture(scope="module")
def page(trio_result: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    return page_of(trio_result, tmp_path_factory.mktemp("report") / "report.html")


def test_the_verdict_comes_first(page: Page) -> None:
    assert "Use ransac" in re.sub(r"\s+", " ", page.words)
    sections = [attributes["id"] for tag, attributes in page.tags if tag == "section"]
    assert sections[:3] == ["verdict", "errors", "map"]


def test_it_refers_to_nothing_outside(page: Page) -> None:
    policy = next(a["content"] for tag, a in page.tags if "http-equiv" in a)
    assert policy is not None
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    for tag, attributes in page.tags:
        assert tag not in {"link", "iframe", "object", "base"}
        for name in ("src", "href", "srcset", "action"):
            value = attributes.get(name) or ""
            assert value.startswith(("#", "data:image/png;base64,")) or not value
    assert sum(tag == "script" for tag, _ in page.tags) == 3  # data, Plotly, the lines that draw


def test_scripts_bear_the_hashes_of_the_policy(trio_result: Path, tmp_path: Path) -> None:
    text = write_report(trio_result, tmp_path / "r.html").read_text(encoding="utf-8")
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert len(scripts) == 2
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in unescape(text)


def test_names_are_escaped_everywhere(trio_copy: Path, page: Page) -> None:
    harmed = page_of(hostile(trio_copy), trio_copy / "report.html")
    assert [tag for tag, _ in harmed.tags].count("script") == 3
    assert not [a for _, a in harmed.tags if "onerror" in a]
    assert HOSTILE in harmed.words  # as text, whole
    # Plotly takes tags in texts for markup: no text of a chart holds one of a name
    drawn = {name: {**chart, "data": ()} for name, chart in harmed.charts.items()}
    names = [trace.get("name", "") for chart in harmed.charts.values() for trace in chart["data"]]
    assert escape(HOSTILE, quote=False) in names
    assert "<img" not in json.dumps([names, drawn])
    # the very tags of the same report with friendly names
    assert [tag for tag, _ in harmed.tags] == [tag for tag, _ in page.tags]


def test_numbers_that_json_does_not_know_are_left_out(trio_copy: Path) -> None:
    rows = tables.read(tables.table_path(trio_copy, "errors"), "errors")
    rows.loc[rows["aligner"] == "icp", "translation_error_m"] = float("inf")
    tables.write(tables.table_path(trio_copy, "errors"), "errors", rows)
    found = page_of(trio_copy, trio_copy / "r.html")

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    json.loads(found.json, parse_constant=refuse)


def test_fusers_stand_with_their_figures_and_how_to_read_them(trio_copy: Path) -> None:
    for name in ("fig11_fusers", "fig12_coverage"):
        draw_figure(ResultTables(trio_copy), name)
    page = page_of(trio_copy, trio_copy / "r.html")
    rows = tables.read(tables.table_path(trio_copy, "fusers"), "fusers")
    section = page.words.split("Maps of all robots together")[1]
    assert all(name in section for name in rows["fuser"])
    assert "Figure 11" in section
    assert "Below the diagonal a map is overconfident" in section
    assert "fusers" in [attributes.get("id") for tag, attributes in page.tags if tag == "section"]


def test_a_result_without_fusers_has_no_such_section(trio_copy: Path) -> None:
    without_tables(trio_copy, "fusers", "fuser_coverage")
    scenario = read_json(trio_copy / "scenario.json", "scenario")
    write_json(trio_copy / "scenario.json", scenario | {"expect": {"path_rmse_m": {"max": 9}}})
    page = page_of(trio_copy, trio_copy / "r.html")
    assert "fusers" not in [a.get("id") for tag, a in page.tags if tag == "section"]
    assert "All 1 expectations" in page.words  # the rest is measured all the same


@pytest.mark.parametrize("name", ["aligner_timings", "clouds", "fusion", "map_history"])
def test_without_a_table_the_rest_is_shown(name: str, trio_copy: Path) -> None:
    without_tables(trio_copy, name)
    assert "Use ransac" in re.sub(r"\s+", " ", page_of(trio_copy, trio_copy / "r.html").words)


def test_a_single_evaluated_iteration_is_enough(trio_copy: Path) -> None:
    for name in ("errors", "estimates", "correspondences", "true_pairs", "fused_history"):
        file = tables.table_path(trio_copy, name)
        rows = tables.read(file, name)
        tables.write(file, name, rows[rows["iteration"] == rows["iteration"].max()])
    charts = page_of(trio_copy, trio_copy / "r.html").charts
    assert len(charts["map"]["frames"]) == 1


def test_real_results_fit(tiny_result: Path, tmp_path: Path) -> None:
    page = page_of(tiny_result, tmp_path / "r.html")
    assert (tmp_path / "r.html").stat().st_size < MAX_BYTES
    assert "path_rmse_m" in page.words


def test_an_expectation_that_is_not_met_is_said(trio_copy: Path) -> None:
    scenario = read_json(trio_copy / "scenario.json", "scenario")
    scenario["expect"] = {"path_rmse_m": {"max": 0}, "odometry_rmse_m": {"min": 0}}
    write_json(trio_copy / "scenario.json", scenario)
    words = page_of(trio_copy, trio_copy / "r.html").words
    assert "1 of 2 expectations of the scenario are not met" in words
    assert "Runs that failed" not in words


def test_the_command_says_where_it_wrote(
    trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(capsys, "report", trio_result, "-o", tmp_path / "r.html")
    assert reply.code == 0
    assert str(tmp_path / "r.html") in reply.out.replace("\n", "")
    reply = command(capsys, "report", tmp_path)
    assert reply.code == 2
    assert len(reply.complaints) == 1
    assert str(tmp_path) in reply.complaints[0]


def test_a_damaged_table_is_named(trio_copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables.table_path(trio_copy, "map_history").write_bytes(b"PAR1 no more")
    reply = command(capsys, "report", trio_copy)
    assert reply.code == 2
    assert "map_history.parquet" in reply.complaints[0]


def test_a_result_without_alignments_says_so(
    trio_copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty: list[pd.DataFrame] = []
    for name in ("errors", "estimates"):
        tables.write(tables.table_path(trio_copy, name), name, empty)
    reply = command(capsys, "report", trio_copy)
    assert reply.code == 2
    assert "no pair of maps was aligned" in reply.complaints[0]


def test_absent_packages_are_no_failures(trio_copy: Path) -> None:
    rows = tables.read(tables.table_path(trio_copy, "errors"), "errors")
    own = rows["aligner"] == "impicp"
    rows.loc[own, ["status", "refined_status"]] = "absent"
    tables.write(tables.table_path(trio_copy, "errors"), "errors", rows)
    page = page_of(trio_copy, trio_copy / "r.html")
    assert "Not installed, so not evaluated: impicp." in page.words
    assert "impicp" not in [trace["name"] for trace in page.charts["errors"]["data"]]


def test_verdicts_and_places_are_of_the_last_maps(trio_result: Path) -> None:
    rivals = tables.read(tables.table_path(trio_result, "rivals"), "rivals")
    estimates = tables.read(tables.table_path(trio_result, "estimates"), "estimates")
    found = list(verdicts_and_places(ResultTables(trio_result)))
    assert [each["robots"] for each in found] == ["R1 – R2", "R1 – R3", "R2 – R3"]
    last = estimates[estimates["iteration"] == estimates["iteration"].max()]
    ransac = last[(last["aligner"] == "ransac") & (last["repetition"] == 0)]
    counts = [each["n_confirmed"] for each in found]
    assert counts == ransac["n_confirmed"].tolist()
    for each in found:
        a, b = each["robots"].split(" – ")
        own = rivals[(rivals["robot_a"] == a) & (rivals["robot_b"] == b) & (rivals["of"] == "a b")]
        own = own[own["iteration"] == rivals["iteration"].max()]
        assert len(each["places"]) == len(own)
        assert each["places"][0]["n_support"] == own["n_support"].iloc[0]


def test_they_stand_in_the_page(trio_result: Path, tmp_path: Path) -> None:
    words = re.sub(r"\s+", " ", page_of(trio_result, tmp_path / "r.html").words)
    assert "Verdicts and rival alignments" in words
    assert re.search("R2 – R3 ?accepted", words)
