"""Tests of each figure, on ordinary and on degenerate results."""

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image

from experiments.evaluation import tables
from experiments.evaluation.loop_closures import LoopClosure
from experiments.pipeline.workers import workers
from experiments.reports.figures import drawing
from experiments.reports.figures.drawing import FIGURES, Drawing, draw_all, draw_figure, save_figure
from experiments.reports.figures.error_figures import draw_coverage, draw_fusers
from experiments.reports.figures.map_figures import draw_two_maps
from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.figures.slam_figures import (
    ClosureSnapshots,
    choose_snapshots,
    spread_over_time,
)
from experiments.reports.figures.style import aligner_styles, house_style
from mapfusion.errors import InputError

MAX_SVG_BYTES = 1_000_000


def change(folder: Path, name: str, rows: pd.DataFrame) -> None:
    tables.write(tables.table_path(folder, name), name, rows)


def test_all_figures_are_drawn(trio_copy: Path) -> None:
    done = []
    files, skipped, elapsed_s = draw_all(trio_copy, 1, lambda n, total: done.append((n, total)))
    assert tuple(elapsed_s) == FIGURES
    assert min(elapsed_s.values()) > 0
    assert [file.name for file in files] == [
        f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")
    ]
    assert done == [(n + 1, 13) for n in range(13)]
    assert skipped == []
    for file in files:
        if file.suffix == ".png":
            picture = matplotlib.image.imread(file)
            assert picture.shape[1] > 800
            assert (picture[..., :3].min(axis=2) < 0.9).mean() > 0.01  # ink
        else:
            assert file.stat().st_size < MAX_SVG_BYTES
    assert sorted(file.name for file in (trio_copy / "figures").iterdir()) == sorted(
        [*(file.name for file in files), *(f"{name}.txt" for name in FIGURES), "drawn.json"]
    )
    recorded = json.loads((trio_copy / "figures" / "drawn.json").read_text())["figures"]
    assert list(recorded) == sorted(FIGURES)  # whichever was drawn first


@pytest.mark.parametrize("name", ["fig01_tracks", "fig06_aligner_time", "fig08_fused_landmark"])
def test_pictures_are_the_same_byte_for_byte(name: str, trio_result: Path, tmp_path: Path) -> None:
    """Also when the user's own settings differ."""
    digests = []
    for i, user in enumerate(({}, {"font.size": 20, "svg.hashsalt": None, "axes.facecolor": "y"})):
        folder = Path(shutil.copytree(trio_result, tmp_path / str(i)))
        with matplotlib.rc_context(user):
            files = draw_figure(ResultTables(folder), name).files
        digests.append([hashlib.sha256(file.read_bytes()).hexdigest() for file in files])
    assert digests[0] == digests[1]


def test_a_png_is_what_matplotlib_saves_and_knows_its_resolution(tmp_path: Path) -> None:
    def draw() -> Figure:
        figure = Figure(figsize=(3, 2), facecolor="#FFE8C0")
        axes = figure.subplots()
        axes.plot([0, 1, 3], [2, 1, 5], color="#D55E00", label="a line")
        axes.imshow(np.linspace(0, 1, 12).reshape(3, 4))
        axes.legend()
        return figure

    png, _ = save_figure(tmp_path, "ours", draw)
    with house_style():
        draw().savefig(tmp_path / "theirs.png", dpi=200)
    with Image.open(png) as ours, Image.open(tmp_path / "theirs.png") as theirs:
        assert ours.size == (600, 400)
        np.testing.assert_array_equal(ours.convert("RGB"), theirs.convert("RGB"))
        assert ours.info["dpi"] == pytest.approx((200, 200), abs=0.01)


def test_users_settings_come_back() -> None:
    with matplotlib.rc_context({"font.size": 17}):
        before = dict(matplotlib.rcParams)
        with house_style():
            assert matplotlib.rcParams["font.size"] < 10
        assert dict(matplotlib.rcParams) == before


def skipped_figures(folder: Path) -> dict[str, str]:
    files, lines, _ = draw_all(folder, 1)
    reasons = dict(line.split(": ", 1) for line in lines)
    assert not any("\n" in line for line in lines)
    drawn = {file.stem for file in files}
    assert drawn | set(reasons) == set(FIGURES)
    assert drawn.isdisjoint(reasons)
    assert {file.stem for file in (folder / "figures").glob("fig*")} == drawn
    return reasons


