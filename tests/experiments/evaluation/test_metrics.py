"""Tests of `experiments.evaluation.metrics`.

The values are skewed, so that a mean in place of a median gives another number.
"""

import math
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import metrics
from experiments.evaluation import tables as result_tables
from experiments.evaluation.alignment_criteria import is_false_merge
from experiments.evaluation.loop_closures import WINDOW_FRAMES
from experiments.evaluation.metrics import (
    ALIGNER_METRICS,
    METRICS,
    Outcome,
    check,
    check_all,
    compute,
)
from experiments.scenario import settings
from experiments.scenario.settings import FUSER_METRICS, AnyScenario, Bound, Scenario, known_metrics
from mapfusion.errors import InputError
from mapfusion.fusion.fusers import FUSERS
from tests.helpers.tiny_scenario import TINY, command


def error(
    aligner: str, iteration: int, translation_m: float, refined_m: float = math.nan, **more: float
) -> dict[str, object]:
    row = {"seed": 0, "robot_a": "A", "robot_b": "B", "iteration": iteration, "aligner": aligner}
    row |= {"translation_error_m": translation_m, "refined_translation_error_m": refined_m}
    row |= {"refined_rotation_error_rad": 0.0, "oracle_distance_m": 0.0, "n_true": 40}
    row |= {"repetition": 0, "lower_bound": False, "alignment_nees": 0.35 * iteration}
    row |= {"accepted": True, "n_common": 60, "n_correspondences": 80, "rotation_error_rad": 0.0}
    return row | more


def team_tables() -> dict[str, pd.DataFrame]:
    return {
        # three robots of seed 0 merged, of seeds 1 and 3 two, of seed 2 none: the first alone
        "team": pd.DataFrame(
            [
                {"seed": seed, "component": component, "source": source, "rmse": rmse}
                for seed, component, source, rmse in (
                    (0, 1, "final", 0.1),
                    (0, 1, "odometry", 9.0),
                    (0, 2, "final", 9.0),
                    (1, 1, "final", 0.3),
                    (3, 1, "final", 2.0),
                )
            ]
        ),
        "team_pairs": pd.DataFrame(
            [
                {"place": place, "accepted": place != "refused", "n_common": n_common}
                | {"refined_translation_error_m": alone_m, "refined_rotation_error_rad": 0.0}
                | {"team_translation_error_m": team_m, "team_rotation_error_rad": -team_m / 10}
                for place, n_common, alone_m, team_m in (
                    ("confirmed", 40, 0.1, 0.1),
                    ("bridge", 3, 0.6, 0.2),  # wrong and believed
                    ("contradicted", 50, 9.0, 0.6),
                    ("refused", 0, math.nan, math.nan),
                )
            ]
        ),
        "fused_motions": pd.DataFrame(
            [
                {"seed": seed, "tx_m": 0.0 if k < n_placed else math.nan}
                for seed, n_placed in ((0, 3), (1, 2), (2, 1), (3, 2))
                for k in range(3)
            ]
        ),
    }


# Two closures of seed 0, of which the second halves the spread, and one of seed 1.
SPREADS = {0: (0.8, 0.6, 0.4, 0.2), 1: (0.4, 0.36)}


def closing_robots() -> pd.DataFrame:
    """Spread of the particles of a robot C, constant between its loop closures."""
    parts = []
    for seed, levels in SPREADS.items():
        spread_m = np.repeat(levels, WINDOW_FRAMES)
        rows = {"seed": seed, "robot": "C", "spread_m": spread_m}
        parts.append(pd.DataFrame(rows | {"iteration": np.arange(len(spread_m))}))
    return pd.concat(parts)


def closing_sightings(seed: int) -> pd.DataFrame:
    """New ground and known ground of that robot in turn."""
    n = len(SPREADS[seed]) * WINDOW_FRAMES
    is_known = np.arange(n) // WINDOW_FRAMES % 2 == 1
    rows = {"seed": seed, "robot": "C", "iteration": np.arange(n)}
    return pd.DataFrame(rows | {"n_new": 2 * ~is_known, "n_returned": 2 * is_known})


