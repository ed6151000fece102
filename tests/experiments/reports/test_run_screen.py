"""Tests of the screen of a run."""

import math
import os
import pty
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.reports import layout
from experiments.reports.layout import plain, print_lines, print_table
from experiments.reports.run_screen import (
    edge_lines,
    not_run_lines,
    print_result,
    team_lines,
)
from experiments.studies.method_comparison import aligner_summary
from tests.helpers.made_up_runs import complete


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


def test_fusers_are_shown_at_the_end_on_a_narrow_screen(
    trio_copy: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    path = tables.table_path(trio_copy, "fusers")
    known = tables.read(path, "fusers")
    later = known.assign(iteration=known["iteration"] + 1, nees_per_dof=77.0)
    tables.write(path, "fusers", pd.concat([later, known]))
    print_result(trio_copy, [])
    shown = capsys.readouterr().out.split("Fusers: maps of all robots")[1].split("\n\n")[0]
    assert all(len(line) <= 80 for line in shown.splitlines())
    fusers = list(dict.fromkeys(known["fuser"]))
    lines = {line.split()[0]: line for line in shown.splitlines()}
    assert [name for name in lines if name in fusers] == fusers
    assert all("77.00" in lines[name] for name in fusers)


def test_of_one_robot_or_without_truth_no_fusers_are_shown(
    trio_copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tables.write(tables.table_path(trio_copy, "fusers"), "fusers", [])
    print_result(trio_copy, [])
    assert "Fusers" not in capsys.readouterr().out


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
    assert "".join(line[:15].strip() for line in lines[4:7]) == long


HOSTILE = "mk[/b]/[bold]x[/]:smile: \x1b[2J\udcff.parquet"
SHOWN = "mk[/b]/[bold]x[/]:smile: \\x1b[2J\\udcff.parquet"


def test_a_number_is_never_cut(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not even where the numbers alone are wider than the screen."""
    monkeypatch.setenv("COLUMNS", "20")
    print_table([("method", ""), *[("x", ".3f")] * 4], [("a_long_name", *[-1234.5] * 4)])
    out = capsys.readouterr().out
    assert out.count("-1234.500") == 4
    assert "a_long_n" in out


def test_what_comes_from_users_is_shown_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    print_lines([HOSTILE])
    assert capsys.readouterr().out == SHOWN + "\n"
    print_table([(HOSTILE, "")], [(HOSTILE,)], HOSTILE, HOSTILE)
    shown = capsys.readouterr().out.replace(" ", "")
    assert shown.count("mk[/b]/[bold]x[/]:smile:") == 4
    assert "\x1b" not in shown
    assert plain("two\nlines") == "two\nlines"


def test_one_place_prints() -> None:
    """Other modules could read text from users as markup."""
    for path in Path("experiments").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        has_console = "Console(" in text or "rich.print" in text or "from rich import print" in text
        assert has_console == (path.name == "layout.py"), path


def test_progress_without_a_terminal_is_plain_lines(capfd: pytest.CaptureFixture[str]) -> None:
    with layout.progress() as show:
        for done in range(1001):
            show("render [R1[/b]]", done, 1000)
        show("merge", 1, 1)
    err = capfd.readouterr().err
    assert err.splitlines() == [
        "render [R1[/b]]: 0/1000",
        "render [R1[/b]]: 1000/1000",
        "merge: 1/1",
    ]
    assert all(character.isprintable() or character == "\n" for character in err)


def test_progress_on_a_terminal_takes_no_label_for_markup(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "w") as terminal, monkeypatch.context() as patch:
        patch.setattr("sys.stderr", terminal)
        patch.setenv("TERM", "xterm")
        with layout.progress() as show:
            show("R1[/b]", 1, 1)
    with os.fdopen(ours, "rb") as screen:
        assert b"R1[/b]" in _all_shown(screen)


def _all_shown(screen: BinaryIO) -> bytes:
    """Return the text that a closed terminal received; the kernel passes it on in pieces."""
    shown = b""
    with suppress(OSError):  # Linux ends a terminal that is closed with an error, others with b""
        while piece := os.read(screen.fileno(), 100_000):
            shown += piece
    return shown


def motions(**left_out: str) -> pd.DataFrame:
    """Robots with the reason why they are left out, empty for those that are placed."""
    rows = [
        {"robot": name, "left_out": why, "tx_m": math.nan if why else 0.0}
        for name, why in left_out.items()
    ]
    return complete(
        "fused_motions", pd.DataFrame(rows, columns=pd.Index(["robot", "left_out", "tx_m"]))
    )


def pairs(*rows: tuple[str, str, str, int, float]) -> pd.DataFrame:
    names = ["robot_a", "robot_b", "place", "n_common", "refined_translation_error_m"]
    frame = pd.DataFrame(rows, columns=pd.Index(names))
    return complete("team_pairs", frame.assign(refined_rotation_error_rad=0.0))


NONE = {name: tables.as_table(name, []) for name in ("team", "team_pairs")}


def test_a_team_of_which_one_is_left_out() -> None:
    team = pd.DataFrame({"source": ["final", "odometry"], "rmse": [0.0234, 9.0]})
    team = complete("team", team.assign(component=1, n_robots=2, n_team=3))
    told = team_lines(
        motions(A="", B="", C="chance would do"),
        team,
        pairs(
            ("A", "B", "bridge", 40, 0.1),
            ("A", "C", "refused", 40, math.nan),
            ("B", "C", "confirmed", 0, 0.1),
        ),
    )
    assert list(told) == [
        "2 of 3 robots are merged: their paths err by 0.023 m (ATE, one rigid fit for all)",
        "C is left out of the fused map: chance would do",
        "alignments believed: 2, right: 1; pairs of maps with common ground: 2, found: 1",
    ]


def test_nothing_merged() -> None:
    told = team_lines(motions(A="", B="refused"), *NONE.values())
    assert list(told) == [
        "no two maps were merged, the fused map is that of A",
        "B is left out of the fused map: refused",
    ]


def test_one_robot_is_no_team() -> None:
    team = complete("team", pd.DataFrame([{"source": "final", "n_team": 1, "rmse": 0.1}]))
    assert list(team_lines(motions(), team, NONE["team_pairs"])) == []


def test_alignments_are_told_by_what_became_of_them() -> None:
    edges = pairs(
        ("A", "B", "confirmed", 0, 0.0),
        ("A", "C", "refused", 0, 0.0),
        ("B", "C", "confirmed", 0, 0.0),
        ("B", "D", "bridge", 0, 0.0),
    )
    told = ["alignments bridge: B-D", "alignments confirmed: A-B and B-C"]
    assert list(edge_lines(edges)) == told
    assert list(edge_lines(edges.head(1))) == []  # of two robots nobody else says anything


def test_names_of_methods_are_not_folded_at_80_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    columns = [("aligner", ""), *((f"quantity {k}", "d") for k in range(5)), ("reason", "")]
    print_table(columns, [["ransac_mahalanobis", 1, 2, 3, 4, 5, "a long reason " * 20]])
    assert "ransac_mahalanobis" in capsys.readouterr().out
