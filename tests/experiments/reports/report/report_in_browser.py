"""The report in a real browser. Run by `make browser-test`; `make test` leaves it out.

RESULT in the environment names a result folder to open as well as that of three robots, which is
enlarged until it is as large as that of the paper's scenario.
"""

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from experiments.evaluation import tables
from experiments.reports.figures.drawing import draw_all
from experiments.reports.report.document import write_report
from tests.helpers.report_page import HOSTILE, hostile

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
MAX_LOAD_S = 3.0
MAX_BYTES = 20_000_000
WIDTHS = {"laptop": (1280, 900), "phone": (390, 844)}


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


def enlarge(result: Path, landmarks: int = 20, iterations: int = 10) -> None:
    """Repeat each landmark of a history, then all that has an iteration."""
    for name in tables.ALL:
        file = tables.table_path(result, name)
        rows = tables.read(file, name)
        if name == "map_history":
            rows = pd.concat([rows] * landmarks).sort_values(["robot", "iteration"])
            rows["landmark"] = rows.groupby(["robot", "iteration"]).cumcount()
        if "iteration" in rows and name != "tracks":
            period = rows["iteration"].max() + 1
            repeated = [
                rows.assign(iteration=rows["iteration"] + k * period) for k in range(iterations)
            ]
            rows = pd.concat(repeated)
        tables.write(file, name, rows)


