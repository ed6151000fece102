"""`mapfusion sweep` on the tiny scenario: tables, reuse, more runs, failures, kills."""

import json
import random
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from experiments.evaluation import tables
from experiments.studies.sweep import execute
from experiments.studies.sweep_plan import planned, prepare
from experiments.studies.sweep_tables import RUN_TIMES, JoinedTables
from tests.helpers.killing import KilledCommand, same_rows
from tests.helpers.tiny_scenario import SHORT, command

GRID = ("--set", "slam.filter.n_particles=5,10", "--set", "align.repetitions=1")


@pytest.fixture(scope="module")
def short_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scenario with fewer frames, and of two aligners one that draws nothing."""
    path = tmp_path_factory.mktemp("short") / "short.yaml"
    asked = SHORT.replace("    - {name: icp, method: icp}\n", "")
    # so that all runs have something to fuse: small maps of few particles, which see one place
    asked = asked.replace("frames: 12", "frames: 16")
    asked = asked.replace(
        "align:", "align:\n  evidence: {place_m: 0, max_sigma_rad: 1, least_probability: 0}"
    )
    path.write_text(asked, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("results")


@pytest.fixture(scope="module")
def swept(short_path: Path, results: Path) -> Path:
    """A sweep of four runs on one worker, uninterrupted."""
    asked = prepare([short_path], [0, 1], [GRID[1], GRID[3]], results)
    assert not execute(asked, 1, None, lambda _: None).failed
    return asked.dataset.folder


TABLES = ("runs", "errors", "robots", "fusion", "map_fits", "run_times")


def test_every_table_is_a_dataset_of_all_runs(swept: Path) -> None:
    described = ["run_id", "scenario", "seed", "slam.filter.n_particles", "align.repetitions"]
    for name in TABLES:
        by_pandas = pd.read_parquet(swept / name)
        by_duckdb = duckdb.sql(f"SELECT * FROM '{swept / name}/*.parquet'").df()
        assert list(by_pandas)[:5] == list(by_duckdb)[:5] == described
        assert len(by_pandas) == len(by_duckdb)
        assert by_pandas["run_id"].nunique() == 4, name
        if name in tables.ALL:
            assert list(by_pandas)[5:] == tables.ALL[name].names
    runs = pd.read_parquet(swept / "runs")
    assert (runs["status"] == "finished").all()
    assert (runs["renderer"] == "TinyRenderer").all()
    assert sorted(runs["slam.filter.n_particles"]) == ["10", "10", "5", "5"]
    stages = json.loads(runs["stages"][0])
    kinds = {stage.partition("/")[0] for stage in stages}
    assert kinds > {"drive", "faces", "features", "slam", "aligner", "judge"}
    assert not list(swept.glob(".*"))


def test_no_table_but_that_of_times_tells_times(swept: Path) -> None:
    for name in TABLES:
        columns = pq.read_schema(next((swept / name).iterdir())).names
        timed = {column for column in columns if column.endswith("_s") or column == "seconds"}
        assert bool(timed) == (name == RUN_TIMES)
    times = pd.read_parquet(swept / RUN_TIMES)
    assert (np.isfinite(times["seconds"]) & (times["seconds"] >= 0)).all()
    assert {"features", "slam", "aligner", "align", "judge"} <= set(times["stage"])


def test_a_run_of_the_sweep_is_the_same_as_the_run_alone(
    swept: Path,
    short_path: Path,
    results: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("experiments.reports.figures.drawing.FIGURES", ())
    arguments = ("--set", "slam.filter.n_particles=5", "--set", "align.repetitions=1")
    reply = command(
        capsys, "run", short_path, "--seed", 1, *arguments, "--jobs", 1, "--results", tmp_path
    )
    assert reply.code == 0
    for name in ("errors", "robots", "fusion", "map_fits"):
        rows = pd.read_parquet(swept / name)
        own = rows[(rows["seed"] == 1) & (rows["slam.filter.n_particles"] == "5")]
        alone = tables.read(tables.table_path(tmp_path / "short-1", name), name)
        pd.testing.assert_frame_equal(
            own[alone.columns].reset_index(drop=True), alone, check_exact=True
        )


def test_what_is_shared_is_computed_once(swept: Path, results: Path) -> None:
    n_folders = {path.name: len(list(path.iterdir())) for path in (results / "store").iterdir()}
    assert n_folders["drive"] == n_folders["faces"] == 2  # one a seed
    assert n_folders["features"] == n_folders["log"] == 4  # for each robot
    assert n_folders["slam"] == 8  # for each number of particles
    assert n_folders["judge"] == 4


def test_the_same_again_does_nothing_and_more_adds(
    swept: Path, short_path: Path, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in swept.rglob("*.parquet")}
    arguments = ("sweep", short_path, *GRID, "--jobs", 1, "--results", results)
    reply = command(capsys, *arguments, "--seeds", "0..1")
    assert reply.code == 0
    assert "4 of 4 runs finished" in reply.out.replace("\n", " ")
    assert {path: path.stat().st_mtime_ns for path in swept.rglob("*.parquet")} == before
    more = ("--set", "slam.filter.n_particles=5,10", "--set", "align.repetitions=2,1")
    dry = command(capsys, *arguments[:2], *more, "--results", results, "--dry-run")
    assert dry.code == 0
    assert "4 runs, 2 of them finished" in dry.out
    assert len(pd.read_parquet(swept / "runs")) == 4


def test_other_settings_do_not_go_into_the_same_folder(
    swept: Path, short_path: Path, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(capsys, "sweep", short_path, "--results", results)
    assert reply.code == 2
    assert "seeds alone" in reply.err
    assert "--output" in reply.err


def test_a_run_that_collides_is_a_row(
    swept: Path,
    short_path: Path,
    results: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert swept.is_dir()
    shutil.copytree(results / "store", tmp_path / "store")  # of the run that does not collide
    starts = "[1.2, 1.2, 0.6],[0.2, 0.2, 3.9]"  # the second one drives into the corner
    arguments = ("sweep", short_path, "--set", f"robots.0.start={starts}", "--jobs", 1)
    arguments += ("--set", "slam.filter.n_particles=5", "--set", "align.repetitions=1")
    reply = command(capsys, *arguments, "--results", tmp_path, "--timings")
    assert reply.code == 1
    assert "1 of 2 runs finished" in reply.out.replace("\n", " ")
    sweep = tmp_path / "sweeps" / "short"
    runs = pd.read_parquet(sweep / "runs").set_index("robots.0.start")
    assert runs.loc["[1.2, 1.2, 0.6]", "status"] == "finished"
    assert runs.loc["[0.2, 0.2, 3.9]", "status"] == "failed"
    assert "R1" in runs.loc["[0.2, 0.2, 3.9]", "reason"]
    assert pd.read_parquet(sweep / "errors")["seed"].tolist()
    assert pd.read_parquet(sweep / "errors")["robots.0.start"].unique() == "[1.2, 1.2, 0.6]"
    timings = pd.read_parquet(sweep / "aligner_timings")
    assert set(timings["aligner"]) == {"ransac", "svd"}
    assert set(timings["seed"]) == {0}


def test_a_run_that_needs_more_memory_than_there_is_is_a_row(
    short_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two workers need 0.3 GB each before they begin; other machines have what they have."""
    monkeypatch.setattr("experiments.pipeline.memory.memory_bytes", lambda: 0.6e9)
    asked = prepare([short_path], [0], [], tmp_path)
    (reason,) = execute(asked, 2, None, lambda _: None).failed.values()
    assert "in each of 2 processes (--jobs 1 needs least), this machine has 0.6 GB" in reason
    rows = pd.read_parquet(asked.dataset.folder / "runs")
    assert rows[["status", "reason"]].to_numpy().tolist() == [["failed", reason]]
    assert planned(asked.runs[0], asked.store, JoinedTables(asked.dataset)).left