@pytest.fixture
def tables() -> dict[str, pd.DataFrame]:
    robots = [
        {"seed": seed, "robot": robot, "path_error_m": path, "odometry_error_m": odometry}
        | {"effective_sample_size": 10.0 * path}
        for seed, robot, errors in (
            (0, "A", [(3, 6), (4, 8)]),  # RMS sqrt(12.5), sqrt(50)
            (0, "B", [(1, 10), (1, 10)]),  # 1, 10
            (1, "A", [(2, 3), (math.nan, 3)]),  # 2, 3
        )
        for path, odometry in errors
    ]
    errors = [
        error("oracle", 10, 0.9, 0.9, n_true=2, refined_rotation_error_rad=0.9),
        error("oracle", 20, 0.5, 0.2, n_true=40, refined_rotation_error_rad=-0.03),
        error("oracle", 20, 0.5, 0.4, n_true=50, refined_rotation_error_rad=0.01, seed=1),
        error("oracle", 20, 0.5, 5.0, n_true=90, refined_rotation_error_rad=0.5, seed=2),
        # few pairs: left out wherever 30 are needed, the first even where 3 are
        error("ransac", 10, 99.0, 99.0, n_true=2, oracle_distance_m=99.0, lower_bound=True),
        error("ransac", 15, 0.1, 99.0, n_true=3, oracle_distance_m=99.0),
        error("ransac", 16, 9.0, 99.0, n_true=4, oracle_distance_m=99.0),
        error("ransac", 20, 0.6, 0.3, oracle_distance_m=0.01),
        error("ransac", 20, 0.9, 0.5, oracle_distance_m=0.03),
        error("ransac", 20, 0.7, math.nan, oracle_distance_m=math.nan, accepted=False),
        # maps whose repetitions scatter by 0, 1 and 10 m, of which quantiles leave four fifths
        *[error("svd", 20 + k, m, 0.3) for k, m in enumerate((2.1, 2.0, 2.1))],
        *[error("svd", 20 + k, m, 0.3) for k, m in ((1, 3.0), (2, 12.1))],
        *[error("icp", 20 + k, m, 0.3) for k, m in enumerate((1.4, 1.2, 30.0))],
    ]
    smoothed_errors = [
        error("oracle", 20, 0.5, 0.1, n_true=40),
        error("ransac", 10, 9.0, 9.0, n_true=2),
        error("ransac", 20, 0.6, 0.2, n_true=40),
        error("ransac", 20, 0.6, 0.2, n_true=40, seed=1, accepted=False),
    ]
    fusion = [
        # RMS of parents sqrt((9 + 16) / 2) and 1, of fused 1
        (0, 3.0, 1.0, 1.0, 2.0, 20.0, 2, True),
        (0, 4.0, 1.0, 1.0, 4.0, 40.0, 2, True),
        (0, 9.0, 9.0, 99.0, 99.0, 99.0, 2, False),
        # another seed: 2, 2 and 1
        (1, 2.0, 2.0, 1.0, 3.0, 30.0, 3, True),
        # and one that is fused badly: 1, 1 and 5
        (2, 1.0, 1.0, 5.0, 3.0, 30.0, 3, True),
    ]
    columns = ["seed", "error_a_m", "error_b_m", "error_fused_m", "nees_with_drift"]
    columns += ["nees_without_drift", "degrees_of_freedom", "true_pair"]
    fits = [(0, "A", 1.0), (0, "B", 3.0), (0, "C", 29.0), (1, "A", 6.0), (2, "A", 50.0)]
    fits += [(0, "fused", 7.0), (1, "fused", 9.0), (2, "fused", 20.0)]
    smoother = {name: [1.0 * k, 8.0 * k, 3.0 * k, np.nan] for k, name in enumerate(SMOOTHER, 1)}
    return (
        {
            "robots": pd.concat([pd.DataFrame(robots), closing_robots()]),
            "sightings": pd.concat([closing_sightings(seed) for seed in (0, 1)]),
            "errors": pd.DataFrame(errors),
            "smoothed_errors": pd.DataFrame(smoothed_errors),
            "fusion": pd.DataFrame(fusion, columns=pd.Index(columns)).assign(
                robot_a="A", robot_b="B"
            ),
            "map_fits": pd.DataFrame(fits, columns=pd.Index(["seed", "map", "rmse_m"])),
            "smoother": pd.DataFrame(smoother),
            "fusers": pd.DataFrame(
                [
                    {"seed": seed, "fuser": fuser, "iteration": iteration}
                    | {name: times * k for k, name in enumerate(FUSER, 1)}
                    for fuser in FUSERS
                    # the last of each seed counts
                    for seed, iteration, times in (
                        (0, 20, 1.0),
                        (0, 10, 9.0),
                        (1, 20, 2.0),
                        (2, 20, 9.0),
                    )
                ]
            ),
        }
        | team_tables()
        | adoption_tables()
    )


