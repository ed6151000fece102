"""How tables look on the screen, and what it says about aligners that did not run."""

import math

import pandas as pd
import pytest

from experiments.show.terminal.layout import print_table
from experiments.show.terminal.run_screen import not_run_lines
from experiments.study.statistics.standing import aligner_summary


def rows(aligner: str, *statuses: tuple[str, str]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "robot_a": "R1",
            "robot_b": "R2",
            "iteration": range(len(statuses)),
            "aligner": aligner,
            "status": [status for status, _ in statuses],
            "reason": [reason for _, reason in statuses],
            "refined_status": [status for status, _ in statuses],
            "accepted": [status == "accepted" for status, _ in statuses],
            "repetition": 0,
            "n_common": 5,
            "n_true": 5,
            "n_correspondences": 10,
        }
        | dict.fromkeys(
            (
                "translation_error_m",
                "rotation_error_rad",
                "refined_translation_error_m",
                "refined_rotation_error_rad",
            ),
            0.5,
        )
    )


ERRORS = pd.concat(
    [
        rows("good", ("accepted", ""), ("refused", "too few")),
        rows("ill", ("failed", "raised KeyError"), ("accepted", ""), ("failed", "raised KeyError")),
        rows("far", ("absent", "install it"), ("absent", "install it")),
    ]
)


def test_one_line_for_each_aligner_that_did_not_run() -> None:
    assert not_run_lines(ERRORS) == [
        "ill: failed in 2 of 3 rows: raised KeyError",
        "far: absent: install it",
    ]


def test_absent_is_neither_accepted_nor_not() -> None:
    timings = pd.DataFrame({"aligner": ["good"], "elapsed_s": [0.001]})
    summary = aligner_summary(ERRORS, timings, ["good", "ill", "far"]).set_index("aligner")
    assert summary["accepted"]["good"] == 0.5
    assert abs(summary["accepted"]["ill"] - 1 / 3) < 1e-12
    assert pd.isna(summary["accepted"]["far"])
    assert pd.isna(summary["translation_error_m"]["far"])


def test_text_gives_way_before_numbers_on_a_narrow_screen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    columns = [("method", ""), ("a\nm", ".3f"), ("b\nrad", "+.4f"), ("of", ">")]
    long = "a_method_with_a_[bold]_long_name"
    print_table(columns, [(long, 1234.5, math.nan, "480/480"), ("short", 1.0, 0.5, None)], "Title")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 40
    text = "".join(lines)
    for shown in ("1234.500", "480/480", "+0.5000", " – ", "Title"):
        assert shown in text
    assert "…" not in text
    assert "".join(line[1:11].strip() for line in lines[5:9]) == long
