"""Figures of errors and times: bands, shaded iterations, and methods that are not installed."""

import statistics
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from experiments.evaluation import tables
from experiments.evaluation.alignment_criteria import ANSWERABLE_PAIRS
from experiments.reports.figures.error_figures import (
    draw_aligner_time,
    draw_rotation_error,
    draw_translation_error,
)
from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.figures.style import aligner_styles
from experiments.studies.statistics import error_bands

COLUMNS = {
    draw_translation_error: "translation_error_m",
    draw_rotation_error: "rotation_error_rad",
}


def slow_medians(rows: list[dict], aligner: str, column: str) -> dict[int, float]:
    values: dict[int, list[float]] = {}
    for row in rows:
        if row["aligner"] == aligner:
            values.setdefault(row["iteration"], []).append(row[column])
    if not column.endswith("_rad"):  # no estimate is infinitely far off
        far = {k: [np.inf if np.isnan(v) else v for v in group] for k, group in values.items()}
        return {k: statistics.median(group) for k, group in far.items()}
    known = {k: [v for v in group if not np.isnan(v)] for k, group in values.items()}
    mostly = {k: 2 * len(known[k]) > len(group) for k, group in values.items()}
    return {k: statistics.median(known[k]) if mostly[k] else np.nan for k in values}


@pytest.mark.parametrize("draw", COLUMNS)
def test_drawn_lines_are_the_medians_of_the_repetitions(draw, trio_result: Path) -> None:
    data, error = ResultTables(trio_result), COLUMNS[draw]
    drawn_columns = (("errors", error), ("errors", f"refined_{error}"))
    drawn_columns += (("smoothed_errors", f"refined_{error}"),)
    panels = iter(draw(data).axes)
    for robot_a, robot_b in (("R1", "R2"), ("R1", "R3"), ("R2", "R3")):
        for table, column in drawn_columns:
            errors = data.table(table)
            pair = errors[(errors["robot_a"] == robot_a) & (errors["robot_b"] == robot_b)]
            rows = pair.to_dict("records")
            axes = next(panels)
            assert axes.get_title().startswith(f"{robot_a} - {robot_b}")
            drawn = {line.get_label(): line for line in axes.get_lines()}
            assert set(drawn) == set(data.aligners)
            for aligner, line in drawn.items():
                expected = slow_medians(rows, aligner, column)
                np.testing.assert_array_equal(line.get_xdata(), sorted(expected))
                np.testing.assert_allclose(
                    line.get_ydata(), [expected[k] for k in sorted(expected)], rtol=1e-12
                )


def test_of_many_pairs_those_with_most_to_go_by_are_drawn_and_it_is_said(
    trio_result: Path, tmp_path: Path
) -> None:
    """Twenty robots make 190 pairs; one of the last has more true pairs than all others."""
    errors = ResultTables(trio_result).table("errors")
    one = errors[(errors["robot_a"] == "R1") & (errors["robot_b"] == "R2")]
    many = [one.assign(robot_a=f"R{a}", robot_b=f"R{b}") for a in range(20) for b in range(a)]
    many[-2] = many[-2].assign(n_true=one["n_true"].max() + 1)
    many[-1] = many[-1].assign(translation_error_m=1e6)
    for name in ("scenario.json", "tables"):
        (tmp_path / name).symlink_to(trio_result / name)
    data = ResultTables(tmp_path)
    assert "robot pairs" not in draw_translation_error(data).get_supxlabel()
    data = ResultTables(tmp_path)
    data._tables["errors"] = data._tables["smoothed_errors"] = pd.concat(many)
    figure = draw_translation_error(data)
    assert "10 of 190 robot pairs" in figure.get_supxlabel()
    titles = [axes.get_title() for axes in figure.axes]
    assert len(titles) == 30
    assert titles[0].startswith("R1 - R0")
    assert titles[-4].startswith("R4 - R2")
    assert titles[-1].startswith("R19 - R17")
    assert figure.axes[0].get_ylim()[1] < 1e6  # of what is drawn