ADOPTED = ["landmark_rmse_m", "frame_nees_per_dof", "frame_coverage_95", "shared_share", "sent_kb"]


def adoption_tables() -> dict[str, pd.DataFrame]:
    """Robots that exchange maps; D adopts nothing, and C drops what it adopted."""
    adoptions = [
        (0, "A", "B", 10, "on trial", 0.1),
        (0, "A", "B", 20, "adopted", 0.1),
        (0, "B", "A", 30, "adopted", 0.1),
        (0, "C", "A", 30, "adopted", 9.0),
        (0, "C", "A", 50, "dropped", 9.0),
        (1, "A", "B", 40, "adopted", 9.0),
    ]
    columns = ["seed", "robot", "other", "iteration", "event", "translation_error_m"]
    members = [
        (0, "A", 20, 99.0, 1.0, 99.0),  # the last iteration counts
        (0, "A", 60, 1.0, 2.0, 1.0),
        (0, "B", 60, 3.0, 4.0, 2.0),
        (0, "C", 60, 9.0, 9.0, 4.0),
        (0, "D", 60, 9.0, 1.0, 99.0),
        (1, "A", 60, 4.0, 2.0, 8.0),
        (2, "A", 60, 4.0, 2.0, 99.0),
    ]
    of_members = ["seed", "robot", "iteration", "merged_path_rmse_m", "alone_merged_path_rmse_m"]
    rows = pd.DataFrame(members, columns=pd.Index([*of_members, "times"]))
    for k, name in enumerate(ADOPTED, 1):
        rows[name] = k * rows["times"]
    events = pd.DataFrame(adoptions, columns=pd.Index(columns)).assign(rotation_error_rad=0.0)
    return {"adoptions": events, "team_members": rows}