@pytest.mark.usefixtures("quick_save")
def test_one_robot_has_no_pairs_to_show(trio_copy: Path) -> None:
    data = ResultTables(trio_copy)
    for name in tables.ALL:
        rows = data.table(name)
        if "robot" in rows:
            change(trio_copy, name, rows[rows["robot"] == "R1"])
        elif "robot_a" in rows or "fuser" in rows:
            change(trio_copy, name, rows.iloc[:0])
    reasons = skipped_figures(trio_copy)
    of_pairs = [name for name in FIGURES if name[3:5] >= "04" and name != "fig13_team"]
    assert sorted(reasons) == of_pairs
    assert reasons["fig04_translation_error"] == "no robot pair was aligned"


@pytest.mark.usefixtures("quick_save")
def test_of_older_results_all_but_the_fusers_is_drawn(trio_copy: Path) -> None:
    for name in ("fusers", "fuser_coverage"):
        tables.table_path(trio_copy, name).unlink()
    assert list(skipped_figures(trio_copy)) == ["fig11_fusers", "fig12_coverage"]


def test_each_fuser_has_a_line_of_its_own_a_plug_in_s_too(trio_copy: Path) -> None:
    data = ResultTables(trio_copy)
    names = {"kalman": "mine", "joint": "theirs"}
    changed = {name: data.table(name) for name in ("fusers", "fuser_coverage")}
    for name, rows in changed.items():
        change(trio_copy, name, rows.assign(fuser=rows["fuser"].replace(names)))
    for draw in (draw_fusers, draw_coverage):
        figure = draw(ResultTables(trio_copy))
        fusers = list(dict.fromkeys(changed["fusers"]["fuser"].replace(names)))
        labels = [text.get_text() for text in figure.legends[0].get_texts()]
        assert [label for label in labels if label in fusers] == fusers
        looks = {(line.get_color(), line.get_marker()) for line in figure.axes[0].lines}
        assert len(looks) >= len(fusers)


@pytest.mark.usefixtures("quick_save")
def test_imported_logs_have_no_images_and_no_walls(trio_copy: Path) -> None:
    shutil.rmtree(trio_copy / "keyframes")
    change(trio_copy, "tracks", ResultTables(trio_copy).table("tracks").iloc[:0])
    (trio_copy / "world.json").unlink()
    assert list(skipped_figures(trio_copy)) == ["fig01_tracks"]


@pytest.mark.usefixtures("quick_save")
def test_nothing_is_drawn_of_what_failed(trio_copy: Path) -> None:
    """All alignments degenerate, nothing fused; pictures of an earlier result disappear."""
    for name in FIGURES:
        (trio_copy / "figures").mkdir(exist_ok=True)
        (trio_copy / "figures" / f"{name}.png").write_bytes(b"old")
    data = ResultTables(trio_copy)
    for name in ("errors", "smoothed_errors"):
        errors = data.table(name).assign(status="degenerate", refined_status="degenerate")
        numbers = [column for column in errors if str(column).endswith(("error_m", "error_rad"))]
        change(trio_copy, name, errors.assign(**dict.fromkeys(numbers, np.nan)))
    for name in ("correspondences", "fused", "fused_map", "aligner_timings"):
        change(trio_copy, name, data.table(name).iloc[:0])
    assert list(skipped_figures(trio_copy)) == [
        name for name in FIGURES if "04" <= name[3:5] <= "10"
    ]


def test_the_two_maps_are_drawn_in_one_scale(trio_result: Path) -> None:
    figure = draw_two_maps(ResultTables(trio_result))
    spans = [[np.ptp(a.get_xlim()), np.ptp(a.get_ylim())] for a in figure.axes]
    np.testing.assert_allclose(spans[0], spans[1])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [label for label in labels if re.search(r"particles at k = \d+, spread x\d+", label)]
    assert all("(seen 3 times or more)" in axes.get_title() for axes in figure.axes)


