"""Tests of the files that studies write."""

import csv
from io import StringIO
from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
import pytest

from experiments.reports import study_files
from experiments.reports.export import to_latex, to_markdown, write_tables
from experiments.reports.figures.result_tables import ResultTables
from experiments.studies.run_tables import find_runs
from experiments.studies.statistics import ALL_SCENARIOS, medians_of_run, summarise, time_bands
from tests.helpers.made_up_runs import (
    ITERATIONS,
    METHODS,
    scaled,
    tables_of,
    two_sweeps,
    write_result,
    write_rows,
    write_sweep,
)
from tests.helpers.tiny_scenario import command


@pytest.fixture(autouse=True)
def _eighty_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def test_screen_files_and_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep = write_sweep(tmp_path / "sweep", range(7))
    reply = command(capsys, "statistics", sweep, "-o", tmp_path / "out")
    assert reply.code == 0, reply.err
    for text in ("Right at the end of 7 runs", "over the oracle", "ransac against each other"):
        assert text in reply.out
    unknown = "path_statistics, team, team_pairs, landmark_nees, smoother, fusers, fusion"
    assert f"No run has: {unknown}" in " ".join(reply.out.split())
    assert max(map(len, reply.out.split("All ")[0].splitlines())) <= 80
    names = {path.name for path in (tmp_path / "out").iterdir()}
    for name in ("success_by_iteration", "error_over_oracle", "methods_compared"):
        assert {f"{name}.csv", f"{name}.md", f"{name}.tex"} <= names
    picture = matplotlib.image.imread(tmp_path / "out/figures/fig04_translation_error.png")
    assert picture.std() > 0.05
    assert (
        len(list((tmp_path / "out/figures").iterdir())) == 9
    )  # three figures, each as PNG, SVG and caption


