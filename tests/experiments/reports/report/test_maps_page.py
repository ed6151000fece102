"""Page and picture of `align` and `merge`: what they hold, safety of names, and files."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mapfusion
from experiments.reports.report.maps_page import plans_figure, write_pictures
from mapfusion.landmark_map import LandmarkMap, write_map
from tests.helpers.tiny_scenario import command
from tests.mapfusion.align.map_pairs import landmarks, unit_vectors

HOSTILE = "<script>alert(1)</script>"


@pytest.fixture
def maps(tmp_path: Path) -> list[Path]:
    """Two maps of the same points, and one of other points, with a hostile name."""
    rng = np.random.default_rng(0)
    p, look = rng.uniform(0, 20, (30, 3)) * [1, 1, 0], unit_vectors(rng, 60)

    def write(name: str, position_m: np.ndarray, looks: np.ndarray, called: str) -> Path:
        own: LandmarkMap = landmarks(position_m, 0.02, looks, planar=True, name=called)
        write_map(tmp_path / f"{name}.parquet", own)
        return tmp_path / f"{name}.parquet"

    moved = p[rng.permutation(30)]
    order = [int(np.flatnonzero((p == each).all(axis=1))[0]) for each in moved]
    return [
        write("a", p, look[:30], "a"),
        write("b", moved - [2, 1, 0], look[:30][order], "b"),
        write("c", rng.uniform(0, 20, (30, 3)) * [1, 1, 0], look[30:], HOSTILE),
    ]


def data_of(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    (found,) = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL
    )
    return json.loads(found)


def test_align_writes_a_page_and_a_picture(
    maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, picture = tmp_path / "deep" / "r.html", tmp_path / "r.png"
    words = ("align", *maps[:2], "--report", page, "--plot", picture, "--aligner", "ransac")
    reply = command(capsys, *words)
    assert reply.code == 0, reply.err
    text = page.read_text(encoding="utf-8")
    assert reply.out.splitlines()[-1] in re.sub(r"&gt;", ">", text)  # the advice
    figure = data_of(page)["charts"]["map"]
    names = [trace["name"] for trace in figure["data"]]
    assert "supporting correspondences: 30" in names
    assert {"a: 30 landmarks", "b: 30 landmarks"} <= set(names)
    assert re.search(r"default-src &#39;none&#39;|default-src 'none'", text)
    outside = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert "http" not in outside.replace("http-equiv", "")
    assert Image.open(picture).size[0] > 1000
    before = picture.read_bytes(), page.read_bytes()
    assert command(capsys, *words).code == 0
    assert picture.read_bytes() == before[0]
    assert data_of(page)["charts"] == json.loads(json.dumps(data_of(page)["charts"]))


def test_merge_draws_also_what_it_does_not_merge(
    maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, fused = tmp_path / "r.html", tmp_path / "f.g2o"
    reply = command(capsys, "merge", *maps, "-o", fused, "--report", page)
    assert reply.code == 0, reply.err
    assert fused.is_file()
    figure = data_of(page)["charts"]["map"]
    buttons = figure["layout"]["updatemenus"][0]["buttons"]
    assert len(buttons) == 4  # the fused map, and three pairs
    assert HOSTILE not in page.read_text(encoding="utf-8").replace(json.dumps(HOSTILE), "")
    nothing = command(capsys, "merge", maps[0], maps[2], "-o", tmp_path / "g.csv", "--report", page)
    assert nothing.code == 1
    assert not (tmp_path / "g.csv").exists()
    assert "Not merged" in page.read_text(encoding="utf-8")


def test_the_menu_shows_the_traces_of_one_plan(maps: list[Path]) -> None:
    plans = mapfusion.merge_maps(maps).plans()
    figure = plans_figure(plans).to_plotly_json()
    traces: list[Any] = [*plans_figure(plans).data]
    shown = [
        button["args"][0]["visible"] for button in figure["layout"]["updatemenus"][0]["buttons"]
    ]
    assert (np.sum(shown, axis=0) == 1).all()  # each trace belongs to one plan
    assert [trace["visible"] for trace in figure["data"]] == shown[0]
    n_points = [len(part.position_m) for plan in plans for part in plan.parts]
    markers = [
        len(trace["x"])
        for trace in traces
        if trace["mode"] == "markers" and trace["marker"]["symbol"] != "circle-open"
    ]
    assert markers == n_points


def test_pages_and_pictures_that_cannot_be_written_are_named(
    maps: list[Path], tmp_path: Path
) -> None:
    (tmp_path / "r.png").mkdir()
    found = [mapfusion.align_maps(*maps[:2])]
    with pytest.raises(mapfusion.InputError, match=r"r\.png"):
        write_pictures(None, tmp_path / "r.png", found, maps[:2], 0)
