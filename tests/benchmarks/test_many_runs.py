"""Cost of a sweep beside its runs: to hand out tasks, and to write the rows of runs."""

import pickle
from pathlib import Path

from distributed import Client
from pytest_benchmark.fixture import BenchmarkFixture

from experiments.evaluation import tables
from experiments.pipeline import cluster
from experiments.pipeline.cluster import dask_client
from experiments.pipeline.tables import TEXT
from experiments.pipeline.tasks import Task
from experiments.studies.sweep_tables import JoinedTables, SweepDataset, SweepRun

N_TASKS, N_RUNS = 200, 500


def test_handing_out_200_tasks_that_do_nothing(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    terms = cluster.SweepTerms(tmp_path, 3, cluster.code_version())
    with dask_client(1, None) as client:
        _hand_out(client, terms)  # the worker imports what it needs
        benchmark.pedantic(_hand_out, (client, terms), rounds=5)


def _hand_out(client: Client, terms: cluster.SweepTerms) -> None:
    tasks = [Task(f"nothing/{number}", "nothing", int, (), ()) for number in range(N_TASKS)]
    futures = [
        client.submit(cluster.perform, task.name, pickle.dumps(task), terms, pure=False)
        for task in tasks
    ]
    client.gather(futures)


def _row(table: str, number: int) -> dict[str, object]:
    columns = tables.ALL[table]
    return {each.name: "R1" if each.type == TEXT else number for each in columns}


def test_writing_500_runs_of_20_frames(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    runs = [SweepRun(Path("x.yaml"), "x", seed) for seed in range(N_RUNS)]
    made = {name: [_row(name, k) for k in range(20)] for name in ("robots", "path_statistics")}

    def wait() -> tuple[tuple[JoinedTables], dict[str, object]]:
        dataset = SweepDataset(tmp_path, ())
        joined = JoinedTables(dataset)
        joined.ask_for(runs)
        for run in runs:
            joined.add(run, dataset.finished(run, "none", ["slam/1"], made))
        return (joined,), {}

    benchmark.pedantic(JoinedTables.write, setup=wait, rounds=3)
