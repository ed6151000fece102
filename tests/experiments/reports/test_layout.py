"""Figures as text claim nothing that is not so."""

import math

import pytest

from experiments.reports.layout import listed, metres, percent, ratio, two_digits


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (1, "100 %"),
        (0.9999, "> 99 %"),
        (0.995, "> 99 %"),
        (0.001, "< 1 %"),
        (0, "0 %"),
        (0.5, "50 %"),
    ],
)
def test_percentages_claim_nothing_that_is_not_so(share: float, text: str) -> None:
    assert percent(share).replace("\u00a0", " ") == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0123, "0.012"), (1.26, "1.3"), (12.6, "13"), (432.1, "432"), (0, "0.0"), (1e-9, "0.00000")],
)
def test_figures_have_two_significant_digits(value: float, text: str) -> None:
    assert two_digits(value) == text


def test_what_is_not_known_is_a_dash_without_a_unit() -> None:
    assert {percent(math.nan), metres(math.nan), ratio(math.nan)} == {"–"}
    assert {metres(math.inf), ratio(math.inf), two_digits(math.inf)} == {"inf"}


def test_names_are_listed_as_in_a_sentence() -> None:
    assert [listed(names) for names in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "",
        "a",
        "a and b",
        "a, b and c",
    ]
