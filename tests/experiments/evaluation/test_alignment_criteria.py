"""Tests of `experiments.evaluation.alignment_criteria`."""

import math
from pathlib import Path

import pandas as pd
import pytest

from experiments.evaluation import alignment_criteria, tables
from experiments.evaluation.alignment_criteria import nothing_merged, summarise_alignments
from experiments.evaluation.metrics import USED_TABLES, CheckedScenario, check_all, load_checked
from mapfusion.errors import InputError
from tests.helpers.made_up_runs import complete, many_errors
from tests.helpers.tiny_scenario import TINY, command


@pytest.mark.parametrize(
    ("chosen", "least"),
    [
        (alignment_criteria.answerable, 3),
        (alignment_criteria.mergeable, 20),
        (alignment_criteria.rich, 30),
    ],
)
def test_so_many_true_pairs_are_enough(chosen, least: int) -> None:
    rows = pd.DataFrame({"n_true": [least - 1, least, least + 1]})
    assert chosen(rows)["n_true"].tolist() == [least, least + 1]


def test_three_common_landmarks_are_common_ground() -> None:
    rows = pd.DataFrame({"n_common": [0, 2, 3, 4]})
    assert alignment_criteria.has_common_ground(rows).tolist() == [False, False, True, True]


def test_the_end_is_that_of_each_robot_pair_of_each_run() -> None:
    """A pair is judged as long as the later of its robots drives, others may go on."""
    columns = ["run_id", "robot_a", "robot_b", "iteration"]
    ends = [("x", "R1", "R2", 40), ("x", "R1", "R3", 90), ("y", "R1", "R2", 60)]
    earlier = [(*end[:3], end[3] - 10) for end in ends]
    rows = pd.DataFrame([*earlier, *ends, ends[1]], columns=pd.Index(columns))
    found = alignment_criteria.at_last_iteration(rows)
    assert [*found.itertuples(index=False, name=None)] == [*ends, ends[1]]
    alone = rows[rows["run_id"] == "x"].drop(columns="run_id")  # a result's own table
    assert alignment_criteria.at_last_iteration(alone)["iteration"].tolist() == [40, 90, 90]


@pytest.mark.parametrize("wrong", [{"translation_error_m": 0.6}, {"rotation_error_rad": -0.2}])
def test_an_estimate_and_its_refinement_are_judged_apart(wrong: dict[str, float]) -> None:
    right = {"translation_error_m": 0.4, "rotation_error_rad": -0.09}
    right |= {f"refined_{name}": value for name, value in right.items()}
    errors = many_errors(1, repetitions=1).assign(n_common=3)
    mended = summarise_alignments(errors.assign(**(right | wrong)))
    assert (mended["estimated_success"] == 0).all()
    assert (mended["refined_success"] == 1).all()
    spoilt = {f"refined_{name}": value for name, value in wrong.items()}
    spoilt_maps = summarise_alignments(errors.assign(**(right | spoilt), accepted=True))
    assert (spoilt_maps["estimated_success"] == 1).all()
    assert (spoilt_maps["refined_success"] == 0).all()
    assert (spoilt_maps["false_accepted"] == 1).all()


# Robots placed, landmarks common at 10 and at the last iteration (none: no truth), and the verdict.
CASES = {
    "merged": (2, (0, 40), None),
    "one of three left out": (2, (0, 40), None),
    "refused though there is ground": (1, (0, 3), True),
    "ground that is not enough": (1, (9, 2), False),
    "no truth": (1, (), None),
}


def write_run(folder: Path, n_robots: int, n_placed: int, n_common: tuple[int, ...]) -> Path:
    """The tables that say what was merged."""
    motions = [
        {"robot": f"R{k}", "tx_m": 0.0 if k < n_placed else math.nan} for k in range(n_robots)
    ]
    pair = {"robot_a": "R0", "robot_b": "R1", "aligner": "ransac"}
    errors = [pair | {"iteration": 10 * k, "n_common": n} for k, n in enumerate(n_common, 1)]
    for name, rows in (("fused_motions", motions), ("errors", errors)):
        frame = complete(name, pd.DataFrame(rows)) if rows else tables.as_table(name, [])
        tables.write(tables.table_path(folder, name), name, frame)
    for name in {*USED_TABLES} - {"fused_motions", "errors"}:
        tables.write(tables.table_path(folder, name), name, [])
    return folder


@pytest.mark.parametrize("case", CASES)
def test_what_a_result_says(tmp_path: Path, case: str) -> None:
    n_placed, n_common, ground = CASES[case]
    found = nothing_merged(write_run(tmp_path, 2 + case.startswith("one of"), n_placed, n_common))
    if n_placed > 1:
        assert found is None
        return
    assert found is not None
    assert found.common_ground is ground
    assert found.failed == (ground is not False)
    assert "\n" not in found.text


def test_one_robot_has_nothing_to_merge(tmp_path: Path) -> None:
    assert nothing_merged(write_run(tmp_path, 0, 0, ())) is None


def checked(tmp_path: Path, n_common: tuple[int, ...], expect: str) -> CheckedScenario:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY.partition("expect:")[0] + f"expect: {expect}", encoding="utf-8")

    def run(scenario: object) -> Path:
        return write_run(tmp_path / "result", 2, 1, n_common)

    (told,) = check_all([str(path)], [3], (), run)
    assert not told.error
    return told


@pytest.mark.parametrize(
    ("n_common", "expect", "passed"),
    [
        ((40,), "{}", False),
        ((0,), "{}", True),
        ((40,), "{team.merged_robots: {max: 0}}", True),
        ((0,), "{team.merged_robots: {min: 2}}", False),
        ((40,), "{team.merged_robots: {min: 2}}", False),
    ],
)
def test_the_expect_block_has_the_last_word(
    tmp_path: Path, n_common: tuple[int, ...], expect: str, passed: bool
) -> None:
    told = checked(tmp_path, n_common, expect)
    assert told.passed == passed
    assert list(told.unmerged) == ([3] if expect == "{}" and not passed else [])


def test_only_what_needs_no_truth_can_be_expected_without(tmp_path: Path) -> None:
    (tmp_path / "R1").mkdir()
    path = tmp_path / "recorded.yaml"
    text = "schema_version: 1\nname: x\nlogs: [R1]\nexpect: {team.merged_robots: {max: 0}"
    path.write_text(text + "}\n")
    assert load_checked(path).expect.keys() == {"team.merged_robots"}
    path.write_text(text + ", path_rmse_m: {max: 1}}\n")
    with pytest.raises(InputError, match=r"expect\.path_rmse_m: no truth is known"):
        load_checked(path)


def test_check_says_so_in_one_line_and_exits_with_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    result = write_run(tmp_path / "result", 2, 1, (40,))
    monkeypatch.setattr("experiments.evaluation.result.run_scenario", lambda *_: result)
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY.partition("expect:")[0], encoding="utf-8")
    junit = tmp_path / "junit.xml"
    reply = command(capsys, "check", path, "--seeds", "3", "--junit", junit)
    assert reply.code == 1
    assert "tiny, seed 3: no two maps were merged, though some share ground" in reply.out
    assert "0 passed, 1 failed" in reply.out
    assert '<failure message="no two maps were merged' in junit.read_text()