SMOOTHER = ["path_rmse_m", "filter_over_smoother", "landmark_rmse_m", "gross_share"]
SMOOTHER += ["nees_per_dof", "coverage_95"]
FUSER = ["landmark_rmse_m", "gross_share", "fitted_rmse_m", "fitted_median_m"]
FUSER += ["over_better_parent", "over_better_filter", "nees_per_dof", "frame_nees_per_dof"]
FUSER += ["coverage_95", "frame_coverage_95", "alignment_nees_per_dof", "duplicate_share"]
FUSER += ["alignment_error_m", "alignment_error_rad"]
FUSER += ["alignment_sigma_m", "alignment_sigma_rad"]
KNOWN = {
    "path_rmse_m": 2.0,
    "odometry_rmse_m": math.sqrt(50),
    "path_over_odometry": 2 / math.sqrt(50),
    "effective_sample_size": 20.0,  # 10, 10, 20, 30, 40
    "spread_after_closure": 0.36 / 0.4,  # of 0.75, 0.5; and 0.9
    "oracle_translation_m": 0.4,
    "oracle_rotation_rad": 0.03,
    "true_pairs_at_end": 50.0,
    "false_merges": (3 + 1) / (14 + 3),
    "fused_over_parents": 0.5,  # 1 / ((sqrt(12.5) + 1) / 2), 0.5 and 5
    "fused_nees_with_drift": (1 + 2 + 1 + 1) / 4,
    "fused_nees_without_drift": (10 + 20 + 10 + 10) / 4,
    "landmark_rmse_median_m": 6.0,  # medians 3, 6 and 50; means would be 11, 6 and 50
    "landmark_rmse_worst_m": 50.0,
    "fused_landmark_rmse_m": 9.0,
    "adoption.robots": 1.0,  # 3, 1 and none
    "adoption.first_iteration": 30.0,  # 20 and 40
    "adoption.false_adoptions": 1.0,
    "adoption.path_over_alone": (3 / 4 + 1) / 2,
    "adoption.path_over_alone_worst": 2.0,
    **{f"adoption.{name.removeprefix('frame_')}": 3.0 * k for k, name in enumerate(ADOPTED, 1)},
    "team.merged_robots": 2.0,
    "team.ate_rmse_m": 0.3,
    "team.translation_m": 0.2,
    "team.rotation_rad": 0.02,
    "team.edge_precision": 1 / 2,
    "team.edge_recall": 1 / 3,
    "ransac.refined_oracle_distance_m": 0.03,  # 0.01, 0.03 and none
    "ransac.refined_over_oracle": 0.5 / 0.4,  # no estimate is infinitely far off
    "ransac.estimated_over_oracle": 0.7 / 0.4,
    "ransac.estimated_translation_m": 0.7,  # three maps, one of them thrice
    "ransac.largest_translation_m": 0.9,
    "svd.largest_translation_m": 12.1,
    "ransac.motion_nees_per_dof": 0.35 * (16 + 20) / 2 / 3,  # three iterations, 20 twice
    "ransac.motion_coverage_90": 2 / 4,  # 6.25 is the bound
    "ransac.lead_over_others": 2.0,
    "svd.lead_over_others": 0.7 / 2.5,
    "ransac.scatter_m": 0.24,
    "svd.scatter_m": 0.8,
    "ransac.false_merges": 3 / 6,  # those 99 m off
    "ransac.missed_merges": 1 / 3,
    "ransac.smoothed_refined_over_oracle": 2.0,
    "ransac.smoothed_motion_nees_per_dof": 0.35 * (10 + 20) / 2 / 3,
    "ransac.smoothed_motion_coverage_90": 1 / 2,
    "ransac.smoothed_false_merges": 1 / 3,
    "ransac.smoothed_missed_merges": 1 / 2,
    **{f"smoother.{name}": 3.0 * k for k, name in enumerate(SMOOTHER, 1)},
    **{f"{fuser}.{name}": 2.0 * k for fuser in FUSERS for k, name in enumerate(FUSER, 1)},
}


@pytest.mark.parametrize(("name", "value"), KNOWN.items())
def test_known_answer(tables: dict[str, pd.DataFrame], name: str, value: float) -> None:
    assert compute(name, tables) == pytest.approx(value)


@pytest.mark.parametrize(
    ("changed", "false"),
    [
        ({}, False),
        ({"refined_translation_error_m": 0.51}, True),
        ({"refined_rotation_error_rad": -0.11}, True),
        ({"refined_rotation_error_rad": -0.11, "accepted": False}, False),
        ({"n_common": 2}, True),  # right by chance at best
        ({"n_common": 3}, False),
        ({"n_common": 0, "accepted": False}, False),
    ],
)
def test_false_merge(changed: dict[str, object], false: bool) -> None:
    rows = pd.DataFrame([error("ransac", 20, 0.3, 0.2) | changed])
    assert is_false_merge(rows).tolist() == [false]