def test_band_holds_the_middle_four_fifths(trio_result: Path) -> None:
    errors = ResultTables(trio_result).table("errors")
    for row in error_bands(errors).to_dict("records"):
        keys = ("robot_a", "robot_b", "aligner", "iteration")
        values = errors[np.all([errors[key] == row[key] for key in keys], axis=0)]
        expected = np.quantile(values["translation_error_m"], [0.1, 0.9])
        found = [row["translation_error_m_low"], row["translation_error_m_high"]]
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_legend_shows_bands_and_shades_that_occur(trio_result: Path, tmp_path: Path) -> None:
    errors = ResultTables(trio_result).table("errors")
    path = tables.table_path(tmp_path, "errors")

    def explained(rows: pd.DataFrame) -> dict[str, str]:
        tables.write(path, "errors", rows)
        (legend,) = draw_translation_error(ResultTables(tmp_path)).legends
        patches = list(legend.get_patches())
        texts = [each.get_text() for each in legend.get_texts()][-len(patches) :]
        return {t: to_hex(p.get_facecolor()) for t, p in zip(texts, patches, strict=True)}

    assert explained(errors.assign(n_true=9)) == {
        "10-90 % of repetitions, as here icp's": aligner_styles(["icp"])["icp"]["color"].lower()
    }
    alike = errors.assign(n_true=9)[errors["aligner"].isin(["ransac", "oracle"])]
    tables.write(path, "errors", alike[alike["repetition"] == 0].assign(n_true=0))
    (legend,) = draw_translation_error(ResultTables(tmp_path)).legends
    assert [each.get_text() for each in legend.get_texts()][2:] == ["< 3 true pairs"]


def shaded(figure: Figure, panel: int) -> list[tuple[float, float]]:
    spans = [patch for patch in figure.axes[panel].patches if isinstance(patch, Rectangle)]
    return [(span.get_x(), span.get_x() + span.get_width()) for span in spans]


@pytest.mark.parametrize(
    ("n_true", "expected"),
    [
        ([0, 2, 3, 9], [(-5, 15)]),
        ([3, 3, 3, 3], []),
        ([2, 3, 2, 2], [(-5, 5), (15, 35)]),
        ([9, 9, 9, 1], [(25, 35)]),
    ],
)
def test_iterations_with_too_few_true_pairs_are_shaded(
    n_true: list[int], expected: list[tuple[float, float]], trio_result: Path, tmp_path: Path
) -> None:
    assert ANSWERABLE_PAIRS == 3
    errors = ResultTables(trio_result).table("errors")
    few = errors[(errors["robot_a"] == "R1") & (errors["robot_b"] == "R2")].copy()
    keep = sorted(few["iteration"].unique())[: len(n_true)]
    few = few[few["iteration"].isin(keep)]
    place = few["iteration"].map({k: i for i, k in enumerate(keep)})
    few = few.assign(iteration=10 * place, n_true=[n_true[i] for i in place])
    tables.write(tables.table_path(tmp_path, "errors"), "errors", few)
    figure = draw_translation_error(ResultTables(tmp_path))
    assert np.ravel(shaded(figure, 0)) == pytest.approx(np.ravel(expected))


MEASURED = {
    "errors": [
        "translation_error_m",
        "rotation_error_rad",
        "refined_translation_error_m",
        "refined_rotation_error_rad",
    ],
    "aligner_timings": ["elapsed_s", "elapsed_low_s", "elapsed_high_s"],
}


@pytest.fixture
def without_svd(trio_copy: Path) -> ResultTables:
    for name, columns in MEASURED.items():
        path = tables.table_path(trio_copy, name)
        rows = tables.read(path, name)
        own = rows["aligner"] == "svd"
        assert own.any()
        rows.loc[own, columns] = np.nan
        if name == "errors":
            rows.loc[own, ["status", "refined_status"]] = "absent"
        tables.write(path, name, rows)
    return ResultTables(trio_copy)


@pytest.mark.parametrize("draw", [draw_translation_error, draw_rotation_error, draw_aligner_time])
def test_legends_say_absent(draw, trio_result: Path, without_svd: ResultTables) -> None:
    def labels(data: ResultTables) -> list[str]:
        return [text.get_text() for text in draw(data).legends[0].get_texts()]

    before, after = labels(ResultTables(trio_result)), labels(without_svd)
    assert "svd" in before
    assert after == ["svd (absent)" if label == "svd" else label for label in before]
