"""Tests of the charts of the report page and of their colours."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.alignment_criteria import summarise_alignments
from experiments.reports.figures.style import aligner_styles
from experiments.reports.report.charts import (
    MIN_CONTRAST,
    NEUTRAL,
    chart_style,
    contrast,
    css_name,
    error_curves,
    error_figure,
    lightened,
    palette,
    rounded,
    success_curves,
    thinned,
    time_curves,
    time_figure,
)
from tests.helpers.made_up_runs import many_errors

NAMES = ["ransac", "svd", "svd-solved", "icp", "impicp", "gnc", "clique", "opencv"]
NAMES += ["ransac_mahalanobis", "kiss_matcher", "oracle", *(f"plug-in {k}" for k in range(12))]


def test_contrast_is_that_of_the_standard() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)  # the known near miss
    assert contrast("#ffffff", "#777777") == contrast("#777777", "#ffffff")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_stands_out(theme: str) -> None:
    colours = palette([])[theme]
    for name in ("ink", "muted", "good", "bad", "accent"):
        for surface in ("page", "sheet", "raised", "tint"):
            assert contrast(colours[name], colours[surface]) >= MIN_CONTRAST, (name, surface)


def test_lines_stand_out_from_a_dark_page() -> None:
    styles = [chart_style(style) for style in aligner_styles(NAMES).values()]
    dark = palette(style["hex"] for style in styles)["dark"]
    for style in styles:
        assert contrast(dark[style["colour"]], dark["page"]) >= MIN_CONTRAST, style
        assert contrast(dark[css_name(style["hex"])], dark["page"]) >= MIN_CONTRAST, style


def test_charts_draw_black_in_a_colour_that_both_pages_show() -> None:
    style = chart_style(aligner_styles(["oracle"])["oracle"])
    assert style["hex"] == NEUTRAL
    assert contrast(NEUTRAL, palette([])["light"]["page"]) >= MIN_CONTRAST


def test_a_colour_that_stands_out_stays_as_it_is() -> None:
    assert lightened("#E69F00", "#101317") == "#e69f00"


def test_no_two_methods_look_alike() -> None:
    styles = [chart_style(aligner_styles(NAMES)[name]) for name in NAMES]
    assert len({(s["colour"], s["dash"], s["marker"]) for s in styles}) == len(NAMES)


def test_five_digits_and_none_for_what_is_not_finite() -> None:
    assert rounded([1 / 3, 123456.0, np.nan, np.inf]) == [0.33333, 123460.0, None, None]


def test_the_last_of_thinned_values_stays() -> None:
    assert thinned(np.arange(11), 3).tolist() == [0, 5, 10]
    assert thinned(np.arange(11), 1).tolist() == [10]
    assert thinned(np.arange(3), 400).tolist() == [0, 1, 2]


def errors(iteration: int, n_true: int, lengths_m: list[float]) -> pd.DataFrame:
    rows = pd.DataFrame({"translation_error_m": lengths_m, "repetition": range(len(lengths_m))})
    rows["rotation_error_rad"] = -rows["translation_error_m"]
    for name in ("translation_error_m", "rotation_error_rad"):
        rows[f"refined_{name}"] = rows[name] / 10
    names = {"run_id": "x-0", "robot_a": "R1", "robot_b": "R2", "iteration": iteration}
    return rows.assign(**names, aligner="icp", n_true=n_true, n_correspondences=90)


def test_errors_are_medians_and_what_four_fifths_lie_between() -> None:
    rows = pd.concat([errors(10, 2, [np.nan] * 3), errors(20, 7, [0.1, 0.2, 0.4])])
    found = error_curves(rows, ["icp", "absent"])
    assert (found["iteration"], found["n_true"]) == ([10, 20], [2.0, 7.0])
    assert found["n_correspondences"] == [90.0, 90.0]
    assert found["scarce"] == [(5.0, 15.0)]
    curves = found["aligners"]["icp"]
    expected = {"low": [None, 0.12], "median": [None, 0.2], "high": [None, 0.36]}
    assert curves["translation_estimated"] == expected
    assert curves["rotation_estimated"] == expected  # without the sign
    assert curves["rotation_refined"]["high"] == [None, 0.036]
    assert set(found["aligners"]["absent"]["translation_refined"]["median"]) == {None}


def test_success_is_by_bin_and_of_maps_with_common_ground() -> None:
    rows = many_errors(6, methods={"ransac": (1.0, 0.0, 0.0)}, repetitions=1)
    rows = rows.assign(n_true=np.where(rows["iteration"] <= 50, 5, 40), n_correspondences=100)
    lost = (rows["iteration"] == 75) & (rows["aligner"] == "ransac")
    rows.loc[lost, "refined_translation_error_m"] = 9.0
    maps = summarise_alignments(rows.assign(n_common=9)).assign(overlap_share=np.nan)
    by_name = {curve["label"]: curve for curve in success_curves(maps, ["ransac"])}
    pairs = by_name["true pairs among the correspondences"]
    assert pairs["bins"] == ["3–9", "30–99"]
    assert pairs["aligners"]["ransac"]["rate"] == [1.0, 0.5]
    assert pairs["aligners"]["ransac"]["n"] == [6 * 2 * 2] * 2
    low, high = (pairs["aligners"]["ransac"][end][1] for end in ("low", "high"))
    assert low < 0.5 < high
    assert by_name["share of false correspondences"]["bins"] == ["50–70 %", "95–99 %"]
    assert "common landmarks, share of the smaller map" not in by_name
    apart = rows.assign(n_common=np.where(rows["n_true"] == 5, 2, 9))
    curves = success_curves(summarise_alignments(apart).assign(overlap_share=0.5), ["ransac"])
    assert curves[0]["bins"] == ["30–99"]  # elsewhere there is nothing to be right about


def test_times_are_milliseconds_by_number_of_correspondences() -> None:
    few = pd.DataFrame({"aligner": "icp", "n_correspondences": [30, 10, 20]})
    few = few.assign(elapsed_s=[0.003, 0.001, np.nan], elapsed_low_s=0.0005, elapsed_high_s=0.004)
    found = time_curves(few, ["icp", "ransac"])
    assert found == {
        "icp": {"n": [10, 30], "median": [1.0, 3.0], "low": [0.5] * 2, "high": [4.0] * 2}
    }
    many = pd.DataFrame({"aligner": "icp", "n_correspondences": np.arange(1, 401)})
    many = many.assign(elapsed_s=many["n_correspondences"] / 1e3, elapsed_low_s=0, elapsed_high_s=0)
    grouped = time_curves(many, ["icp"])["icp"]
    assert grouped["n"] == grouped["median"]  # 1 ms a correspondence
    assert len(grouped["n"]) == 40
    assert grouped["n"][0] == pytest.approx(5.5)  # of 1 to 10


def test_what_was_offered_is_a_median_over_maps() -> None:
    parts = [
        errors(10, n_true, [0.1, 0.2]).assign(robot_b=f"R{k}", n_correspondences=n)
        for k, (n_true, n) in enumerate(((3, 10), (5, 20), (70, 900)))
    ]
    found = error_curves(pd.concat(parts), ["icp"])
    assert (found["n_true"], found["n_correspondences"]) == ([5.0], [20.0])


def test_a_rate_counts_the_maps_with_common_ground() -> None:
    rows = many_errors(2, methods={"ransac": (1.0, 0.0, 0.0)}, repetitions=1).assign(n_true=5)
    rows["n_common"] = np.where(rows["iteration"] <= 25, 2, 9)  # one iteration of four
    curves = success_curves(summarise_alignments(rows).assign(overlap_share=np.nan), ["ransac"])
    assert curves[0]["aligners"]["ransac"]["n"] == [2 * 2 * 3]


def styles(*names: str) -> dict[str, dict[str, str]]:
    return {name: chart_style(aligner_styles(names)[name]) for name in names}


def test_the_error_chart_holds_each_group_with_its_bands_and_gaps() -> None:
    """A band is one polygon for each stretch of iterations with estimates."""
    gap = [errors(30, 7, [np.nan] * 3), errors(40, 7, [0.1, 0.2, 0.4])]
    near = error_curves(
        pd.concat([errors(10, 2, [0.1] * 3), errors(20, 7, [0.2] * 3), *gap]), ["icp"]
    )
    far = error_curves(errors(10, 9, [5.0] * 3), ["icp"])
    figure: Any = error_figure([("near", near), ("far", far)], styles("icp"))
    medians = {trace.meta: trace for trace in figure.data if trace.name == "icp"}
    assert list(medians["translation_estimated"].y) == [0.1, 0.2, None, 0.2]
    assert list(medians["rotation_refined"].y) == [0.01, 0.02, None, 0.02]
    assert list(medians["translation_estimated"].customdata[3]) == [0.12, 0.36]
    band = figure.data[0]
    assert list(band.x) == [10, 20, 20, 10, None, 40, 40, None]
    assert list(band.y) == [0.1, 0.2, 0.2, 0.1, None, 0.12, 0.36, None]
    spans = [(shape.x0, shape.x1) for shape in figure.layout.shapes if shape.xref == "x"]
    assert spans == near["scarce"] == [(5.0, 15.0)]
    other = figure.layout.updatemenus[0].buttons[1]
    assert other.label == "far"
    assert other.args[0]["y"][1] == [5.0]
    assert not other.args[1]["shapes"]
    assert {trace.legendgroup for trace in figure.data} == {"icp", "n_true", "n_correspondences"}


def test_the_time_chart_holds_the_spread() -> None:
    curves = {"icp": {"n": [10.0], "median": [2.0], "low": [1.0], "high": [5.0]}}
    figure: Any = time_figure(curves, styles("icp"))
    (trace,) = figure.data
    assert (trace.x, trace.y) == ((10.0,), (2.0,))
    assert (trace.error_y.array, trace.error_y.arrayminus) == ((3.0,), (1.0,))
    assert time_figure({}, styles()) is None
