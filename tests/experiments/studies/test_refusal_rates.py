"""Verdicts by kind of world, worked out by hand."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.reports.figures.drawing import save_figure
from experiments.reports.figures.study_figures import draw_refusal_kinds, draw_refusal_roc
from experiments.reports.study_screen import print_kinds
from experiments.studies.refusal_rates import (
    Rate,
    by_kind,
    first_right_answers,
    of_any_method,
    pooled,
    worst,
)
from experiments.studies.refusal_trial import crossings_of

COLUMNS = ["world_a", "world_b", "iteration", "n_common", "n_true", "status", "beats", "error"]
# Two runs of common ground (the second's is found late), and a crossing of them.
ROWS = [
    ("k-1", "k-1", 10, 0, 0, "refused", False, 9.0),
    ("k-1", "k-1", 20, 9, 4, "ambiguous", True, 0.1),
    ("k-1", "k-1", 30, 90, 25, "ambiguous", True, 0.1),
    ("k-1", "k-1", 40, 90, 40, "accepted", True, 0.1),
    ("k-2", "k-2", 10, 0, 0, "accepted", True, 9.0),
    ("k-2", "k-2", 20, 0, 0, "refused", True, 9.0),
    ("k-2", "k-2", 30, 90, 30, "degenerate", False, math.nan),
    ("k-2", "k-2", 40, 90, 50, "accepted", True, 0.2),
    ("k-1", "k-2", 40, 0, 0, "too_uncertain", True, math.nan),
    ("k-1", "k-2", 30, 0, 0, "refused", False, math.nan),
]


def table(kind: str = "k", aligner: str = "ransac") -> pd.DataFrame:
    rows = pd.DataFrame(ROWS, columns=pd.Index(COLUMNS)).rename(
        columns={"beats": "beats_chance", "error": "refined_translation_error_m"}
    )
    rows["ground"] = np.where(rows["world_a"] == rows["world_b"], "common", "apart")
    rows["accepted"] = rows["status"] == "accepted"
    rows = rows.assign(kind=kind, aligner=aligner, robot_a="R1", robot_b="R2", repeats=True)
    rows["poster_radius_m"], rows["n_inliers"], rows["log10_false_alarms"] = math.nan, 9, -5.0
    return rows.assign(refined_rotation_error_rad=0.0)


def test_rates_of_a_kind_worked_out_by_hand() -> None:
    changed = table().assign(ground="few")  # maps that somebody changed say nothing here
    (row,) = by_kind(pd.concat([table(), changed]))
    expected = {
        "false_runs": (1, 2),
        "false_pairs": (1, 5),
        "false_by_chance": (3, 5),
        "wrong_pairs": (0, 5),
        "on_ground": (2, 5),
        "ambiguous": (2, 7),
        "right_accepted": (2, 3),
        "right_ambiguous": (1, 3),
        "right_too_uncertain": (0, 3),
        "right_refused": (0, 3),
    }
    assert {name: row[name] for name in expected} == {k: Rate(*v) for k, v in expected.items()}
    assert (row["first_iteration"], row["first_true_pairs"]) == (40, 45)
    assert (row["first_iteration_by_chance"], row["first_true_pairs_by_chance"]) == (30, 27)


def test_rates_do_not_depend_on_the_order_of_the_rows() -> None:
    assert by_kind(table().iloc[::-1]) == by_kind(table())


def test_what_any_method_does_counts_once_for_two_maps() -> None:
    """Another method refuses all but one pair of maps that the first refused, and merges it."""
    other = table(aligner="icp").assign(status="refused", accepted=False)
    other.loc[5, ["status", "accepted"]] = "accepted", True  # of k-2, without common ground
    (row,) = of_any_method(pd.concat([table(), other]))
    told = (row["false_runs"], row["false_pairs"], row["right_accepted"], row["right_refused"])
    assert told == (Rate(1, 2), Rate(2, 5), Rate(2, 6), Rate(3, 6))


def test_first_answers_are_of_all_ordinary_worlds_with_common_ground() -> None:
    """Accepted at 40, 40 and, of another kind, 20; what repeats or shares nothing is left out."""
    ordinary = table().assign(repeats=False)
    third = ordinary[ordinary["world_a"] == "k-1"].assign(kind="l", world_a="l-1", world_b="l-1")
    third.loc[third["iteration"] >= 20, "status"] = "accepted"
    third["accepted"] = third["status"] == "accepted"
    apart = third.assign(kind="m", n_common=0)
    given = [ordinary, third, apart, table("posters")]
    (row,) = first_right_answers(pd.concat(given, ignore_index=True))
    assert (row["aligner"], row["n_runs"]) == ("ransac", 3)
    assert (row["first_iteration"], row["first_true_pairs"]) == (40, 40)
    assert (row["first_iteration_by_chance"], row["first_true_pairs_by_chance"]) == (20, 4)
    assert not first_right_answers(table())


def test_a_run_that_never_comes_to_it_is_later_than_all_others() -> None:
    rows = table()
    never = rows[rows["world_a"] == "k-2"].assign(status="refused", accepted=False)
    for n, expected in ((1, 40.0), (2, math.nan)):
        more = [never.assign(world_a=f"n-{i}", world_b=f"n-{i}") for i in range(n)]
        both = pd.concat([rows[rows["world_b"] != "k-2"], rows[rows["world_a"] == "k-2"], *more])
        (row,) = by_kind(both)
        assert row["first_iteration"] == pytest.approx(expected, nan_ok=True)


def test_kinds_and_methods_stay_apart() -> None:
    parts = [table("b", "svd"), table("b", "clique"), table("a", "svd")]
    parts[1]["status"], parts[1]["accepted"] = "refused", False
    rows = by_kind(pd.concat(parts))
    assert [(row["kind"], row["aligner"]) for row in rows] == [
        ("a", "svd"),
        ("b", "svd"),
        ("b", "clique"),
    ]
    assert worst(rows[1:], "false_runs") == ("svd", Rate(1, 2))
    assert pooled(rows[1:], "false_runs") == Rate(1, 4)


@dataclass(frozen=True)
class _World:
    kind: str
    seed: int
    repeats: bool = False
    iterations: tuple[int, ...] = (10, 20, 30)
    folders: tuple[str, ...] = ("R1", "R2")

    @property
    def scenario(self) -> "_World":
        return self


def test_worlds_are_crossed_within_kinds_and_between_them() -> None:
    worlds = [_World(k, s, k == "c") for k in ("a", "b", "c") for s in range(6)]
    made = crossings_of(worlds, 25, np.random.default_rng(0))  # type: ignore[arg-type]
    counts: dict[str, int] = {}
    for each in made:
        assert each.a.scenario.seed != each.b.scenario.seed
        assert len(set(each.meetings)) == len(each.meetings)
        kind = each.a.kind
        if each.b.kind != kind:
            kind = "crossed_repeating" if "c" in (kind, each.b.kind) else "crossed"
        counts[kind] = counts.get(kind, 0) + len(each.meetings)
        assert not each.hung or not (each.a.repeats or each.b.repeats)
    assert counts == dict.fromkeys(("a", "b", "c", "crossed", "crossed_repeating"), 25)
    assert sum(each.hung for each in made) == 35


def test_what_is_shown_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = pd.concat([table("first"), table("second").assign(repeats=False)])
    print_kinds(by_kind(rows))
    shown = capsys.readouterr().out
    for word in ("first", "second", "1/2", "2/3"):
        assert word in shown
    for name, draw in (("kinds", draw_refusal_kinds), ("roc", draw_refusal_roc)):
        one, other = (save_figure(tmp_path / part, name, draw, rows)[0] for part in "ab")
        assert one.read_bytes() == other.read_bytes()
