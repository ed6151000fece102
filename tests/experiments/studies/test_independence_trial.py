"""Tests of the study of the cost of independence."""

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.pipeline.stages.fuse import read_fusions
from experiments.pipeline.store import Store
from experiments.pipeline.tables import read_rows, write_rows
from experiments.reports.figures.result_tables import NothingToDraw
from experiments.reports.figures.study_figures import draw_independence, since_shared_ground
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from experiments.studies.independence_trial import (
    COSTS,
    STRATEGIES,
    TEAMS,
    Independence,
    cost_rows,
    medians_at_last_iteration,
    run_independence,
    sent_rows,
    team_of,
    team_sizes,
)
from experiments.studies.measured_work import (
    ALIGNMENT,
    COSTS_FILE,
    FILTER,
    FILTER_MAP,
    FUSION,
    LOG,
    SENT,
    SENT_FILE,
    SMOOTHED_MAP,
    SMOOTHING,
    WORK_COSTS,
)
from mapfusion.errors import InputError
from mapfusion.geometry import se2
from tests.helpers.tiny_scenario import assert_refused, command


@pytest.fixture(scope="module")
def scenario(trio_result: Path) -> Simulation:
    found = load_scenario(trio_result.parent / "trio.yaml")
    assert isinstance(found, Simulation)
    return found