def test_killed_sweeps_go_on_and_readers_always_find_whole_runs(
    swept: Path, short_path: Path, tmp_path: Path
) -> None:
    sweep = tmp_path / "sweeps" / "short"
    stop = threading.Event()

    def read() -> int:
        while not stop.wait(0.2):
            _whole_runs(sweep)
        return _whole_runs(sweep)

    arguments = ("sweep", short_path, "--seeds", "1", *GRID)
    with ThreadPoolExecutor(1) as pool, KilledCommand(arguments, tmp_path) as killed:
        reader = pool.submit(read)
        try:
            victims = killed.kill_at_random(random.Random(1), ["worker", "everything", "worker"])
            code, complaints = killed.finish()
        finally:
            stop.set()
    assert (code, "Traceback" in complaints) == (0, False), complaints
    assert victims == ["worker", "everything", "worker"]
    assert same_rows(sweep, swept, seed=1)
    assert not list(tmp_path.rglob(".*"))  # what the killed ones had begun to write
    assert reader.result() == 2  # raises what any of its readings did


def _whole_runs(sweep: Path) -> int:
    """Runs that are called finished, each of which must be in all tables."""
    if not any((sweep / "runs").glob("*.parquet")):  # the folder comes first
        return 0
    runs = duckdb.sql(f"SELECT run_id, status FROM '{sweep}/runs/*.parquet'").df()
    assert (runs["status"] == "finished").all()
    for name in ("errors", "robots", "map_fits"):
        found = pd.read_parquet(sweep / name, columns=["run_id"])["run_id"]
        assert set(runs["run_id"]) <= set(found)
    return len(runs)


def test_two_sweeps_at_once_on_one_store(swept: Path, short_path: Path, tmp_path: Path) -> None:
    """They do some work twice, and nothing wrong."""
    arguments = ("sweep", short_path, "--seeds", "1", *GRID)
    with (
        KilledCommand((*arguments, "-o", tmp_path / "one"), tmp_path, jobs=1) as one,
        KilledCommand((*arguments, "-o", tmp_path / "two"), tmp_path, jobs=1) as two,
    ):
        for sweep in (one, two):
            sweep.let_go()
        for sweep in (one, two):
            code, complaints = sweep.finish()
            assert code == 0, complaints
    for name in ("one", "two"):
        assert same_rows(tmp_path / name, swept, seed=1)
