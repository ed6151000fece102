"""Verdicts by kind of world, worked out by hand; probabilities held against their law."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.reports.figures.drawing import save_figure
from experiments.reports.figures.study_figures import (
    draw_refusal_kinds,
    draw_refusal_reliability,
    draw_refusal_roc,
)
from experiments.reports.terminal.study_screen import print_kinds, print_reliability
from experiments.studies.refusal_rates import (
    N_BINS,
    Rate,
    answers_with_probability,
    by_kind,
    first_right_answers,
    of_any_method,
    pooled,
    reliability,
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
    rows["probability"] = np.where(rows["beats_chance"], 0.5, math.nan)
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


def answers(stated: np.ndarray, right: np.ndarray, n_runs: int) -> pd.DataFrame:
    runs = np.char.add("w-", (np.arange(len(stated)) % n_runs).astype(str))
    rows = pd.DataFrame({"probability": stated, "world_a": runs, "world_b": runs})
    rows["refined_translation_error_m"] = np.where(right, 0.1, 5.0)
    rows["kind"] = np.where(np.arange(len(stated)) % 2, "a", "b")
    rows = rows.assign(ground="common", n_common=9, accepted=True, status="accepted")
    rows = rows.assign(refined_rotation_error_rad=0.0, beats_chance=True, n_true=30)
    return answers_with_probability(rows.assign(log10_false_alarms=-5.0, aligner="ransac"))


def test_a_probability_that_holds_errs_by_what_chance_gives() -> None:
    rng = np.random.default_rng(0)
    stated = rng.uniform(0, 1, 20_000)
    right = rng.random(len(stated)) < stated
    found = reliability(answers(stated, right, 200), rng)
    assert found.calibration_error.value < 0.015
    # E (p - y)^2 = E p (1 - p) = 1/6 for p uniform; a constant 1/2 gives 1/4
    assert found.brier.value == pytest.approx(1 / 6, abs=0.005)
    assert found.brier.low < 1 / 6 < found.brier.high
    assert found.brier_of_support == pytest.approx(0.25, abs=0.005)
    assert (found.bins["n"] == len(stated) // N_BINS).all()
    assert ((found.bins["right_low"] < found.bins["stated"]).mean()) > 0.7


def test_one_that_is_too_sure_errs_by_as_much() -> None:
    rng = np.random.default_rng(1)
    right = rng.random(5000) < 0.7
    found = reliability(answers(np.full(5000, 0.9), right, 50), rng)
    assert found.calibration_error.value == pytest.approx(0.9 - right.mean(), abs=1e-9)
    assert found.n_wrong == np.count_nonzero(~right)


def test_runs_are_resampled_whole() -> None:
    """If all answers of a run are equal, the interval is that of the runs."""
    rng = np.random.default_rng(2)
    of_run = rng.random(40) < 0.5
    rows = answers(np.full(4000, 0.5), of_run[np.arange(4000) % 40], 40)
    share = reliability(rows, rng).bins["right_high"] - reliability(rows, rng).bins["right_low"]
    assert share.mean() > 0.2  # 2 * 1.96 * sqrt(0.25 / 40) = 0.31; of answers 0.1 / sqrt(...)


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
    rng = np.random.default_rng(0)
    stated = rng.uniform(0, 1, 300)
    found = reliability(answers(stated, rng.random(300) < stated, 30), rng)
    print_reliability(found)
    shown = capsys.readouterr().out
    for word in ("first", "second", "1/2", "2/3", "calibration error", "Brier"):
        assert word in shown
    for name, draw, data in (
        ("kinds", draw_refusal_kinds, rows),
        ("roc", draw_refusal_roc, rows),
        ("reliability", draw_refusal_reliability, found),
    ):
        one, other = (save_figure(tmp_path / part, name, draw, data)[0] for part in "ab")
        assert one.read_bytes() == other.read_bytes()