@pytest.fixture(scope="module")
def results(trio_result: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of results that holds only the logs of that run."""
    folder = tmp_path_factory.mktemp("results")
    shutil.copytree(trio_result.parent / "store" / "log", folder / "store" / "log")
    return folder


@pytest.fixture(scope="module")
def found(scenario: Simulation, results: Path) -> Independence:
    store = Store.of(results)
    return run_independence([scenario], [3], store, 1, lambda label, done, total: None)


def last(found: pd.DataFrame, strategy: str) -> pd.Series:
    own = found[found["strategy"] == strategy]
    return own[own["iteration"] == own["iteration"].max()].iloc[0]


@pytest.mark.parametrize(
    ("strategy", "fuser"), [("filters", "kalman-drift"), ("once", "joint"), ("anew", "joint")]
)
def test_maps_are_those_of_the_run(
    found: Independence, trio_result: Path, strategy: str, fuser: str
) -> None:
    fusers = tables.read(tables.table_path(trio_result, "fusers"), "fusers")
    theirs = fusers[fusers["fuser"] == fuser].set_index("iteration")
    ours = found.teams[found.teams["strategy"] == strategy]
    assert ours["iteration"].tolist() == theirs.index.tolist() == [40, 43]
    for row in ours.to_dict("records"):
        same = theirs.loc[row["iteration"]]
        assert row["n_merged"] == same["n_robots"] > 1
        for name in ("landmark_rmse_m", "fitted_rmse_m", "gross_share"):
            assert row[name] == same[name]


def fitted_rmse_m(positions: np.ndarray, truth: np.ndarray) -> float:
    """After the best motion of all of them, by the singular values (Umeyama 1991)."""
    p, q = positions - positions.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(q.T @ p)
    R = U @ np.diag([1, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.sqrt(np.mean(np.sum((p @ R.T - q) ** 2, axis=1))))


def test_paths_are_those_of_the_run(
    found: Independence, scenario: Simulation, trio_result: Path
) -> None:
    team = tables.read(tables.table_path(trio_result, "team"), "team").set_index("source")
    assert last(found.teams, "filters")["path_rmse_m"] == pytest.approx(team.loc["final", "rmse"])
    run = EvaluatedRun.of(scenario, Store.of(trio_result.parent))
    robots = run.load_robots()
    smoothed = run.load_smoothed(robots)
    folder = run.store.path(run.pipeline.fusers["joint"])
    for k, fused in read_fusions(folder, [robot.name for robot in robots]).items():
        both = []
        for T, own in zip(fused.T_first_map, smoothed, strict=True):
            truth = own.robot.path
            true = se2.compose(truth.T_world_map, truth.T_map_robot[: k + 1])
            both.append((se2.compose(T, own.paths[k])[:, :2], true[:, :2]))
        error_m = fitted_rmse_m(*map(np.concatenate, zip(*both, strict=True)))
        rows = found.teams[found.teams["iteration"] == k]
        by_strategy = rows.set_index("strategy")["path_rmse_m"]
        assert by_strategy["once"] == by_strategy["anew"] == pytest.approx(error_m, rel=1e-9)
        assert 0 < by_strategy["together"] < 2 * error_m  # in the frame that its fuser found


def test_shared_ground_is_where_errors_are_told_of_it(
    found: Independence, trio_result: Path
) -> None:
    errors = tables.read(tables.table_path(trio_result, "errors"), "errors")
    shared = errors[errors["n_common"] >= 3]["iteration"].min()
    assert last(found.teams, "once")["first_shared"] == shared


def test_bytes_are_those_of_the_files_that_hold_it(
    found: Independence, scenario: Simulation, trio_result: Path
) -> None:
    maps = trio_result / "maps"
    run = EvaluatedRun.of(scenario, Store.of(trio_result.parent))
    logs = [run.store.path(robot.log) for robot in run.pipeline.robots]
    files = {
        "filters": [
            [maps / f"{robot}{part}.parquet" for part in ("", ".viewing", ".frames")]
            for robot in ("R1", "R2", "R3")
        ],
        "once": [list(maps.glob(f"{robot}.smoothed.*")) for robot in ("R1", "R2", "R3")],
        "together": [[log / "frames.parquet", log / "observations.parquet"] for log in logs],
    }
    for strategy, by_robot in files.items():
        sizes_mb = [sum(file.stat().st_size for file in own) / 1e6 for own in by_robot]
        row = last(found.teams, strategy)
        # of a map or log at the end; a path or a name more or less in the header is a few bytes
        assert row["sent_mb"] == pytest.approx(sum(sizes_mb), rel=0.01)
        assert row["most_sent_mb"] == pytest.approx(max(sizes_mb), rel=0.01)
    assert last(found.teams, "anew")["sent_mb"] > 1.5 * last(found.teams, "once")["sent_mb"]


def test_a_second_study_measures_nothing_and_says_the_same(
    found: Independence, scenario: Simulation, results: Path
) -> None:
    told: list[tuple[str, int, int]] = []
    store = Store.of(results)
    again = run_independence([scenario], [3], store, 1, lambda *now: told.append(now))
    pd.testing.assert_frame_equal(again.teams, found.teams, check_exact=True)
    pd.testing.assert_frame_equal(again.costs, found.costs, check_exact=True)
    assert not any("smooth" in label or "FastSLAM" in label for label, *_ in told)


def test_costs_are_of_what_each_way_takes(found: Independence) -> None:
    costs = found.costs
    assert len(costs) == len(found.teams) == 4 * 2
    filters, once, anew, together = (
        last(costs, name) for name in ("filters", "once", "anew", "together")
    )
    assert filters["smoothing_s"] == 0 < once["smoothing_s"] < anew["smoothing_s"]
    assert filters["filter_s"] == once["filter_s"] == together["filter_s"] > 0
    assert once["fusion_s"] < anew["fusion_s"]
    seconds = costs.filter(like="_s").to_numpy(dtype=float)
    assert np.isfinite(seconds).all()
    assert (seconds >= 0).all()


def test_summary_is_of_the_last_maps(found: Independence) -> None:
    summary = medians_at_last_iteration(found)
    assert summary["n_robots"].tolist() == [3] * 4
    assert summary["strategy"].tolist() == ["filters", "once", "anew", "together"]
    row, own = summary.iloc[1], last(found.costs, "once")
    assert row["fitted_rmse_m"] == last(found.teams, "once")["fitted_rmse_m"]
    assert row["robots_s"] == own["filter_s"] + own["smoothing_s"]
    assert row["team_s"] == own["alignment_s"] + own["fusion_s"]
    assert (row["n_seeds"], row["n_whole"]) == (1, 1)


def test_figure_counts_from_shared_ground_and_leaves_out_who_never_meets(
    found: Independence,
) -> None:
    drawn = since_shared_ground(found.teams, found.costs)
    assert (drawn["since"] == drawn["iteration"] - drawn["first_shared"]).all()
    own = found.costs.drop(columns=["robot_peak_mb", "team_peak_mb"])
    total = own.filter(["filter_s", "smoothing_s", "alignment_s", "fusion_s"]).sum(axis=1)
    assert drawn["cpu_s"].to_numpy() == pytest.approx(total.to_numpy())
    figure = draw_independence(found.teams, found.costs)
    assert len(figure.axes) == 6
    apart = found.teams.assign(first_shared=-1)
    with pytest.raises(NothingToDraw):
        draw_independence(apart, found.costs)


@pytest.mark.usefixtures("quick_save", "found")
def test_command_writes_tables_page_and_figure(
    results: Path, trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--results", results, "-o", tmp_path / "out", "--jobs", 1]
    path = trio_result.parent / "trio.yaml"
    reply = command(capsys, "study", "independence", path, "--seeds", 3, "--robots", 3, *where)
    assert reply.code == 0, reply.err
    assert "3 robots, at the end (one map of all in 1 of 1 runs)" in reply.out
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "costs.parquet",
        "independence.png",
        "independence.svg",
        "provenance.json",
        "summary.csv",
        "summary.md",
        "teams.parquet",
    }
    assert len(read_rows(tmp_path / "out" / "teams.parquet", TEAMS)) == 8
    assert len(read_rows(tmp_path / "out" / "costs.parquet", COSTS)) == 8
    page = (tmp_path / "out" / "summary.md").read_text(encoding="utf-8")
    assert "## 3 robots" in page
    assert "all logs in one smoother" in page


def test_a_smaller_team_is_some_of_the_larger_one(scenario: Simulation, results: Path) -> None:
    """The work of two robots and of their alignment is measured once for both teams."""
    run = EvaluatedRun.of(scenario, Store.of(results))
    two, three = (team_of(run, n) for n in (2, 3))
    keys = {name: stage.key for name, stage in three.by_robot.items()}
    assert {name: stage.key for name, stage in two.by_robot.items()} == {
        name: keys[name] for name in ("R1", "R2")
    }
    assert [stage.key for stage in two.by_pair] == [three.by_pair[0].key]
    assert two.iterations == three.iterations
    of_three = {stage.key for stage in three.by_fuser.values()}
    assert not {stage.key for stage in two.by_fuser.values()} & of_three


@pytest.mark.parametrize("text", ["", "1", "4", "2,2", "2,x", "2,,3", "-2", "2.5"])
def test_sizes_that_no_team_can_have(text: str, scenario: Simulation) -> None:
    with pytest.raises(InputError, match=r"^--robots .*from 2 to 3.*trio has 3 robots$"):
        team_sizes(text, scenario)


def test_sizes_are_of_the_scenario(scenario: Simulation) -> None:
    assert team_sizes(None, scenario) == [3]
    assert team_sizes("3,2", scenario) == [2, 3]
    alone = scenario.model_copy(update={"robots": scenario.robots[:1]})
    with pytest.raises(InputError, match="trio: has one robot"):
        team_sizes(None, alone)


def test_bad_input_is_one_line(trio_result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = trio_result.parent / "trio.yaml"
    assert_refused(command(capsys, "study", "independence", path, "--robots", "5"), "--robots 5")
    assert_refused(command(capsys, "study", "independence", "no_such"), "no_such")
    taken = command(capsys, "study", "independence", path, "-o", path / "out")
    assert_refused(taken, "cannot be written")


ITERATIONS = (10, 20, 30)
FIRST, LAST = 10, 30


@dataclass
class MadeUpTeam:
    """Team whose stages have left made-up tables in a folder."""

    root: Path
    iterations: tuple[int, ...] = ITERATIONS
    by_robot: dict[str, str] = field(default_factory=dict)
    by_pair: list[str] = field(default_factory=list)
    by_fuser: dict[str, str] = field(default_factory=dict)

    def folder(self, stage: str) -> Path:
        return self.root / stage


def costs(team: MadeUpTeam, stage: str, *rows: tuple[int, str, float, float]) -> None:
    names = ("iteration", "work", "cpu_s", "peak_mb")
    made = [dict(zip(names, row, strict=True)) for row in rows]
    write_rows(team.folder(stage) / COSTS_FILE, WORK_COSTS, made)


@pytest.fixture
def team(tmp_path: Path) -> MadeUpTeam:
    """Two robots, of which the second stands still, its log at an end, from iteration 20 on."""
    made = MadeUpTeam(tmp_path)
    made.by_robot, made.by_pair = {"R1": "r1", "R2": "r2"}, ["p"]
    filtered = [(10, FILTER, 1.0, 5.0), (20, FILTER, 2.0, 6.0), (30, FILTER, 3.0, 7.0)]
    smoothed = [(10, SMOOTHING, 10.0, 8.0), (20, SMOOTHING, 20.0, 9.0), (30, SMOOTHING, 40.0, 4.0)]
    costs(made, "r1", *filtered, *smoothed)
    costs(
        made,
        "r2",
        *[(10, FILTER, 0.5, 1.0), (20, FILTER, 0.7, 1.0)],
        *[(10, SMOOTHING, 5.0, 2.0), (20, SMOOTHING, 6.0, 30.0)],
    )
    costs(made, "p", *((k, ALIGNMENT, k / 100, 3.0) for k in ITERATIONS))
    for n, fuser in enumerate(dict.fromkeys(strategy.fuser for strategy in STRATEGIES)):
        made.by_fuser[fuser] = fuser
        costs(made, fuser, *((k, FUSION, 1000.0 * n + k, 100.0 * n + k) for k in ITERATIONS))
    for stage, iterations in (("r1", ITERATIONS), ("r2", ITERATIONS[:2])):
        rows = [
            {"iteration": k, "what": what, "n_bytes": k * size}
            for k in iterations
            for what, size in ((FILTER_MAP, 1_000_000), (SMOOTHED_MAP, 3_000_000), (LOG, 9_000_000))
        ]
        write_rows(tmp_path / stage / SENT_FILE, SENT, rows)
    return made


def by_key(rows: Any) -> dict[tuple[str, int], dict[str, float]]:
    return {(row["strategy"], row["iteration"]): row for row in rows}


def numbers(row: dict[str, float], *names: str) -> list[float]:
    return [pytest.approx(row[name]) for name in names]


def test_costs_are_added_up_once_for_each_time_something_is_done(team: MadeUpTeam) -> None:
    rows = by_key(cost_rows(team))
    assert len(rows) == 4 * 3
    own, peaks = ("filter_s", "smoothing_s", "busiest_robot_s"), ("robot_peak_mb", "team_peak_mb")
    shared = ("alignment_s", "fusion_s")
    # the paper's robots do not smooth
    assert numbers(rows["filters", LAST], *own, *shared) == [3.7, 0.0, 3.0, 0.3, 30.0]
    assert numbers(rows["filters", LAST], *peaks) == [7.0, 30.0]
    # each smooths once, the second at its end, and the filter's time is of the whole way
    assert numbers(rows["once", LAST], *own, *shared) == [3.7, 46.0, 43.0, 0.3, 1030.0]
    assert numbers(rows["once", LAST], *peaks) == [30.0, 130.0]
    # the first three times, the second twice: it has nothing new to smooth at the third
    assert numbers(rows["anew", LAST], *own, *shared) == [3.7, 81.0, 73.0, 0.6, 3060.0]
    assert numbers(rows["anew", LAST], *peaks) == [30.0, 130.0]
    assert numbers(rows["together", LAST], *shared) == [0.3, 2030.0]
    # at the first time it is the same whether once or anew
    once, anew = (dict(rows[name, FIRST], strategy="") for name in ("once", "anew"))
    assert once == anew


def test_what_is_sent_again_counts_again(team: MadeUpTeam) -> None:
    rows = by_key(sent_rows(team))
    names = ("sent_mb", "most_sent_mb")
    assert numbers(rows["filters", LAST], *names) == [30.0 + 20.0, 30.0]
    assert numbers(rows["once", LAST], *names) == [150.0, 90.0]
    assert numbers(rows["anew", LAST], *names) == [3.0 * (60 + 30), 180.0]
    # a log is sent once, whole
    assert numbers(rows["together", LAST], *names) == [450.0, 270.0]
    assert numbers(rows["together", FIRST], *names) == [180.0, 90.0]
