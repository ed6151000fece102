"""Colours can be read on both backgrounds, and no two methods look alike."""

import pytest

from experiments.reports.figures.style import aligner_styles
from experiments.reports.report.theme import (
    MIN_CONTRAST,
    NEUTRAL,
    chart_style,
    contrast,
    css_name,
    lightened,
    palette,
)

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
