"""Tests of `experiments.studies.sweep`."""

import contextlib
import http.client
import json
import os
import random
import shutil
import signal
import socket
import ssl
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import dask.config
import duckdb
import numpy as np
import pandas as pd
import psutil
import pyarrow.parquet as pq
import pytest
from distributed import Client, Future, LocalCluster
from distributed.security import Security

from experiments.evaluation import tables
from experiments.pipeline.cluster import SweepTerms, code_version, dask_client
from experiments.pipeline.store import Store
from experiments.pipeline.tasks import Task, unfinished
from experiments.reports.study_files import run_statistics
from experiments.studies import sweep as driver_module
from experiments.studies import sweep as plan_module
from experiments.studies.sweep import (
    OnSweepProgress,
    PlannedRun,
    Shard,
    Sweep,
    SweepDriver,
    SweepProgress,
    execute,
    plan_run,
    prepare,
)
from experiments.studies.sweep_tables import RUN_TIMES, JoinedTables, SweepDataset, SweepRun
from mapfusion.errors import InputError, StoreRepairWarning
from tests.helpers import acting
from tests.helpers.killing import KilledCommand, same_rows
from tests.helpers.tiny_scenario import SHORT, command

GRID = ("--set", "slam.filter.n_particles=5,10", "--set", "align.repetitions=1")


@pytest.fixture(scope="module")
def short_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the tiny scenario with fewer frames and two aligners."""
    path = tmp_path_factory.mktemp("short") / "short.yaml"
    asked = SHORT.replace("    - {name: icp, method: icp}\n", "")
    # so that all runs have something to fuse: small maps of few particles, which see one place
    asked = asked.replace("frames: 12", "frames: 16")
    evidence = "{place_m: 0, least_ratio: 1, max_sigma_rad: 1}"
    asked = asked.replace("{least_ratio: 1}", evidence)
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


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_shards_are_disjoint_and_complete(count: int, short_path: Path) -> None:
    runs = prepare([short_path], [0, 1], [GRID[1]], Path("results")).runs
    shards = [Shard(number, count).of(runs) for number in range(1, count + 1)]
    assert [run for shard in shards for run in shard] == runs
    assert max(map(len, shards)) - min(map(len, shards)) <= 1


def test_shards_give_the_same_statistics_as_one_sweep(
    swept: Path, short_path: Path, results: Path, tmp_path: Path
) -> None:
    folders = []
    for text in ("1/2", "2/2"):
        asked = prepare([short_path], [0, 1], [GRID[1], GRID[3]], results, shard=Shard.parse(text))
        assert not execute(asked, 1, None, lambda _: None).failed
        folders.append(asked.dataset.folder)
    assert [folder.name for folder in folders] == ["short.1-of-2", "short.2-of-2"]
    run_statistics([swept], tmp_path / "one", as_json=False)
    run_statistics(folders, tmp_path / "two", as_json=False)
    files = {path.name for path in (tmp_path / "one").iterdir() if path.is_file()}
    assert len(files) > 5
    assert {path.name for path in (tmp_path / "two").iterdir()} >= files
    for name in files:
        one, two = ((tmp_path / folder / name).read_bytes() for folder in ("one", "two"))
        assert one == two, name


@pytest.mark.parametrize("text", ["", "2", "0/2", "3/2", "1/0", "a/b", "-1/2"])
def test_a_wrong_shard_is_told(text: str) -> None:
    with pytest.raises(InputError, match=r"--shard .*expected NUMBER/COUNT"):
        Shard.parse(text)


def test_a_shard_without_runs_is_told(short_path: Path) -> None:
    with pytest.raises(InputError, match="--shard 1/9: the sweep has 2 runs"):
        prepare([short_path], [0, 1], [], Path("results"), shard=Shard(1, 9))


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


def test_a_dry_run_counts_starts_inside_walls_and_names_one(
    short_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    starts = "robots.0.start=[1.2, 1.2, 0.6],[0.02, 1.2, 0.0]"
    arguments = ("sweep", short_path, "--set", starts, "--results", tmp_path, "--dry-run")
    reply = command(capsys, *arguments)
    assert reply.code == 0
    first, second, *_ = reply.out.splitlines()
    assert first == "2 runs, 0 of them finished, 1 that cannot be run"
    assert "scenario short: " in second
    assert "R1" in second


def test_a_run_that_needs_more_memory_than_there_is_is_a_row(
    short_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two workers need 0.3 GB each before they begin; other machines have what they have."""
    monkeypatch.setattr("experiments.pipeline.stages.pipeline.memory_bytes", lambda: 0.6e9)
    asked = prepare([short_path], [0], [], tmp_path)
    (reason,) = execute(asked, 2, None, lambda _: None).failed.values()
    assert "in each of 2 processes (--jobs 1 needs least), this machine has 0.6 GB" in reason
    rows = pd.read_parquet(asked.dataset.folder / "runs")
    assert rows[["status", "reason"]].to_numpy().tolist() == [["failed", reason]]
    assert plan_run(asked.runs[0], asked.store, JoinedTables(asked.dataset)).left


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
    """Both sweeps may compute a stage twice, but results are right."""
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


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """On a machine so busy that Dask would take a killed worker for lost before it is back."""
    busy = {"distributed.deploy.lost-worker-timeout": "0.1s"}
    with dask.config.set(busy), dask_client(2, None) as connection:
        yield connection