def test_the_maps_in_space_fill_their_page(trio_copy: Path) -> None:
    png, _ = draw_figure(ResultTables(trio_copy), "fig07_correspondences").files
    ink = matplotlib.image.imread(png)[..., :3].min(axis=2) < 0.99
    height, width = ink.shape
    assert np.ptp(np.flatnonzero(ink.any(axis=0))) > 0.95 * width
    assert np.ptp(np.flatnonzero(ink.any(axis=1))) > 0.95 * height
    gaps = np.diff(np.flatnonzero(ink.any(axis=1)))
    assert gaps.max() < 0.1 * height


def test_missing_table_is_an_error_that_names_the_file(trio_copy: Path) -> None:
    for name in ("fused", "fused_map"):
        tables.table_path(trio_copy, name).unlink()
    with pytest.raises(InputError, match=r"fused\.parquet: no such file"):
        draw_figure(ResultTables(trio_copy), "fig10_fused_map")


def test_damaged_key_frame_is_an_error_that_names_the_file(trio_copy: Path) -> None:
    next((trio_copy / "keyframes").glob("R1_*")).write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"R1_\d{5}\.png: damaged or not a PNG picture"):
        draw_figure(ResultTables(trio_copy), "fig01_tracks")


THREE = ("fig01_tracks", "fig08_fused_landmark", "fig10_fused_map")


def redrawn(folder: Path) -> set[str]:
    """Draw what has changed; the figures whose pictures were written again."""
    before = {file: file.stat().st_mtime_ns for file in (folder / "figures").glob("fig*")}
    with workers(1) as pool:
        drawn = Drawing(pool).finish(folder)
    assert [file.name for file in drawn.files] == [
        f"{name}.{kind}" for name in drawing.FIGURES for kind in ("png", "svg")
    ]
    return {file.stem for file in drawn.files if file.stat().st_mtime_ns != before.get(file)}


@pytest.mark.usefixtures("quick_save")
def test_a_figure_is_drawn_again_only_if_what_it_depends_on_has_changed(
    trio_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "FIGURES", THREE)
    assert redrawn(trio_copy) == set(THREE)
    assert redrawn(trio_copy) == set()
    fused = ResultTables(trio_copy).table("fused_map")
    change(trio_copy, "fused_map", fused.assign(x_m=fused["x_m"] + 0.01))
    assert redrawn(trio_copy) == {"fig10_fused_map"}
    next((trio_copy / "keyframes").glob("*.png")).unlink()
    assert redrawn(trio_copy) == set(THREE)  # the rule takes key frames for an input of each
    (trio_copy / "figures" / "fig01_tracks.svg").unlink()
    (trio_copy / "figures" / "fig08_fused_landmark.png").write_bytes(b"damaged")
    assert redrawn(trio_copy) == {"fig01_tracks", "fig08_fused_landmark"}
    monkeypatch.setattr(drawing, "source_hash", lambda parts: "of another version")
    assert redrawn(trio_copy) == set(THREE)
    for content in ("no JSON", "{}", '{"figures": [1]}', '{"figures": {"fig01_tracks": 1}}'):
        (trio_copy / "figures" / "drawn.json").write_text(content)
        assert redrawn(trio_copy) == set(THREE)
    assert redrawn(trio_copy) == set()


def test_a_figure_without_data_is_remembered_with_its_reason(
    trio_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "FIGURES", ("fig11_fusers",))
    tables.table_path(trio_copy, "fusers").unlink()
    told = []
    for _ in range(2):
        with workers(1) as pool:
            told.append(Drawing(pool).finish(trio_copy))
    assert told[0] == told[1]
    assert told[0].files == []
    assert len(told[0].skipped) == 1


class _Asked:
    """Pool that records the submitted tasks and runs none."""

    def __init__(self) -> None:
        self.tags: list[str] = []

    def submit(self, tag: str, *_: object) -> None:
        self.tags.append(tag)


