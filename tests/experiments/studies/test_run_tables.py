import json
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from experiments.evaluation import tables
from experiments.evaluation.alignment_criteria import setting_columns
from experiments.studies import run_tables
from experiments.studies.run_tables import find_runs
from mapfusion.errors import InputError
from mapfusion.files import write_table
from tests.helpers.made_up_runs import errors_of, tables_of, write_result, write_rows, write_sweep


def test_results_and_a_sweep_give_the_same_rows(tmp_path: Path) -> None:
    results = [write_result(tmp_path, seed, tables_of(seed)) for seed in (0, 1)]
    sweep = write_sweep(tmp_path / "sweep", (0, 1))
    one, other = find_runs(results).read("errors"), find_runs(sweep).read("errors")
    assert list(one.columns) == ["run_id", "scenario", "seed", *tables.ALL["errors"].names]
    assert one["run_id"].unique().tolist() == ["world-0", "world-1"]
    assert other["run_id"].unique().tolist() == ["world-0-0", "world-1-0"]
    pd.testing.assert_frame_equal(
        one.drop(columns="run_id"), other.drop(columns="run_id"), check_dtype=False
    )
    assert len(one[one["seed"] == 1]) == len(errors_of(1))


def test_settings_come_in_front_and_only_the_wanted_columns(tmp_path: Path) -> None:
    settings = [{"slam.particles": "50"}, {"slam.particles": "200"}]
    sweep = write_sweep(tmp_path / "sweep", (4,), settings)
    rows = find_runs(sweep).read("errors", ["iteration", "n_true"])
    assert list(rows.columns) == [
        *("run_id", "scenario", "seed", "slam.particles", "iteration", "n_true")
    ]
    assert setting_columns(rows) == ["slam.particles"]
    assert rows["slam.particles"].unique().tolist() == ["50", "200"]


@pytest.mark.parametrize(
    ("rows_of_runs", "seeds"), [(0, [[0], [1], [2]]), (1.5, [[0, 1], [2]]), (9, [[0, 1, 2]])]
)
def test_runs_come_whole_in_batches(
    rows_of_runs: float, seeds: list[list[int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = find_runs(write_sweep(tmp_path / "sweep", range(3), file_a_run=True))
    whole = runs.read("robots")
    monkeypatch.setattr(run_tables, "BATCH_ROWS", rows_of_runs * len(whole) / 3)
    batches = list(runs.batches("robots"))
    assert [rows["seed"].unique().tolist() for rows in batches] == seeds
    pd.testing.assert_frame_equal(pd.concat(batches, ignore_index=True), whole)


def test_files_still_being_written_are_left_alone(tmp_path: Path) -> None:
    sweep = write_sweep(tmp_path / "sweep", (0,))
    (sweep / "errors" / ".world-1-0.parquet.x7.parquet").write_bytes(b"half a file")
    assert find_runs(sweep).read("errors")["seed"].unique().tolist() == [0]


def test_columns_of_later_versions_are_missing_from_older_runs(tmp_path: Path) -> None:
    folder = write_result(tmp_path, 0, tables_of(0))
    rows = find_runs(folder).read("errors", ["n_true"], optional=["not_there_yet"])
    assert rows["not_there_yet"].isna().all()
    with pytest.raises(InputError, match=r"errors\.parquet: has no column not_there_yet"):
        find_runs(folder).read("errors", ["n_true", "not_there_yet"])


def test_failed_runs_are_told(tmp_path: Path) -> None:
    sweep = write_sweep(tmp_path / "sweep", (0,))
    failed = {"run_id": "world-9-0", "scenario": "world", "seed": 9, "status": "failed"}
    write_rows(sweep, "runs", "world-9-0", pd.DataFrame([failed | {"reason": "killed"}]))
    assert find_runs(sweep).failed.to_dict("records") == [
        {"run_id": "world-9-0", "scenario": "world", "seed": 9, "reason": "killed"}
    ]
    assert find_runs(write_result(tmp_path, 0, tables_of(0))).failed.empty


def test_not_a_folder_of_ours(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: no such folder \(expected a result folder"):
        find_runs(tmp_path / "nowhere").read("errors")
    with pytest.raises(InputError, match=r"no scenario\.json and no sweep\.json"):
        find_runs(tmp_path).read("errors")


def test_a_run_given_twice(tmp_path: Path) -> None:
    folder = write_result(tmp_path, 0, tables_of(0))
    with pytest.raises(InputError, match=r"run world-0 is also in"):
        find_runs([folder, folder]).read("errors")


def test_a_table_that_is_not_there(tmp_path: Path) -> None:
    folder = write_result(tmp_path, 0, {"errors": errors_of(0)})
    assert not find_runs(folder).has("robots")
    with pytest.raises(InputError, match=r"world-0: no table robots"):
        find_runs(folder).read("robots")


@pytest.mark.parametrize("content", [b"", b"PAR1 nonsense", b"robot,iteration\n"])
def test_damaged_tables_are_named(content: bytes, tmp_path: Path) -> None:
    folder = write_result(tmp_path, 0, tables_of(0))
    path = tables.table_path(folder, "errors")
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"errors\.parquet: damaged or not a Parquet file"):
        find_runs(folder).read("errors")


def test_another_table_or_one_of_a_newer_program(tmp_path: Path) -> None:
    folder = write_result(tmp_path, 0, tables_of(0))
    path = tables.table_path(folder, "errors")
    path.write_bytes(tables.table_path(folder, "robots").read_bytes())
    with pytest.raises(InputError, match=r"kind is result\.robots, expected errors"):
        find_runs(folder).read("errors")
    newer = {**tables.ALL["robots"].metadata, b"mapfusion.schema_version": b"99"}
    columns: dict[str, list] = {name: [] for name in tables.ALL["robots"].names}
    write_table(
        tables.table_path(folder, "robots"), columns, tables.ALL["robots"].with_metadata(newer)
    )
    with pytest.raises(InputError, match=r"schema_version is 99, this program reads up to"):
        find_runs(folder).read("robots")


@pytest.mark.parametrize("text", ["{", "[]", json.dumps({"name": "x"})])
def test_damaged_descriptions_are_named(text: str, tmp_path: Path) -> None:
    folder = write_result(tmp_path, 0, tables_of(0))
    (folder / "scenario.json").write_text(text)
    with pytest.raises(InputError, match=r"scenario\.json: .*expected a resolved scenario"):
        find_runs(folder)


def test_sweep_rows_must_say_their_run(tmp_path: Path) -> None:
    sweep = write_sweep(tmp_path / "sweep", (0,), file_a_run=True)
    path = sweep / "errors" / "world-0-0.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["seed"]), path)
    with pytest.raises(InputError, match="has no column seed"):
        find_runs(sweep).read("errors")


def test_seeds_are_integers(tmp_path: Path) -> None:
    rows = find_runs(write_result(tmp_path, 5, tables_of(5))).read("robots", ["robot"])
    assert pa.Table.from_pandas(rows).schema.field("seed").type == pa.int64()