class Scene:
    """Made-up tasks in place of a scenario's, by run."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.dataset = SweepDataset(folder / "sweep", ())
        self.terms = SweepTerms(folder / "attempts", 3, code_version())
        self.terms.attempts.mkdir()
        self.tasks: dict[int, list[Task]] = {}
        self.told: list[SweepProgress] = []
        monkeypatch.setattr(driver_module, "plan_run", self._planned)

    def add(self, seed: int, name: str, function: object, *arguments: object, **more: Any) -> None:
        outputs = (self.folder / name.replace("/", "_"),)
        self.tasks.setdefault(seed, []).append(
            Task(name, name.partition("/")[0], cast(Any, function), arguments, outputs, **more)
        )

    def write(self, seed: int, name: str, needs: Sequence[str] = ()) -> None:
        output = self.folder / name.replace("/", "_")
        self.add(seed, name, acting.write, output, name, needs=tuple(needs))

    def _planned(
        self, run: SweepRun, store: Store, joined: JoinedTables, jobs: int | None = None
    ) -> PlannedRun:
        tasks = {task.name: task for task in self.tasks[run.seed]}
        name = f"run/{run.run_id}"
        rows_of = self.dataset.finished
        tasks[name] = Task(name, "tables", rows_of, (run, "", [], {}), (), tuple(tasks))
        left = [] if joined.holds(run, []) else unfinished(tasks, [name])
        return PlannedRun(run, [], tasks, left)

    def execute(self, client: Client) -> SweepDriver:
        return self.execute_telling(client, self.told.append)

    def execute_telling(self, client: Client, tell: OnSweepProgress) -> SweepDriver:
        joined = JoinedTables(self.dataset)
        joined.ask_for(self.sweep.runs)
        driver = SweepDriver(client, self.sweep, joined, self.terms, tell)
        driver.execute()
        return driver

    @property
    def sweep(self) -> Sweep:
        runs = [SweepRun(Path("x.yaml"), "x", seed) for seed in self.tasks]
        return Sweep(runs, Store(self.folder), self.dataset)

    def rows(self) -> dict[int, tuple[str, str]]:
        found = pd.read_parquet(self.dataset.folder / "runs").set_index("seed")
        rows = zip(found["status"], found["reason"], strict=True)
        return dict(zip(found.index.tolist(), rows, strict=True))


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    return Scene(tmp_path, monkeypatch)


def test_failed_runs_stop_no_others(scene: Scene, client: Client) -> None:
    for seed, function in enumerate((acting.collide, acting.run_out_of_memory, acting.break_down)):
        scene.write(seed, f"drive/{seed}")
        scene.add(seed, f"slam/{seed}", function, needs=(f"drive/{seed}",))
        scene.write(seed, f"judge/{seed}", [f"slam/{seed}"])
    scene.write(3, "slam/3")
    driver = scene.execute(client)
    rows = scene.rows()
    assert rows.pop(2)[1].startswith("slam: a defect of mapfusion itself: ZeroDivisionError a bug")
    assert rows == {
        0: ("failed", "scenario x: R1 drove into a wall at (1, 2)"),
        1: ("failed", "slam: MemoryError"),
        3: ("finished", ""),
    }
    assert sorted(driver.progress.failed) == ["x-0", "x-1", "x-2"]
    assert driver.progress.defects == {"x-2"}
    assert driver.progress.failed["x-2"].endswith("failures/x-2.txt")
    details = (scene.dataset.folder / "failures" / "x-2.txt").read_text()
    assert "in break_down" in details
    assert not list(scene.terms.attempts.iterdir())
    # what is mended is computed, what was finished stays
    for seed in range(3):
        scene.tasks[seed][1] = Task(
            f"slam/{seed}", "slam", acting.write, (scene.folder / f"slam_{seed}", ""), ()
        )
    assert not scene.execute(client).progress.failed
    assert set(scene.rows().values()) == {("finished", "")}
    assert scene.told[-1].tasks == Counter(slam=3, judge=3, tables=3)
    assert not list((scene.dataset.folder / "failures").iterdir())


def test_a_damaged_stage_is_made_again_for_all_that_read_it(scene: Scene, client: Client) -> None:
    made = scene.folder / "drive" / "k" / "data"
    acting.write_stage(made, "damaged")
    for seed in range(4):
        output = scene.folder / f"slam_{seed}"
        work = (acting.read_stage, (made, output), (output,), ("drive/k",))
        scene.tasks[seed] = [
            Task("drive/k", "drive", acting.write_stage, (made,), (made,)),
            Task(f"slam/{seed}", "slam", *work),
        ]
    with pytest.warns(StoreRepairWarning, match=r"data: damaged.*the stage drive is discarded"):
        driver = scene.execute(client)
    assert not driver.progress.failed
    assert driver.progress.done == 4
    assert set(scene.rows().values()) == {("finished", "")}
    assert all((scene.folder / f"slam_{seed}").read_text() == "made" for seed in range(4))


def test_a_file_that_is_always_damaged_fails_its_runs(scene: Scene, client: Client) -> None:
    made = scene.folder / "drive" / "k" / "data"
    scene.tasks[0] = [
        Task("drive/k", "drive", acting.write_stage, (made, "damaged"), (made,)),
        Task(
            "slam/0",
            "slam",
            acting.read_stage,
            (made, made),
            (scene.folder / "s",),
            ("drive/k",),
        ),
    ]
    with pytest.warns(StoreRepairWarning):
        driver = scene.execute(client)
    assert "data: damaged" in driver.progress.failed["x-0"]
    assert not driver.progress.defects


def test_what_runs_share_is_done_once_and_fails_once(scene: Scene, client: Client) -> None:
    journal = scene.folder / "journal"
    for seed in range(6):
        scene.add(seed, "drive/good", acting.note, journal, "drive")
        scene.write(seed, f"slam/{seed}", ["drive/good"])
    for seed in range(6, 10):
        scene.add(seed, "drive/bad", acting.collide)
        scene.write(seed, f"slam/{seed}", ["drive/bad"])
    driver = scene.execute(client)
    assert journal.read_text().split() == ["drive"]
    assert len(driver.progress.failed) == 4
    assert not (scene.folder / "slam_6").exists()


@pytest.mark.parametrize("late", [0, 1])
def test_the_reason_is_of_the_first_failure_in_the_plan(
    scene: Scene, client: Client, late: int
) -> None:
    """Whichever of the two fails first."""
    flag = scene.folder / "flag"  # the other raises it: one task more might wait behind this one
    for i, function in enumerate((acting.collide, acting.break_down)):
        if i == late:
            scene.add(0, "wait/0", acting.wait_for, flag, scene.folder / "wait_0")
            scene.add(0, f"slam/{i}", function, needs=("wait/0",))
        else:
            scene.add(0, f"slam/{i}", function, flag)
    scene.execute(client)
    assert scene.rows()[0][1] == "scenario x: R1 drove into a wall at (1, 2)"


def test_killed_workers_are_replaced_and_only_the_killer_gives_up(
    scene: Scene, client: Client
) -> None:
    """Tasks that merely waited at a killed worker are not blamed."""
    deaths = scene.folder / "deaths"
    scene.add(0, "slam/killer", acting.die, deaths)
    scene.add(1, "slam/unlucky", acting.die_first, scene.folder / "bad luck", scene.folder / "x")
    for seed in range(2, 30):
        scene.write(seed, f"slam/{seed}")
    scene.execute(client)
    rows = scene.rows()
    assert rows.pop(0) == ("failed", "slam: its worker was killed 4 times (out of memory?)")
    assert set(rows.values()) == {("finished", "")}
    assert deaths.read_text().split() == ["died"] * 4


@pytest.mark.parametrize("is_noticed", [False, True])
def test_rows_that_died_with_their_worker_are_made_again(
    scene: Scene, client: Client, monkeypatch: pytest.MonkeyPatch, is_noticed: bool
) -> None:
    """Also where the client knows of the loss before it takes the rows."""
    task_ended, killed = SweepDriver._task_ended, list[int]()

    def lose_the_first(driver: SweepDriver, future: Future) -> None:
        if "run/" in future.key and not killed:
            (holders,) = client.who_has([future]).values()
            killed.extend(client.run(os.getpid, workers=list(holders)).values())
            os.kill(killed[0], signal.SIGKILL)
            while is_noticed and future.status == "finished":
                time.sleep(0.01)
        task_ended(driver, future)

    monkeypatch.setattr(SweepDriver, "_task_ended", lose_the_first)
    for seed in range(3):
        scene.write(seed, f"slam/{seed}")
    assert not scene.execute(client).progress.failed
    assert len(killed) == 1
    assert scene.rows() == dict.fromkeys(range(3), ("finished", ""))


def test_what_is_done_is_written_when_the_sweep_is_interrupted(
    scene: Scene, client: Client
) -> None:
    for seed in range(3):
        scene.write(seed, f"slam/{seed}")

    def interrupt(progress: SweepProgress) -> None:
        if progress.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scene.execute_telling(client, interrupt)
    assert list(scene.rows().values()) == [("finished", "")] * 2


@pytest.mark.parametrize("limit", ["_WRITE_EVERY_S", "_MOST_WAITING_BYTES"])
def test_rows_are_written_while_the_sweep_runs(
    scene: Scene, client: Client, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    """After a time, and when they fill the memory."""
    monkeypatch.setattr(driver_module, limit, 0)
    monkeypatch.setattr(driver_module, "_TIMES_AS_LONG", 0)
    for seed in range(3):
        scene.write(seed, f"slam/{seed}")
    written = Counter[int]()

    def look(progress: SweepProgress) -> None:
        if progress.done:
            written[len(scene.rows())] += 1

    scene.execute_telling(client, look)
    assert sorted(written) == [1, 2, 3]


def test_the_scheduler_holds_a_window_of_tasks_alone(
    scene: Scene, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver_module, "TASKS_PER_WORKER", 5)
    n_runs = 60
    for seed in range(n_runs):
        scene.write(seed, f"slam/{seed}")
    most = 0
    tell = scene.told.append

    def count(progress: SweepProgress) -> None:
        nonlocal most
        most = max(most, sum(progress.tasks.values()) - sum(progress.tasks_done.values()))
        tell(progress)

    ended = scene.execute_telling(client, count).progress
    assert most <= 5 * driver_module.MIN_WORKERS + 2
    assert (ended.done, ended.failed) == (n_runs, {})
    assert ended.tasks == ended.tasks_done == Counter({"slam": n_runs, "tables": n_runs})
    deadline = time.monotonic() + 300
    while client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks)):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_runs_that_cannot_be_laid_out_are_rows_too(
    scene: Scene, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.write(0, "slam/0")
    scene.write(1, "slam/1")
    laid_out = scene._planned

    def refusing(run: SweepRun, *more: Any) -> PlannedRun:
        if run.seed == 0:
            raise InputError("no floor plan\nfits seed 0")
        return laid_out(run, *more)

    monkeypatch.setattr(driver_module, "plan_run", refusing)
    scene.execute(client)
    assert scene.rows() == {0: ("failed", "no floor plan fits seed 0"), 1: ("finished", "")}


def test_survey_counts_what_is_shared_and_done(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_module, "require_robots_drive", lambda run, store: None)
    for seed in range(4):
        scene.write(seed, "drive/0")
        scene.write(seed, f"slam/{seed}", ["drive/0"])
    acting.write(scene.folder / "slam_0", "done")
    found = plan_module.survey(scene.sweep)
    assert (found.runs, found.runs_refused) == (4, 0)
    assert found.wanted == Counter(drive=4, slam=4, tables=4)
    assert found.left == Counter(drive=1, slam=3, tables=4)
    assert found.finished["slam"] == 1


def test_an_existing_cluster_of_unfit_workers_ends_the_sweep(scene: Scene, tmp_path: Path) -> None:
    scene.write(0, "slam/0")
    with LocalCluster(
        n_workers=1, processes=False, dashboard_address="localhost:0", silence_logs=50
    ) as cluster:
        assert isinstance(cluster.scheduler_address, str)
        with dask_client(1, cluster.scheduler_address) as client:
            scene.terms = SweepTerms(tmp_path / "elsewhere" / "attempts", 3, code_version())
            with pytest.raises(InputError, match="must be shared by all machines"):
                scene.execute(client)


def test_no_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.pipeline.cluster.CONNECT_TIMEOUT_S", 0.2)
    for address in ("tcp://127.0.0.1:1", "nonsense://x", "tls://127.0.0.1:1"):
        with pytest.raises(InputError, match=f"--scheduler {address}"), dask_client(1, address):
            pass


def listening(client: Client) -> tuple[list[str], list[tuple[str, int]]]:
    """Addresses of scheduler, workers and their nannies, and where all of them listen."""
    cluster = cast(LocalCluster, client.cluster)
    nannies = [nanny.address for nanny in cast(dict, cluster.workers).values()]
    speaking = [cluster.scheduler_address, *client.scheduler_info()["workers"], *nannies]
    web = cluster.scheduler.http_server
    places = [tuple(address.rpartition("/")[2].split(":")) for address in speaking]
    places += [(web.address, web.port)]
    for worker in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has ended
            found = worker.net_connections("inet")
            places += [each.laddr for each in found if each.status == psutil.CONN_LISTEN]
    return speaking, sorted({(host, int(port)) for host, port in places})


def greeting(address: str, context: ssl.SSLContext | None) -> bytes:
    """Return what a server of Dask says first to one who connects; nothing if it refuses."""
    host, port = address.rpartition("/")[2].split(":")
    with contextlib.suppress(OSError), socket.create_connection((host, int(port)), 5) as plain:
        if context is None:
            plain.sendall(bytes(64))
            return plain.recv(4096)
        with context.wrap_socket(plain) as secured:
            return secured.recv(4096)
    return b""


def test_nobody_without_the_credentials_speaks_with_the_cluster(client: Client) -> None:
    client.wait_for_workers(2, timeout=120)  # another test may have killed one
    speaking, places = listening(client)
    assert {host for host, _ in places} == {"127.0.0.1"}
    assert len(places) > len(speaking) >= 5  # the rest are web servers
    stranger = Security.temporary().get_connection_args("client")["ssl_context"]
    nameless = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    nameless.check_hostname, nameless.verify_mode = False, ssl.CERT_NONE
    stranger.verify_mode = ssl.CERT_NONE  # it would talk to anybody
    own = client.security.get_connection_args("client")["ssl_context"]
    for address in speaking:
        assert address.startswith("tls://")
        assert b"pickle-protocol" in greeting(address, own)
        for other in (None, nameless, stranger):
            assert b"pickle-protocol" not in greeting(address, other)


def test_web_servers_of_the_cluster_have_no_pages(client: Client) -> None:
    answers, (_, places) = Counter[int](), listening(client)
    for host, port in places:
        for page in ("/info/main/workers.html", "/metrics", "/health", "/json/counts.json"):
            web = http.client.HTTPConnection(host, port, timeout=0.5)
            try:
                web.request("GET", page)
                answers[web.getresponse().status] += 1
            except (OSError, http.client.HTTPException):  # it speaks another protocol
                pass
            finally:
                web.close()
    assert set(answers) == {404}