def test_a_figure_is_begun_once_all_that_it_reads_is_written(tmp_path: Path) -> None:
    pool: Any = _Asked()
    drawing = Drawing(pool)
    begun = []
    parts = ("tracks", "fusers", "paths", "robots", "sightings", "clouds", "robots", "scenario")
    for part in parts:
        drawing.written(tmp_path, part)
        begun.append(list(pool.tags))
    with_fusers = ["fig11_fusers"]
    with_robots = [*with_fusers, "fig01_tracks"]
    with_clouds = [*with_robots, "fig03_dispersion"]
    assert begun == [[], *[with_fusers] * 2, *[with_robots] * 2, *[with_clouds] * 3]


def test_what_is_not_written_yet_is_not_read(trio_result: Path) -> None:
    data = ResultTables(trio_result, written=("robots",))
    assert len(data.robots) == 3
    for ask in (
        lambda: data.table("paths"),
        lambda: data.has("smoothed_paths"),
        lambda: data.scenario,
    ):
        with pytest.raises(LookupError, match="earlier run"):
            ask()


def test_workers_draw_the_same_pictures(trio_copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "FIGURES", ("fig08_fused_landmark", "fig10_fused_map"))
    alone = {file: file.read_bytes() for file in draw_all(trio_copy, 1).files}
    assert {file: file.read_bytes() for file in draw_all(trio_copy, 2).files} == alone


KNOWN = ["ransac", "svd", "svd-solved", "icp", "impicp", "gnc", "clique", "ransac_mahalanobis"]
KNOWN += ["opencv", "kiss_matcher", "oracle"]


def test_known_lines_differ_in_colour_and_marker_and_keep_their_look() -> None:
    styles = aligner_styles(KNOWN)
    for what in ("color", "marker"):
        assert len({styles[name][what] for name in KNOWN}) == len(KNOWN)
    assert styles["oracle"]["color"] == "#000000"
    assert aligner_styles(["icp", "plug-in"])["icp"] == styles["icp"]


def test_lines_of_unknown_aligners_differ_from_all() -> None:
    others = [f"plug-in {k}" for k in range(9)]
    styles = aligner_styles([*KNOWN, *others])
    assert len({str(styles[name]["linestyle"]) for name in others}) == 9
    assert len({styles[name]["marker"] for name in [*KNOWN, *others]}) == len(KNOWN) + 9
    many = aligner_styles([f"plug-in {k}" for k in range(99)])
    assert len({str(style) for style in many.values()}) == len(KNOWN) + 99
    assert many["plug-in 3"] == styles["plug-in 3"]


def spreads(robot: str, values: list[float]) -> pd.DataFrame:
    iteration = 10 * np.arange(len(values))
    return pd.DataFrame({"robot": robot, "iteration": iteration, "spread_m": values})


def test_moments_lie_before_and_after_the_closure_with_the_largest_fall() -> None:
    closures = [
        LoopClosure("R1", 50, 40, before_m=0.2, after_m=0.1),
        LoopClosure("R2", 60, 40, before_m=0.3, after_m=0.1),
    ]
    own = [0.9, 0.1, 0.5, 0.3, 0.2, 0.4, 0.1, 0.01, 0.2, 0.3, 0.05, 0.9]
    spread = pd.concat([spreads("R1", [0.2] * 12), spreads("R2", own)])
    snapshots = choose_snapshots(closures, spread)
    assert snapshots is not None
    # windows: 10 to 59 with values 0.1 0.5 0.3 0.2 0.4, and 60 to 109 with 0.1 0.01 0.2 0.3 0.05
    assert snapshots == ClosureSnapshots(closures[1], 30, 60)


def test_without_a_loop_closure_there_are_no_moments() -> None:
    assert choose_snapshots([], spreads("R1", [0, 0.1, 0.3, 0.01])) is None


def test_spread_is_the_root_mean_square_distance_from_the_mean() -> None:
    x = {("R1", 0): [1.0, 1.0, 1.0, 1.0], ("R1", 10): [0.0, 2.0, 2.0, 0.0]}
    rows = [
        {"robot": robot, "iteration": k, "x_m": value, "y_m": 3 * value}
        for (robot, k), values in x.items()
        for value in values
    ]
    spread = spread_over_time(pd.DataFrame(rows))
    assert spread["iteration"].tolist() == [0, 10]
    assert spread["spread_m"].tolist() == pytest.approx([0.0, np.sqrt(1 + 9)])
