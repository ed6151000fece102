"""The last lines of `run`: the method to use, and the report."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.reports.run_screen import closing_lines, method_advice
from experiments.studies.method_comparison import Recommendation
from tests.experiments.reports.report.test_verdict import GOOD, ONE_RUN, POOR

HINT = "One run is a hint; a sweep over seeds decides."


def advice(ranking: Recommendation) -> str:
    return method_advice(ranking).replace("\u00a0", " ")


def test_the_best_is_named_with_its_accuracy() -> None:
    assert advice(ONE_RUN) == (
        "Method to use: good. It was right in 95 % of 20 pairs of maps with common ground, median "
        f"error 0.10 m and 0.0050 rad. {HINT}"
    )


def test_a_share_of_repetitions_is_no_share_of_pairs() -> None:
    """82 % of twelve pairs of maps is impossible."""
    often = replace(GOOD, n_maps=12, n_alignments=240, rate=0.82)
    assert "right in 82 % of 240 alignments of 12 pairs of maps" in advice(
        replace(ONE_RUN, best=often)
    )


@pytest.mark.parametrize(
    ("equals", "words"),
    [
        (("other",), "other does as well as far as this run can tell."),
        (("other", "third"), "other and third do as well as far as this run can tell."),
    ],
)
def test_equal_methods_are_named(equals: tuple[str, ...], words: str) -> None:
    assert advice(replace(ONE_RUN, equals=equals)).endswith(f"{words} {HINT}")


def test_wrong_or_no_accepted_alignments_are_told() -> None:
    wrong = replace(ONE_RUN, best=replace(GOOD, n_false=10))
    assert ", but 10 of 40 accepted alignments were wrong." in advice(wrong)
    none = replace(ONE_RUN, best=replace(GOOD, n_accepted=0))
    assert ", but none of its alignments was accepted." in advice(none)


def test_no_method_is_recommended_if_none_is_reliable() -> None:
    poor = advice(replace(ONE_RUN, best=POOR))
    assert poor.startswith(
        "Method to use: none is reliable. The best is poor. It was right in 20 %"
    )
    failed = advice(replace(ONE_RUN, best=None))
    assert failed.startswith("Method to use: none. No method was right on the 20 pairs of maps")


def test_without_common_ground_the_advice_is_to_merge_nothing() -> None:
    apart = replace(ONE_RUN, best=None, n_common=0)
    wrong = advice(apart)
    assert "No two maps share ground, but poor accepted a wrong alignment." in wrong
    right = advice(replace(apart, standings=(GOOD,), oracle_m=math.nan))
    assert "No two maps share ground, and all refused." in right


def test_without_truth_no_error_is_claimed(tiny_result: Path, tmp_path: Path) -> None:
    result = tmp_path / "my result"
    shutil.copytree(tiny_result, result)
    errors = tables.table_path(result, "errors")
    tables.write(errors, "errors", pd.DataFrame())
    told, opens = closing_lines(result)
    assert told.startswith("Method to use: ")
    assert "no truth is known" in told
    assert "median error" not in told
    assert opens == f"Open the report: mapfusion report '{result}' --open"