@pytest.fixture(scope="session", params=["enlarged", "RESULT"])
def report(
    request: pytest.FixtureRequest, trio_result: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A report as large as the paper's, and that of the user's own result."""
    output = tmp_path_factory.mktemp("report") / "report.html"
    if request.param == "RESULT":
        if "RESULT" not in os.environ:
            pytest.skip("no RESULT given")
        return write_report(Path(os.environ["RESULT"]), output)
    result = Path(shutil.copytree(trio_result, output.with_name("result")))
    draw_all(result, 1)
    enlarge(result)
    return write_report(result, output)


class Opened:
    """A page with all that it asked for and complained of."""

    def __init__(self, browser: Browser, file: Path, **options: Any) -> None:
        self.page: Page = browser.new_page(**options)
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(file.as_uri(), wait_until="load")

    def wait_for_charts(self) -> None:
        """Charts are drawn once the page is there, that of the times last."""
        self.page.wait_for_selector("#chart-times .main-svg", timeout=60_000)

    def _heard(self, message: Any) -> None:
        if message.type in {"error", "warning"}:
            self.complaints.append(message.text)

    def scroll_through(self) -> None:
        """Show all parts of the page, one after the other."""
        self.wait_for_charts()
        height = self.page.evaluate("document.documentElement.scrollHeight")
        for y in range(0, height, 600):
            self.page.evaluate(f"scrollTo(0, {y})")
            self.page.wait_for_timeout(60)

    @property
    def fetched(self) -> list[str]:
        return [url for url in self.requests if not url.startswith(("data:", "blob:"))]


@pytest.fixture
def opened(browser: Browser, report: Path) -> Iterator[Opened]:
    found = Opened(browser, report, viewport={"width": 1280, "height": 900})
    found.wait_for_charts()
    yield found
    found.page.close()


PLAN = "document.getElementById('chart-map')"


def drawn(page: Page) -> str:
    """Return all that the map draws."""
    page.wait_for_timeout(300)
    return page.evaluate(f"{PLAN}.querySelector('.cartesianlayer').innerHTML")


def choose(page: Page, label: str) -> None:
    """Choose a pair of robots and an alignment in the map's menu."""
    page.locator("#chart-map .updatemenu-header").first.click()
    button = page.locator("#chart-map .updatemenu-dropdown-button", has_text=label)
    button.first.dispatch_event("click")


def test_it_is_small_enough(report: Path) -> None:
    size = report.stat().st_size
    print(f"\n{report}: {size / 1e6:.1f} MB")  # noqa: T201  # the figures to report
    assert size < MAX_BYTES


def test_it_opens_in_time(browser: Browser, report: Path) -> None:
    """Until page and map are there; the least of three: other work can only add to it."""
    found, charts = [], []
    for _ in range(3):
        opened = Opened(browser, report)
        timing = "performance.getEntriesByType('navigation')[0].loadEventEnd"
        found.append(opened.page.evaluate(timing) / 1000)
        opened.wait_for_charts()
        charts.append(opened.page.evaluate("performance.now()") / 1000)
        opened.page.close()
    print(f"\nfirst chart drawn after {min(charts):.2f} s")  # noqa: T201  # likewise
    print(f"\nloaded after {', '.join(f'{seconds:.2f}' for seconds in found)} s")  # noqa: T201  # the figures to report
    assert min(found) < MAX_LOAD_S


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_nothing_is_fetched_and_nothing_complains(
    browser: Browser, report: Path, width: str, theme: Any
) -> None:
    across, down = WIDTHS[width]
    opened = Opened(browser, report, viewport={"width": across, "height": down}, color_scheme=theme)
    opened.scroll_through()
    assert opened.complaints == []
    assert opened.fetched == [report.as_uri()]
    # nothing sticks out sideways
    assert opened.page.evaluate("document.documentElement.scrollWidth") == across
    assert opened.page.locator(".chart .main-svg").count() >= 4
    opened.page.close()


def test_each_frame_is_another_map(opened: Opened) -> None:
    page = opened.page
    names = page.evaluate(f"{PLAN}._transitionData._frames.map((frame) => frame.name)")
    seen = set()
    for name in (names[0], names[1], names[-1]):
        page.evaluate(
            f"""(name) => Plotly.animate({PLAN}, [name],
                {{ mode: "immediate", frame: {{ duration: 0, redraw: true }} }})""",
            name,
        )
        seen.add(drawn(page))
        assert f"iteration {name}" in (
            page.locator("#chart-map .slider-label").first.text_content() or ""
        )
    assert len(seen) == 3
    assert opened.complaints == []


def test_a_name_in_the_legend_hides_a_layer(opened: Opened) -> None:
    page = opened.page
    before = drawn(page)
    name = page.locator("#chart-map .traces", has_text="map of R1").last
    name.locator(".legendtoggle").dispatch_event("mousedown")
    name.locator(".legendtoggle").dispatch_event("mouseup")
    page.wait_for_timeout(600)  # a double click would do something else
    assert drawn(page) != before


def test_the_play_button_plays(opened: Opened) -> None:
    page = opened.page
    label = page.locator("#chart-map .slider-label").first
    before = label.text_content()
    page.evaluate(f"Plotly.animate({PLAN}, [{PLAN}._transitionData._frames[0].name])")
    page.wait_for_timeout(500)
    page.locator("#chart-map .updatemenu-button").first.dispatch_event("click")
    page.wait_for_timeout(1000)
    page.locator("#chart-map .updatemenu-button").last.dispatch_event("click")
    assert label.text_content() != before


def test_a_hidden_method_is_hidden_in_all_panels(opened: Opened) -> None:
    page = opened.page
    page.evaluate("document.getElementById('chart-errors').scrollIntoView()")

    def n_shown() -> int:
        return page.evaluate(
            """() => document.getElementById("chart-errors")._fullData.filter(
                (t) => t.legendgroup === "ransac" && t.visible === true).length"""
        )

    assert n_shown() == 8  # a median and a band in four panels
    toggle = page.locator("#chart-errors .legendtoggle").first
    toggle.dispatch_event("mousedown")
    toggle.dispatch_event("mouseup")
    page.wait_for_timeout(1000)
    assert n_shown() == 0


def test_a_click_on_the_errors_shows_those_maps(opened: Opened) -> None:
    page = opened.page
    iterations = page.evaluate("document.getElementById('chart-errors').data[1].x")
    page.evaluate(
        "(x) => document.getElementById('chart-errors').emit('plotly_click', {points: [{x}]})",
        iterations[0],
    )
    page.wait_for_timeout(1000)
    assert page.evaluate(f"{PLAN}._fullLayout._currentFrame") == str(iterations[0])


def test_another_pair_and_another_aligner(opened: Opened) -> None:
    page = opened.page
    labels = page.evaluate(f"{PLAN}.layout.updatemenus[0].buttons.map((each) => each.label)")
    seen = {drawn(page)}
    other = next((label for label in labels if "R1 – R3" in label), labels[-1])
    for label in (labels[3], other):  # as estimated by another aligner
        choose(page, label)
        seen.add(drawn(page))
    assert len(seen) == 3
    assert opened.complaints == []


def test_no_button_sends_data_away(opened: Opened) -> None:
    opened.scroll_through()
    titles = opened.page.evaluate(
        "[...document.querySelectorAll('.modebar-btn')].map((button) => button.dataset.title)"
    )
    assert "Download plot as a PNG" in titles
    assert not [title for title in titles if re.search("share|cloud|edit", title, re.IGNORECASE)]


def test_the_theme_is_that_of_the_system(opened: Opened) -> None:
    page = opened.page
    text = "document.getElementById('chart-errors')._fullLayout.font.color"
    background = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(f"[{background}, {text}]")
    page.emulate_media(color_scheme="dark")
    page.wait_for_timeout(3000)
    dark = page.evaluate(f"[{background}, {text}]")
    assert light[0] != dark[0]
    assert light[1] != dark[1]


@pytest.mark.parametrize("system", ["light", "dark"])
def test_the_first_click_on_the_switch_changes_the_theme(opened: Opened, system: Any) -> None:
    page = opened.page
    text = "document.getElementById('chart-errors')._fullLayout.font.color"
    seen = f"[getComputedStyle(document.body).backgroundColor, {text}]"
    page.emulate_media(color_scheme=system)
    page.wait_for_timeout(3000)
    shown = [page.evaluate(seen)]
    for _ in range(2):
        page.locator("#theme").click()
        page.wait_for_timeout(3000)
        shown.append(page.evaluate(seen))
    assert shown[0] == shown[2]
    assert all(before != after for before, after in zip(shown[0], shown[1], strict=True))


def test_the_table_of_methods_fits_a_wide_window(opened: Opened) -> None:
    opened.page.set_viewport_size({"width": 1400, "height": 900})
    table = "document.querySelector('.standings').parentElement"
    assert opened.page.evaluate(f"{table}.scrollWidth <= {table}.clientWidth")


def test_it_prints(opened: Opened, tmp_path: Path) -> None:
    pages = tmp_path / "report.pdf"
    opened.page.pdf(path=pages)
    assert pages.stat().st_size > 100_000
    assert opened.complaints == []


def test_hostile_names_stay_names(browser: Browser, trio_copy: Path) -> None:
    result = hostile(trio_copy)
    opened = Opened(browser, write_report(result), viewport={"width": 1280, "height": 900})
    opened.page.on("dialog", lambda dialog: opened.complaints.append(dialog.message))
    opened.scroll_through()
    panel = opened.page.locator("#chart-errors .nsewdrag").first
    panel.scroll_into_view_if_needed()
    panel.hover()
    opened.page.wait_for_function(
        "() => document.querySelector('#chart-errors .hoverlayer').textContent !== ''"
    )
    assert HOSTILE in opened.page.locator("h1").inner_text()
    assert HOSTILE in (opened.page.locator("#chart-errors .hoverlayer").text_content() or "")
    assert opened.page.locator("img[src=x]").count() == 0
    assert opened.complaints == []
    assert len(opened.fetched) == 1
    opened.page.close()
