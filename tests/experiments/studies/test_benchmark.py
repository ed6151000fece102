"""Tests of `experiments.studies.benchmark`."""

import functools
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2, kstest

from experiments.pipeline.stage import Job
from experiments.pipeline.store import Store
from experiments.plugins import discovery
from experiments.reports.figures.study_figures import draw_benchmark
from experiments.reports.study_files import benchmark_markdown, cell_text
from experiments.scenario.settings import AlignerEntry
from experiments.studies import benchmark as benchmark
from experiments.studies.benchmark import (
    SIGMA_M,
    SIZE_M,
    SUMMARY,
    TRIALS,
    BenchmarkDesign,
    CellSettings,
    entries_of,
    run_benchmark,
    summarise,
    synthetic_pair,
    true_pairs_of,
)
from mapfusion.align.peers import KissMatcher
from mapfusion.align.rigid_motion import residual_covariances
from mapfusion.errors import InputError
from mapfusion.files import read_table
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import generator
from tests.helpers.tiny_scenario import command

SMALL = BenchmarkDesign(
    entries_of(["ransac", "svd"]), 4, pair_counts=(60, 100), outlier_shares=(0.5, 0.9)
)


def quiet(stage: str, done: int, total: int) -> None:
    del stage, done, total


def test_landmarks_without_a_partner_change_nothing_else() -> None:
    alone, among = (
        synthetic_pair(60, 0.5, np.random.default_rng(3), share) for share in (0.0, 0.75)
    )
    assert (len(alone.map_a), len(among.map_a), len(among.map_b)) == (60, 240, 240)
    for name in ("index_a", "index_b", "distance"):
        left, right = (getattr(each.correspondences, name) for each in (alone, among))
        np.testing.assert_array_equal(left, right)
    np.testing.assert_array_equal(among.map_a.position_m[:60], alone.map_a.position_m)
    in_frame_b = se2.transform_points(se2.inverse(among.T_a_b), among.map_a.position_m[60:])
    for own in (in_frame_b, among.map_b.position_m[60:]):
        assert kstest(own[:, 0], "uniform", (-SIZE_M / 2, SIZE_M)).pvalue > 1e-3