def test_eighty_columns_hold_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is cut: the longest name, verdicts, and maps without common ground fit."""
    methods = {"ransac_mahalanobis": (1.0, 0.1, 0.0), "icp": (8.0, 0.8, 0.4)}
    made = {seed: tables_of(seed, methods=methods) for seed in range(8)}
    for seed in (6, 7):
        made[seed]["errors"]["n_common"] = 0
    sweep = write_sweep(tmp_path / "sweep", range(8), made=made)
    reply = command(capsys, "statistics", sweep)
    assert "without the 4 of 16 pairs of maps that have no common ground" in " ".join(
        reply.out.split()
    )
    assert "refused without" in reply.out
    assert "\N{HORIZONTAL ELLIPSIS}" not in reply.out
    assert "ransac_mahalanobis" in reply.out.split("Verdicts")[1].split("Right")[0]


@pytest.mark.usefixtures("quick_save")
def test_several_scenarios_and_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study_files, "_FIGURES", ("fig05_rotation_error",))  # one will do
    settings = [{"slam.particles": "50"}, {"slam.particles": "200"}]
    sweep = write_sweep(tmp_path / "sweep", range(2), settings, ("hall", "maze"))
    reply = command(capsys, "statistics", sweep, "-o", tmp_path / "out")
    assert reply.code == 0, reply.err
    assert "slam.particles" in reply.out
    table = pd.read_csv(tmp_path / "out/success_at_the_end.csv")
    assert list(table.columns[:2]) == ["scenario", "slam.particles"]
    assert table["scenario"].unique().tolist() == ["hall", "maze", ALL_SCENARIOS]
    together = table[table["scenario"] == ALL_SCENARIOS]
    assert (together["n_runs"] == 4).all()
    assert sorted(path.name for path in (tmp_path / "out/figures").iterdir()) == [
        f"{name}-slam.particles={n}" for name in ("hall", "maze") for n in (200, 50)
    ]


def test_a_single_run_is_weak_and_its_figures_are_elsewhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_result(tmp_path, 0, tables_of(0))
    reply = command(capsys, "statistics", folder, "-o", tmp_path / "out")
    assert "One run: the intervals are over the maps of one run" in reply.out
    assert "`mapfusion report --figures` draws it" in reply.out
    assert not (tmp_path / "out/figures").exists()


def test_failed_runs_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep = write_sweep(tmp_path / "sweep", range(2))
    run = {"run_id": "x", "scenario": "world", "seed": 9, "status": "failed", "reason": "[red]hit"}
    write_rows(sweep, "runs", "x", pd.DataFrame([run]))
    reply = command(capsys, "statistics", sweep)
    assert "failed, left out: world seed 9: [red]hit" in reply.out


def test_bad_paths_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (("statistics", tmp_path), ("compare", tmp_path, tmp_path)):
        reply = command(capsys, *arguments)
        assert reply.code == 2
        assert len(reply.complaints) == 1
        assert str(tmp_path) in reply.complaints[0]


@pytest.mark.parametrize(("factor", "code"), [(1.5, 1), (0.7, 0), (1.0, 0)])
def test_fail_if_worse(
    factor: float, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = two_sweeps(tmp_path, scaled(factor, "ransac"), seeds=8)
    assert command(capsys, "compare", a, b).code == 0
    reply = command(capsys, "compare", a, b, "--fail-if-worse", "-o", tmp_path / "out")
    assert reply.code == code
    assert ("worse" in reply.out.split("compared in")[0]) == (code == 1)
    assert "8 runs compared in" in reply.out
    table = pd.read_csv(tmp_path / "out/comparison.csv")
    assert len(table) == table.drop_duplicates(["metric", "method"]).shape[0]


def test_all_shows_what_did_not_change(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = two_sweeps(tmp_path, scaled(1.0, "ransac"), seeds=2)
    assert "odometry RMSE" not in command(capsys, "compare", a, b).out
    assert "odometry RMSE" in command(capsys, "compare", a, b, "--all").out


def test_same_runs_same_files_whatever_their_order(tmp_path: Path) -> None:
    folders = [write_result(tmp_path, seed, tables_of(seed)) for seed in range(4)]
    written = []
    for order in (folders, folders):
        made = summarise(find_runs(order)).tables
        written.append({name: table.to_csv() for name, table in made.items()})
    assert written[0] == written[1]


def test_exported_tables_can_be_read_back_and_names_are_escaped(tmp_path: Path) -> None:
    table = pd.DataFrame({"name": ["a|b", "c_d&e", 'x,"y'], "value": [1 / 3, np.nan, np.inf]})
    write_tables(tmp_path, {"made": table})
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "made.csv"), table)
    assert len(list(csv.reader(StringIO((tmp_path / "made.csv").read_text())))) == 4
    assert "| a\\|b   |  0.3333 |" in to_markdown(table)
    assert r"c\_d\&e" in to_latex(table)
    assert "& - " in to_latex(table)


def test_curves_over_runs_are_medians_of_run_medians(tmp_path: Path) -> None:
    from experiments.reports.figures.error_figures import draw_aligner_time, draw_translation_error

    folders = [write_result(tmp_path, seed, tables_of(seed)) for seed in range(5)]
    errors = find_runs(folders).read("errors")
    medians = pd.concat([medians_of_run(own) for _, own in errors.groupby("run_id")])
    timings = find_runs(folders).read("aligner_timings")
    data = ResultTables(tmp_path, {"errors": medians, "aligner_timings": timings})
    assert data.aligners == [*METHODS, "oracle"]
    axes = draw_translation_error(data).axes[0]
    line = next(line for line in axes.get_lines() if line.get_label() == "icp")
    own = errors[(errors["aligner"] == "icp") & (errors["robot_b"] == "R2")]
    for iteration, drawn in zip(ITERATIONS, np.asarray(line.get_ydata()), strict=True):
        at = own[own["iteration"] == iteration].groupby("run_id")["translation_error_m"].median()
        assert drawn == pytest.approx(at.median())
    legend = draw_translation_error(data).legends[0]
    assert "10-90 % of 5 runs, as here ransac's" in [text.get_text() for text in legend.get_texts()]
    assert len(draw_aligner_time(data).axes) == 2


def test_quantiles_of_groups_along_the_count() -> None:
    count, elapsed = np.repeat(np.arange(8), 10), np.tile(np.arange(10.0), 8)
    timings = pd.DataFrame({"aligner": "icp", "n_common": count, "elapsed_s": elapsed})
    bands = time_bands(timings, groups=8)
    np.testing.assert_array_equal(bands["n_common"], np.arange(8))
    np.testing.assert_array_equal(bands["elapsed_s"], np.full(8, 4.5))
    np.testing.assert_allclose(bands["elapsed_high_s"], 8.1)


def test_memory_does_not_grow_with_the_rows_of_a_run(tmp_path: Path) -> None:
    """A run is reduced to one row per map and method, whatever the number of repetitions."""
    folder = write_result(tmp_path, 0, tables_of(0, repetitions=50))
    runs = find_runs([folder])
    summary = summarise(runs)
    n_rows = len(runs.read("errors"))
    assert len(summary.run_medians) * 30 < n_rows
