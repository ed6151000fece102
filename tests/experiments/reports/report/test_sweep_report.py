"""Tests of the report of a sweep: many runs, no maps."""

import re
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.helpers.made_up_sweep import write_sweep
from tests.helpers.report_page import Page, page_of
from tests.helpers.tiny_scenario import command


@pytest.fixture(scope="module")
def sweep(trio_result: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweeps") / "particles"
    return write_sweep(folder, trio_result, range(6), ("50", "200"))


@pytest.fixture(scope="module")
def page(sweep: Path) -> Page:
    return page_of(sweep, sweep.parent / "report.html")


def test_it_tells_of_all_runs(page: Page) -> None:
    words = " ".join(page.words.split())
    assert "Indicative: measured over 10 runs in 5 worlds" in words
    assert "slam.filter.n_particles" in words
    assert "0..4" in words  # the seeds that finished
    assert "Use ransac" in words


def test_intervals_count_runs_and_not_maps(page: Page) -> None:
    traces = page.charts["success"]["data"]
    own = next(each for each in traces if each["name"] == "ransac")
    sure = [seen for rate, seen in zip(own["y"], own["customdata"], strict=True) if rate == 100]
    assert max(n for _, _, n in sure) > 10
    # Wilson's lower end of 10 in 10 is 0.722, however many maps the ten runs hold
    for low, _, _ in sure:
        assert low == pytest.approx(72.2, abs=0.2)


def test_each_setting_has_its_curves(page: Page) -> None:
    menu = page.charts["errors"]["layout"]["updatemenus"][0]["buttons"]
    assert [each["label"] for each in menu] == [
        "made-up, n_particles 50",
        "made-up, n_particles 200",
    ]
    assert "map" not in page.charts
    assert "map" not in [a.get("id") for tag, a in page.tags if tag == "section"]


def test_failed_runs_are_named_with_their_reason(page: Page) -> None:
    assert "made-up-5-50" in page.words
    assert "<b>the disk</b> is full" in page.words
    assert not [tag for tag, _ in page.tags if tag == "b" and "disk" in tag]


def test_inspect_and_report_as_commands(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(capsys, "inspect", sweep)
    assert reply.code == 0
    assert ["errors", "10", "1650"] in [line.split() for line in reply.out.splitlines()]
    assert command(capsys, "report", sweep, "-o", tmp_path / "r.html").code == 0


def test_a_sweep_without_a_finished_run(
    trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_sweep(tmp_path / "all failed", trio_result, range(1), ("50",))
    reply = command(capsys, "report", folder)
    assert reply.code == 2
    assert "nothing to report on" in reply.complaints[0]


def test_the_better_value_of_a_setting_is_named(trio_result: Path, tmp_path: Path) -> None:
    sweep = write_sweep(tmp_path / "sweep", trio_result, range(8), ("50", "200"))
    for file in (sweep / "errors").glob("*-200.parquet"):
        rows = pq.read_table(file).to_pandas()
        lengths = [name for name in rows if name.endswith(("error_m", "error_rad"))]
        written = pa.Table.from_pandas(
            rows.assign(**{name: rows[name] / 2 for name in lengths}), preserve_index=False
        )
        pq.write_table(written.replace_schema_metadata(pq.read_schema(file).metadata), file)
    words = " ".join(page_of(sweep, tmp_path / "report.html").words.split())
    assert re.search(r"200 is better than 50: better in \d+ of \d+ measures, worse in none", words)
    assert "over 7 runs of each." in words  # the runs of the last seed failed
    assert "better7 of 7 runs" in words


def test_equal_values_are_called_equal(page: Page) -> None:
    words = " ".join(page.words.split())
    assert "No difference between 50 and 200 beyond noise" in words
    assert "over 5 runs of each. So few runs are a hint only; 6 seeds or more decide." in words
