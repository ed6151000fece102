"""What the screen says about aligners that did not run."""

import pandas as pd

from experiments.show.terminal.run_screen import aligner_summary, not_run_lines


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
    assert pd.isna(summary["estimated_m"]["far"])