def test_good_and_bad_methods_are_told_apart(tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    trials = run_benchmark(SMALL, Store(tmp_path), lambda *now: told.append(now))
    assert told == [("measure the aligners", k, 8) for k in range(9)]
    summary = summarise(trials).set_index(["method", "n_pairs", "outlier_share"])
    assert len(summary) == 8
    ransac = summary.loc["ransac"]
    assert (ransac["n_success"] == 4).all()
    assert ransac["n_true"].tolist() == [30, 6, 50, 10]
    assert ransac["ratio_m"].between(0.5, 2).all()
    assert ransac["refined_ratio_m"].between(0.5, 2).all()
    assert (summary.loc["svd"]["n_success"] < 4).any()
    assert (summary["elapsed_s"] > 0).all()
    assert (summary["oracle_error_m"] < 0.1).all()


def test_all_methods_get_the_same_maps_and_a_second_run_the_same_trials(tmp_path: Path) -> None:
    first = run_benchmark(SMALL, Store(tmp_path / "a"), quiet)
    second = run_benchmark(SMALL, Store(tmp_path / "b"), quiet)
    pd.testing.assert_frame_equal(
        first.drop(columns="elapsed_s"), second.drop(columns="elapsed_s"), check_exact=True
    )
    oracle = first.pivot_table(
        index=["n_pairs", "outlier_share", "trial"], columns="method", values="oracle_error_m"
    )
    np.testing.assert_array_equal(oracle["ransac"], oracle["svd"])


def test_finished_cells_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = run_benchmark(SMALL, Store(tmp_path), quiet)
    measured: list[str] = []
    run_cell = benchmark.run_cell

    @functools.wraps(run_cell)
    def noted(settings: CellSettings, job: Job) -> None:
        measured.append(settings.name)
        run_cell(settings, job)

    monkeypatch.setattr(benchmark, "run_cell", noted)
    pd.testing.assert_frame_equal(run_benchmark(SMALL, Store(tmp_path), quiet), before)
    assert measured == []
    more = BenchmarkDesign(
        (*SMALL.aligners, AlignerEntry(name="wide", method="ransac", parameters={"gate_m": 0.4})),
        4,
        pair_counts=(60,),
        outlier_shares=(0.5, 0.9),
    )
    run_benchmark(more, Store(tmp_path), quiet)
    assert measured == ["wide", "wide"]


def test_a_slow_cell_ends_with_the_trials_it_has(tmp_path: Path) -> None:
    plan = BenchmarkDesign(
        entries_of(["svd"]), 50, budget_s=0.0, pair_counts=(60,), outlier_shares=(0.5,)
    )
    assert summarise(run_benchmark(plan, Store(tmp_path), quiet))["n_trials"].tolist() == [1]


def trial(k: int, status: str = "accepted", **values: object) -> dict[str, object]:
    row = {
        "method": "m",
        "n_pairs": 60,
        "outlier_share": 0.5,
        "trial": k,
        "status": status,
        "reason": "",
        "error_m": 0.02,
        "error_rad": 0.002,
        "refined_status": status,
        "refined_error_m": 0.01,
        "refined_error_rad": 0.001,
        "oracle_error_m": 0.01,
        "oracle_error_rad": 0.001,
        "elapsed_s": 0.001,
    }
    return row | values


def test_what_counts_as_success() -> None:
    nan = {"error_m": np.nan, "error_rad": np.nan, "elapsed_s": np.nan}
    rows = [
        trial(0),
        trial(1, error_m=0.49),
        trial(2, error_m=0.51),  # wrong
        trial(3, error_rad=0.11),  # wrong
        # no answers: what the oracle errs by there is not held against those that are
        trial(4, "refused", oracle_error_m=0.9),
        trial(5, "degenerate", error_m=np.nan, error_rad=np.nan, oracle_error_m=0.9),
        trial(6, "failed", **nan, oracle_error_m=0.9),
        trial(7, oracle_error_m=0.5, error_m=0.04, elapsed_s=0.1),
    ]
    cell = summarise(pd.DataFrame(rows, columns=pd.Index(TRIALS.names))).iloc[0]
    assert (cell["n_trials"], cell["n_success"], cell["n_wrong"], cell["n_failed"]) == (8, 3, 2, 1)
    assert cell["success"] == 3 / 8
    # Wilson 1927 for 3 of 8, z = 1.959964, by hand
    assert cell["success_low"] == pytest.approx(0.13684, abs=1e-5)
    assert cell["success_high"] == pytest.approx(0.69426, abs=1e-5)
    assert cell["error_m"] == 0.04
    assert cell["ratio_m"] == 4.0  # medians on the same maps: 0.04 over 0.01
    assert cell["elapsed_s"] == 0.001
    text = cell_text(cell)
    assert text.startswith("**38** (14-69), 4.00 / 1.00, 1 ms")
    assert text.endswith("2 wrong, 1 failed")


def test_an_absent_package_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = f"{KissMatcher.__module__}:KissMatcher"
    packages = ("far-package", "no_such_module_far")
    far = discovery.KnownMethod("far", discovery.Kind.PEER, target, *packages)
    monkeypatch.setitem(discovery._OWN_METHODS, "far", far)
    entries = entries_of(["far", "ransac"])
    plan = BenchmarkDesign(entries, 2, pair_counts=(60,), outlier_shares=(0.5,))
    summary = summarise(run_benchmark(plan, Store(tmp_path), quiet))
    far = summary.iloc[0]
    assert (far["status"], far["n_failed"], far["n_wrong"]) == ("absent", 0, 0)
    assert np.isnan(far["success"])
    assert cell_text(far) == "absent"
    assert "| far      | absent " in benchmark_markdown(plan, summary)
    low, high = draw_benchmark(summary).axes[1].get_ylim()  # although no ratio is drawn
    assert 0.1 < low < 1 < high < 100
    labels = [text.get_text() for text in draw_benchmark(summary).legends[0].get_texts()]
    assert labels == ["far (absent)", "ransac"]


def test_command_writes_tables_and_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--trials", 2, "--pairs", 60, "--outliers", 0.5, "--results", tmp_path]
    reply = command(capsys, "study", "benchmark", "--aligner", "ransac", *options)
    assert reply.code == 0
    assert "60 correspondences" in reply.out
    folder = tmp_path / "benchmark"
    assert {path.name for path in folder.iterdir()} == {
        "benchmark.png",
        "benchmark.svg",
        "provenance.json",
        "summary.csv",
        "summary.md",
        "summary.parquet",
        "trials.parquet",
    }
    summary = read_table(folder / "summary.parquet", SUMMARY)[0].to_pandas()
    assert pd.read_csv(folder / "summary.csv")["n_success"].tolist() == [2]
    assert summary["n_success"].tolist() == [2]
    assert "**100** (34-100)" in (folder / "summary.md").read_text(encoding="utf-8")
    assert json.loads((folder / "provenance.json").read_text())["trials"] == 2


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (
            ["--aligner", "ransack"],
            "--aligner ransack: unknown aligner 'ransack', known are ransac",
        ),
        (["--outliers", "1.5"], "'--outliers': Input should be less than or equal to 1"),
        (["--trials", "0"], "'--trials': Input should be greater than or equal to 1"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(capsys, "study", "benchmark", *arguments)
    assert reply.code == 2
    assert len(reply.complaints) == 1
    assert complaint in reply.complaints[0]


def test_methods_of_a_scenario(tmp_path: Path, tiny_path: Path) -> None:
    assert [entry.name for entry in entries_of([], tiny_path)] == ["ransac", "svd", "icp"]
    assert [entry.name for entry in entries_of(["icp"], tiny_path)] == ["icp"]
    assert [entry.name for entry in entries_of(["gnc", "svd"], tiny_path)] == ["gnc", "svd"]
    with pytest.raises(InputError, match=r"--aligner nobody: unknown aligner 'nobody'"):
        entries_of(["nobody"], tiny_path)
    assert {"ransac", "opencv", "kiss_matcher"} <= {entry.name for entry in entries_of([])}


def residuals(pair):
    c = pair.correspondences
    moved = se2.transform_points(pair.T_a_b, pair.map_b.position_m[c.index_b])
    return (pair.map_a.position_m[c.index_a] - moved)[:, :2]


def test_true_pairs_differ_by_noise_alone_and_the_covariances_say_how_much():
    pair = synthetic_pair(5000, 0.5, generator(0))
    e = residuals(pair)[pair.is_true]
    S = residual_covariances(
        pair.T_a_b, *(m.covariance_m2[pair.is_true] for m in (pair.map_a, pair.map_b))
    )
    np.testing.assert_allclose(S, np.tile(SIGMA_M**2 * np.eye(2), (len(S), 1, 1)), atol=1e-15)
    squared = np.einsum("ni,nij,nj->n", e, np.linalg.inv(S), e)
    assert kstest(squared, chi2(2).cdf).pvalue > 1e-3


def test_false_pairs_are_uniform_and_independent():
    pair = synthetic_pair(5000, 0.8, generator(1))
    c = pair.correspondences
    world_a = se2.transform_points(se2.inverse(pair.T_a_b), pair.map_a.position_m[c.index_a])
    world_b = pair.map_b.position_m[c.index_b]
    for world in (world_a, world_b):
        for axis in (0, 1):
            uniform = world[~pair.is_true, axis] / SIZE_M + 0.5
            assert kstest(uniform, "uniform").pvalue > 1e-3
    together = np.corrcoef(world_a[~pair.is_true, 0], world_b[~pair.is_true, 0])[0, 1]
    assert abs(together) < 4 / np.sqrt(4000)


@pytest.mark.parametrize(
    ("n", "share", "n_true"),
    [(60, 0.5, 30), (60, 0.95, 3), (60, 0.99, 1), (1000, 0.99, 10), (5000, 0.9, 500)],
)
def test_share_of_true_pairs(n, share, n_true):
    pair = synthetic_pair(n, share, generator(2))
    assert pair.is_true.sum() == true_pairs_of(n, share) == n_true
    assert sorted(pair.correspondences.index_a) == list(range(n))
    assert sorted(pair.correspondences.index_b) == list(range(n))
    assert pair.map_a.planar
    assert pair.map_b.planar


def test_order_and_distances_do_not_tell_which_are_true():
    share = np.zeros(1000)
    for k in range(200):
        pair = synthetic_pair(1000, 0.9, generator(3, k))
        share += pair.is_true[np.argsort(pair.correspondences.distance)]
    halves = share[:500].sum(), share[500:].sum()
    assert halves[0] == pytest.approx(halves[1], rel=0.05)
    first = synthetic_pair(1000, 0.9, generator(3, 0))
    assert np.flatnonzero(first.is_true).std() > 100  # spread over all rows


def test_the_oracle_errs_as_theory_says():
    """Least squares on n points about the origin: variance sigma^2 / n per axis."""
    n, trials = 400, 300
    squares = [
        ((pair.least_squares() - pair.T_a_b)[:2] ** 2).sum()
        for pair in (synthetic_pair(2 * n, 0.5, generator(4, k)) for k in range(trials))
    ]
    scaled = np.sum(squares) / (SIGMA_M**2 / n)
    low, high = chi2(2 * trials).ppf([5e-4, 1 - 5e-4])
    assert low < scaled < high