def test_no_metric_is_left_untested() -> None:
    of_methods = {name.rpartition(".")[2] for name in KNOWN.keys() - METRICS.keys()}
    assert set(METRICS) <= set(KNOWN)
    assert set(ALIGNER_METRICS) | set(FUSER_METRICS) == of_methods
    assert set(METRICS) == set(settings.RUN_METRICS)
    assert set(ALIGNER_METRICS) == set(settings.ALIGNER_METRICS)
    assert set(known_metrics(["ransac", "svd"], FUSERS)) >= set(KNOWN)


def test_a_fuser_of_a_package_has_metrics_under_its_name(tables: dict[str, pd.DataFrame]) -> None:
    known = known_metrics([], ["kalman", "mine"])
    assert "mine.coverage_95" in known
    assert "joint.coverage_95" not in known  # it is not run
    rows = tables["fusers"]
    mine = rows[rows["fuser"] == "joint"].assign(fuser="mine")
    found = compute("mine.coverage_95", tables | {"fusers": mine})
    assert found == compute("joint.coverage_95", tables)


METHODS_METRICS = [f"ransac.{name}" for name in ALIGNER_METRICS]
METHODS_METRICS += [f"joint.{name}" for name in FUSER_METRICS]


@pytest.mark.parametrize("name", [*METRICS, *METHODS_METRICS])
def test_nothing_to_measure_is_nan(tables: dict[str, pd.DataFrame], name: str) -> None:
    """One robot alone, or a run in which nothing was found: no error, no warning, no pass."""
    empty = {key: table.iloc[:0] for key, table in tables.items()}
    assert np.isnan(compute(name, empty))


def test_all_tables_used_are_named(tables: dict[str, pd.DataFrame]) -> None:
    assert set(metrics.USED_TABLES) == set(tables)


def test_an_oracle_without_error_leaves_no_ratio(tables: dict[str, pd.DataFrame]) -> None:
    errors = tables["errors"].copy()
    errors.loc[errors["aligner"] == "oracle", "refined_translation_error_m"] = 0.0
    assert np.isnan(compute("ransac.refined_over_oracle", tables | {"errors": errors}))


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    """Scenarios a, b and c, without expectations."""
    text = TINY.partition("expect:")[0]
    for name in "abc":
        (tmp_path / f"{name}.yaml").write_text(text.replace("name: tiny", f"name: {name}"))
    return sorted(tmp_path.glob("*.yaml"))


def junit(path: Path) -> tuple[ET.Element, dict[str, ET.Element]]:
    root = ET.parse(path).getroot()
    cases = root.iter("testcase")
    return root, {f"{case.get('classname')}: {case.get('name')}": case for case in cases}


