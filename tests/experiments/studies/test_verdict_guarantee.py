"""The guarantee of the verdicts: bounds against the binomial law, choices against drawn runs."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom

from experiments.pipeline.tables import read_rows
from experiments.scenario.suite import parse_seeds
from experiments.studies.refusal_rates import (
    CANDIDATES,
    SHARES,
    THRESHOLDS,
    TOTAL,
    clean_runs_needed,
    guarantee,
    least_ratio_of,
    lowest_certified,
    upper_bound,
)
from experiments.studies.run_tables import find_runs
from tests.benchmarks.runs_without_common_ground import commands
from tests.helpers.made_up_runs import write_result, write_sweep
from tests.helpers.tiny_scenario import assert_refused, command

SETTING = "align.evidence.least_ratio"


@pytest.mark.parametrize(("k", "n", "delta"), [(0, 300, 0.05), (3, 301, 0.05), (9, 20, 0.2)])
def test_at_the_bound_so_few_false_runs_have_the_probability_delta(
    k: int, n: int, delta: float
) -> None:
    assert binom.cdf(k, n, upper_bound(k, n, delta)) == pytest.approx(delta, rel=1e-9)


def test_bounds_in_closed_form() -> None:
    assert upper_bound(0, 300, 0.05) == pytest.approx(1 - 0.05 ** (1 / 300))
    assert upper_bound(0, 300, 0.05) == pytest.approx(0.0099, abs=5e-5)
    assert upper_bound(7, 7, 0.05) == 1.0
    n = clean_runs_needed(0.02, 0.05)
    assert upper_bound(0, n, 0.05) <= 0.02 < upper_bound(0, n - 1, 0.05)


@pytest.mark.parametrize("share", [0.01, 0.1, 0.5])
def test_the_bound_covers_the_true_share_often_enough(share: float) -> None:
    rng, n, delta = np.random.default_rng(0), 60, 0.1
    drawn, counts = np.unique(rng.binomial(n, share, 20_000), return_counts=True)
    misses = [upper_bound(int(k), n, delta) < share for k in drawn]
    missed = np.dot(misses, counts) / counts.sum()
    # P(k <= c) jumps with c, so that less than delta may be missed
    assert missed <= delta + 3 * math.sqrt(delta * (1 - delta) / 20_000)
    if share >= 0.1:
        assert missed > 0.03


@pytest.mark.parametrize("step", [0.01, 0.05])
def test_a_threshold_above_the_risk_is_rarely_certified(step: float) -> None:
    """Runs are false from a threshold down, at an evidence of exponential law: risk(t) = e^-t.

    The lowest threshold at which the drawn runs are good enough errs in half of the repetitions.
    """
    rng, n, alpha, delta, repetitions = np.random.default_rng(1), 200, 0.1, 0.2, 2000
    t = np.arange(6.0, 0.0, -step)
    passes = -np.log(rng.uniform(size=(repetitions, n)))
    too_low = too_low_as_drawn = 0
    for own in passes:
        n_false = np.count_nonzero(own[:, None] >= t, axis=0).tolist()
        place = lowest_certified(n_false, n, alpha, delta)
        assert place is not None
        too_low += math.exp(-t[place]) > alpha
        slow = [upper_bound(k, n, delta) <= alpha for k in n_false]
        assert place == slow.index(False) - 1
        as_drawn = t[np.count_nonzero(np.array(n_false) <= alpha * n) - 1]
        too_low_as_drawn += math.exp(-as_drawn) > alpha
    assert too_low / repetitions <= delta + 3 * math.sqrt(delta / repetitions)
    assert too_low / repetitions > delta / 4
    assert too_low_as_drawn / repetitions > 1.5 * delta


def test_it_stops_at_the_first_that_fails() -> None:
    """Counts that fall again, which lower thresholds cannot have, are not looked at."""
    assert lowest_certified([0, 0, 9, 0], 300, 0.02, 0.05) == 1
    assert lowest_certified([9, 0], 300, 0.02, 0.05) is None
    assert lowest_certified([0], clean_runs_needed(0.02, 0.05) - 1, 0.02, 0.05) is None


def answers(*rows: tuple[str, bool, float, float, float, int]) -> pd.DataFrame:
    """Rows of `errors`: (aligner, accepted, error, ratio passed, evidence, true pairs)."""
    names = ["aligner", "accepted", "refined_translation_error_m", "log10_ratio_passed"]
    frame = pd.DataFrame(list(rows), columns=pd.Index([*names, "log10_evidence", "n_true"]))
    frame = frame.assign(robot_a="R1", robot_b="R2", iteration=10, status="accepted")
    return frame.assign(refined_rotation_error_rad=0.0, n_common=frame["n_true"], repetition=0)


NAN, INF = math.nan, math.inf
RIGHT = ("ransac", True, 0.1, 2.5, 2.5, 30)
CLEAN = answers(RIGHT, ("icp", False, 9.0, 1.0, 1.0, 0), ("oracle", True, 9.0, INF, 9.0, 0))
FALSE = answers(RIGHT, ("icp", True, 9.0, 2.0, 2.3, 0))


def swept(folder: Path, made: dict[int, dict[str, pd.DataFrame]], least_ratio: str = "1") -> Path:
    return write_sweep(folder, [*made], [{SETTING: least_ratio}], made=made)


def test_runs_are_false_by_any_method_on_either_kind_of_maps(tmp_path: Path) -> None:
    """The oracle and refused answers do not count; smoothed maps do."""
    far = ("clique", True, 9.0, 4.0, 4.0, 30)
    made = {
        0: {"errors": CLEAN, "smoothed_errors": CLEAN},
        1: {"errors": FALSE, "smoothed_errors": CLEAN},
        2: {"errors": CLEAN, "smoothed_errors": answers(far)},
        3: {"errors": pd.concat([FALSE, FALSE]), "smoothed_errors": FALSE},
    }
    found = guarantee(find_runs(swept(tmp_path / "s", made)), 0.9, 0.05)
    for row, name in zip(found.shares.to_dict("records"), ("world", TOTAL), strict=True):
        assert (row["scenario"], row["n_runs"], row["n_false_runs"]) == (name, 4, 3)
        assert (row["n_right"], row["accepted"]) == (8, 1.0)
        assert row["false_runs_upper"] == upper_bound(3, 4, 0.05)
    at = found.thresholds.set_index(np.round(np.log10(found.thresholds["least_ratio"]), 1))
    assert at["n_false_runs"].loc[[4.1, 4.0, 2.1, 2.0, 0.0]].tolist() == [0, 1, 1, 3, 3]
    assert at["accepted"].loc[[2.6, 2.5]].tolist() == [0, 1]
    best = found.certified
    assert best is not None
    assert best["least_ratio"] == pytest.approx(10**2.1)  # 3 of 4 allow up to 98.7 %


def test_what_has_no_evidence_counts_with_any_threshold(tmp_path: Path) -> None:
    """So do maps that need none, and answers in tables of versions without the ratio."""
    made = {
        0: {"errors": answers(("icp", True, 9.0, NAN, NAN, 0))},
        1: {"errors": answers(("icp", True, 9.0, INF, 0.5, 0))},
        2: {"errors": FALSE.drop(columns="log10_ratio_passed")},  # made-up tables fill it with NaN
    }
    found = guarantee(find_runs(swept(tmp_path / "s", made)), 0.9, 0.05)
    at = found.thresholds.set_index(np.round(np.log10(found.thresholds["least_ratio"]), 1))
    assert (at["n_false_runs"] == 3).all()
    assert found.answers.n_with_any_ratio == 3  # both accepted answers of run 2


def test_lower_thresholds_than_that_of_the_runs_are_not_judged(tmp_path: Path) -> None:
    made = {seed: {"errors": CLEAN} for seed in range(150)}  # 149 are needed
    for least_ratio, lowest in (("1", 1.0), ("100", 100.0), ("2000", 10**3.4)):
        sweep = swept(tmp_path / least_ratio, made, least_ratio)
        found = guarantee(find_runs(sweep), 0.02, 0.05)
        best = found.certified
        assert best is not None
        assert best["least_ratio"] == pytest.approx(lowest)
        assert found.least_ratio == float(least_ratio)
    assert len(CANDIDATES) == 61


def test_a_sweep_without_the_setting_has_the_default(tmp_path: Path) -> None:
    """Also beside a sweep that states a lower ratio, or a result that does."""
    made = {seed: {"errors": CLEAN} for seed in range(150)}  # 149 are needed
    low = swept(tmp_path / "low", made)
    other = write_sweep(tmp_path / "default", [0], scenarios=["other"], made=made)
    assert least_ratio_of(find_runs(low)) == 1
    assert least_ratio_of(find_runs([low, other])) == 1000
    place = write_result(tmp_path, 3, {"errors": CLEAN}, "third")
    assert least_ratio_of(find_runs([low, place])) == 1000
    scenario = json.loads((place / "scenario.json").read_text())
    scenario["align"]["evidence"] = {"least_ratio": 5}
    (place / "scenario.json").write_text(json.dumps(scenario))
    assert least_ratio_of(find_runs([low, place])) == 5


def test_right_answers_are_resampled_by_runs(tmp_path: Path) -> None:
    """Half of 40 runs accept all of their 50 right answers, and the others accept none."""
    refused = ("ransac", False, 0.1, 2.5, 2.5, 30)
    made = {s: {"errors": answers(*([RIGHT if s % 2 else refused] * 50))} for s in range(40)}
    row = guarantee(find_runs(swept(tmp_path / "s", made)), 0.1, 0.05).shares.iloc[-1]
    assert (row["n_right"], row["accepted"]) == (2000, 0.5)
    half = 1.96 * math.sqrt(0.25 / 40)  # of answers: a seventh of it
    assert row["accepted_high"] - row["accepted"] == pytest.approx(half, rel=0.15)
    assert row["accepted"] - row["accepted_low"] == pytest.approx(half, rel=0.15)


def test_runs_of_one_seed_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = {seed: {"errors": CLEAN} for seed in range(4)}
    sweep = write_sweep(tmp_path / "s", [*made], [{SETTING: "1"}], ["one", "two"], made)
    reply = command(capsys, "study", "verdicts", sweep)
    assert "seed 0 and 3 more: of several scenarios" in reply.out
    alone = command(capsys, "study", "verdicts", swept(tmp_path / "t", made))
    assert "of several scenarios" not in alone.out


def test_the_setting_of_a_result_is_in_its_scenario(tmp_path: Path) -> None:
    place = write_result(tmp_path, 3, {"errors": CLEAN})
    assert guarantee(find_runs(place), 0.02, 0.05).least_ratio == 1000
    scenario = json.loads((place / "scenario.json").read_text())
    scenario["align"]["evidence"] = {"least_ratio": 5}
    (place / "scenario.json").write_text(json.dumps(scenario))
    assert guarantee(find_runs(place), 0.02, 0.05).least_ratio == 5


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = {seed: {"errors": FALSE if seed == 7 else CLEAN} for seed in range(300)}
    sweep = swept(tmp_path / "s", made)
    reply = command(capsys, "study", "verdicts", sweep, "-o", tmp_path / "out")
    assert reply.code == 0, reply.err
    assert "lowest certified align.evidence.least_ratio: 1;" in reply.out  # 1 of 300: 1.57 %
    assert "1.57%" in reply.out
    for name, of in (("shares", SHARES), ("thresholds", THRESHOLDS)):
        rows = read_rows(tmp_path / "out" / f"{name}.parquet", of)
        again = pd.read_csv(tmp_path / "out" / f"{name}.csv")
        pd.testing.assert_frame_equal(rows, again, check_dtype=False)
    strict = command(capsys, "study", "verdicts", sweep, "--alpha", "0.005")
    assert "no threshold is certified: 0 of 300" in strict.out
    assert "598 runs" in strict.out


def test_what_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    two = write_sweep(tmp_path / "two", [0], [{SETTING: "1"}, {SETTING: "30"}])
    assert_refused(command(capsys, "study", "verdicts", two), "scenario world, seed 0")
    unknown = write_result(tmp_path, 1, {"errors": CLEAN.assign(n_common=-1)})
    assert_refused(command(capsys, "study", "verdicts", unknown), "no truth")
    assert_refused(command(capsys, "study", "verdicts", tmp_path / "none"), "none")


def test_the_calibration_set_has_all_kinds() -> None:
    *sweeps, study = commands(Path("made"), range(2000, 2301), 2)
    assert len({Path(sweep[1]).stem for sweep in sweeps}) == len(sweeps) == 7
    seeds = [parse_seeds(sweep[sweep.index("--seeds") + 1]) for sweep in sweeps]
    assert {len(own) for own in seeds} == {43}
    assert sorted(itertools.chain(*seeds)) == [*range(2000, 2301)]  # none in two scenarios
    for sweep in sweeps:
        assert "align.evidence.least_ratio=1" in sweep
        assert study[2] == sweep[sweep.index("-o") + 1]
