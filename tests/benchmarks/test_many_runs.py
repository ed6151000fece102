"""What a sweep costs beside its runs: handing out a task, joining the rows of runs."""

import pickle
from pathlib import Path

from distributed import Client
from pytest_benchmark.fixture import BenchmarkFixture

from experiments.judge import tables
from experiments.run import dask_worker
from experiments.run.dask_cluster import connected
from experiments.run.frames import TEXT
from experiments.run.tasks import Task
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.joined_tables import JoinedTables, open_dataset
from experiments.study.sweep.sweep_dataset import SweepDataset

N_TASKS, N_RUNS = 200, 500


def test_handing_out_200_tasks_that_do_nothing(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    terms = dask_worker.Terms(tmp_path, 3, dask_worker.code_version())
    with connected(1, None) as client:
        _hand_out(client, terms)  # the worker imports what it needs
        benchmark.pedantic(_hand_out, (client, terms), rounds=5)


def _hand_out(client: Client, terms: dask_worker.Terms) -> None:
    tasks = [Task(f"nothing/{number}", "nothing", int, (), ()) for number in range(N_TASKS)]
    futures = [
        client.submit(dask_worker.perform, task.name, pickle.dumps(task), terms, pure=False)
        for task in tasks
    ]
    client.gather(futures)


def _row(table: str, number: int) -> dict[str, object]:
    columns = tables.ALL[table]
    return {each.name: "R1" if each.type == TEXT else number for each in columns}


def test_joining_500_runs_of_20_frames(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    runs = [SweepRun(Path("x.yaml"), "x", seed) for seed in range(N_RUNS)]
    made = {name: [_row(name, k) for k in range(20)] for name in ("robots", "path_statistics")}

    def wait() -> tuple[tuple[JoinedTables], dict[str, object]]:
        dataset = SweepDataset(tmp_path, ())
        joined = open_dataset(dataset, runs)
        for run in runs:
            dataset.finish(run, "none", ["slam/1"], made)
        return (joined,), {}

    benchmark.pedantic(JoinedTables.join, setup=wait, rounds=3)