def test_one_that_cannot_run_ends_itself_alone(
    three: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def run(scenario: AnyScenario, *_: object) -> Path:
        if scenario.name == "b" and scenario.seed == 1:
            raise InputError("scenario b: R1[/b]: the way leads through a wall\x1b")
        return tmp_path

    monkeypatch.setattr("experiments.evaluation.result.run_scenario", run)
    monkeypatch.setattr("experiments.evaluation.metrics.check", lambda *_: [])
    monkeypatch.setattr("experiments.evaluation.metrics.nothing_merged", lambda _: None)
    out = tmp_path / "deep" / "junit.xml"
    reply = command(capsys, "check", *three, "--seeds", "0..2", "--junit", out)
    assert reply.code == 2
    assert reply.complaints == ["mapfusion: scenario b: R1[/b]: the way leads through a wall\\x1b"]
    assert "1 of 3 scenarios could not be checked" in reply.out
    root, cases = junit(out)
    assert [root.get(name) for name in ("tests", "failures", "errors", "skipped")] == [*"8010"]
    assert {name for name in cases if name.startswith("b")} == {"b: run, seed 0", "b: run, seed 1"}
    error = cases["b: run, seed 1"].find("error")
    assert error is not None
    assert "through a wall" in str(error.get("message"))
    assert all(float(case.get("time", "x")) >= 0 for case in cases.values())
    assert [suite.get("name") for suite in root] == ["a", "b", "c"]


def test_none_is_run_where_one_cannot_be_read(
    three: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    three[1].write_text("schema_version: 1\nname: b\n")
    out = tmp_path / "junit.xml"
    reply = command(capsys, "check", *three, "nowhere", "--junit", out, "--results", tmp_path / "r")
    assert reply.code == 2
    assert len(reply.complaints) == 2
    assert not (tmp_path / "r").exists()
    root, cases = junit(out)
    assert [root.get(name) for name in ("tests", "errors", "skipped")] == [*"422"]
    assert cases["b: run"].find("error") is not None
    assert cases["nowhere: run"].find("error") is not None
    assert cases["a: run"].find("skipped") is not None


def test_all_scenarios_run_with_the_chosen_aligners(
    three: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ran: list[list[str]] = []

    def run(scenario: AnyScenario, *_: object) -> Path:
        ran.append([entry.name for entry in scenario.align.aligners])
        return tmp_path

    monkeypatch.setattr("experiments.evaluation.result.run_scenario", run)
    monkeypatch.setattr("experiments.evaluation.metrics.check", lambda *_: [])
    monkeypatch.setattr("experiments.evaluation.metrics.nothing_merged", lambda _: None)
    reply = command(capsys, "check", *three[:2], "--aligner", "svd-solved", "--aligner", "gnc")
    assert reply.code == 0, reply.err
    assert ran == 2 * [["svd-solved", "gnc"]]
    refused = command(capsys, "check", three[0], "--aligner", "magic")
    assert (refused.code, len(refused.complaints)) == (2, 1)


def test_a_defect_is_told_and_then_raised(three: list[Path]) -> None:
    def run(scenario: AnyScenario) -> Path:
        raise ZeroDivisionError("of ours")

    checks = check_all([str(three[0])], [0], (), run)
    told = next(checks)
    assert told.error == "ZeroDivisionError: of ours"
    assert list(told.elapsed_s) == [0]
    assert not told.passed
    with pytest.raises(ZeroDivisionError):
        next(checks)


@pytest.mark.parametrize(
    ("value", "low", "high", "passed"),
    [
        (1.0, None, 1.0, True),
        (1.0, 1.0, None, True),
        (1.0, 0.5, 1.5, True),
        (1.0 + 1e-12, None, 1.0, False),
        (1.0 - 1e-12, 1.0, None, False),
        (math.nan, None, 1.0, False),
        (math.nan, 0.0, None, False),
        (math.inf, 0.0, None, False),
    ],
)
def test_verdict(value: float, low: float | None, high: float | None, passed: bool) -> None:
    assert Outcome("s", "m", value, Bound(min=low, max=high), {0: value}).passed == passed


def test_bound_as_a_person_writes_it() -> None:
    texts = [
        Outcome("s", "m", 0, bound, {}).bound_text
        for bound in (Bound(min=1), Bound(max=2.5), Bound(min=1, max=2))
    ]
    assert texts == ["1 <= x", "x <= 2.5", "1 <= x <= 2"]


def test_check_pools_the_seeds(
    tiny: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two results whose path RMSEs are 1 and 3 m: by seed 1 and 3, pooled their median."""
    results = {}
    for seed, error_m in ((4, 1.0), (9, 3.0)):
        results[seed] = tmp_path / str(seed)
        row = dict.fromkeys(result_tables.ALL["robots"].names, 0.0) | {
            "robot": "R1",
            "resampled": False,
        }
        rows = [row | {"path_error_m": error_m, "iteration": i} for i in range(3)]
        frame = pd.DataFrame(rows).astype({"n_landmarks": int})
        result_tables.write(result_tables.table_path(results[seed], "robots"), "robots", frame)
    monkeypatch.setattr(metrics, "USED_TABLES", ("robots",))
    scenario = tiny.model_copy(update={"expect": {"path_rmse_m": Bound(max=2)}})
    (outcome,) = check(scenario, results)
    assert outcome.per_seed == {4: 1.0, 9: 3.0}
    assert outcome.value == 2.0
    assert outcome.passed
