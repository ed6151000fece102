"""A sweep's folder: one Parquet dataset a table, whatever reads it, at any moment."""

from pathlib import Path

import duckdb
import pandas as pd
import pytest

from experiments.judge import tables
from experiments.study.sweep import sweep_dataset as dataset_module
from experiments.study.sweep.combinations import SweepRun, parse_axes
from experiments.study.sweep.sweep_dataset import SweepDataset, open_dataset
from mapfusion.errors import InputError

AXES = parse_axes(["slam.min_count=2,3", "align.repetitions=1"])


def run(seed: int, count: str = "2") -> SweepRun:
    settings = (("slam.min_count", count), ("align.repetitions", "1"))
    return SweepRun(Path("x.yaml"), "x", seed, settings)


@pytest.fixture
def dataset(tmp_path: Path) -> SweepDataset:
    return open_dataset(tmp_path / "sweep", AXES)


FITS = [{"map": "R1", "n_landmarks": 5, "rmse_m": 0.1}, {"map": "R2", "n_landmarks": 6}]


def test_rows_are_preceded_by_what_run_they_are_of(dataset: SweepDataset) -> None:
    dataset.write("map_fits", run(0), FITS)
    dataset.write("map_fits", run(1, "3"), FITS)
    read = pd.read_parquet(dataset.folder / "map_fits")
    described = ["run_id", "scenario", "seed", "slam.min_count", "align.repetitions"]
    assert list(read) == [*described, *tables.ALL["map_fits"].names]
    assert read["run_id"].tolist() == [run(0).run_id] * 2 + [run(1, "3").run_id] * 2
    assert read["slam.min_count"].tolist() == ["2", "2", "3", "3"]
    assert read["rmse_m"].isna().tolist() == [False, True] * 2


def test_empty_tables_keep_their_types(dataset: SweepDataset) -> None:
    dataset.write("errors", run(0), [])
    dataset.write("errors", run(1), pd.DataFrame(columns=pd.Index(tables.ALL["errors"].names)))
    read = pd.read_parquet(dataset.folder / "errors")
    assert not len(read)
    assert read["n_true"].dtype == "int32"


def test_files_that_are_being_written_disturb_no_reader(
    dataset: SweepDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """DuckDB's *.parquet finds files whose names begin with a dot."""
    seen = []
    write_bytes = Path.write_bytes
    dataset.write("map_fits", run(0), FITS)

    def reading_meanwhile(path: Path, data: bytes) -> int:
        path.write_text("half a file")
        for read in (_by_pandas, _by_duckdb):
            seen.append(read(dataset.folder / "map_fits"))
        return write_bytes(path, data)

    monkeypatch.setattr(Path, "write_bytes", reading_meanwhile)
    dataset.write("map_fits", run(1), FITS)
    assert seen == [2, 2]
    assert _by_pandas(dataset.folder / "map_fits") == 4


def _by_pandas(folder: Path) -> int:
    return len(pd.read_parquet(folder))


def _by_duckdb(folder: Path) -> int:
    return duckdb.sql(f"SELECT count(*) FROM '{folder}/*.parquet'").fetchall()[0][0]


def test_a_run_is_held_once_it_is_finished_from_the_same_stages(dataset: SweepDataset) -> None:
    stages = ["drive/1", "judge/2"]
    assert not dataset.holds(run(0), stages)
    dataset.finish(run(0), "TinyRenderer", stages)
    assert dataset.holds(run(0), stages)
    assert not dataset.holds(run(0), ["drive/1", "judge/3"])
    assert not dataset.holds(run(1), stages)
    dataset.path("runs", run(0)).write_bytes(b"damaged")
    assert not dataset.holds(run(0), stages)


def test_changed_source_is_not_held(dataset: SweepDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset.finish(run(0), "TinyRenderer", [])
    assert dataset.holds(run(0), [])
    monkeypatch.setattr(dataset_module, "source_hash", lambda: "other")
    assert not dataset.holds(run(0), [])


def test_a_failed_run_is_one_row_and_nothing_else(dataset: SweepDataset) -> None:
    dataset.write("map_fits", run(0), FITS)
    dataset.finish(run(0), "TinyRenderer", [])
    dataset.fail(run(0), "R1 drove into a wall")
    dataset.fail(run(1), "no reason\nin one line")
    read = pd.read_parquet(dataset.folder / "runs").set_index("seed")
    assert read["status"].tolist() == ["failed", "failed"]
    assert read.loc[0, "reason"] == "R1 drove into a wall"
    assert not dataset.path("map_fits", run(0)).exists()
    assert not dataset.holds(run(0), [])


def test_a_folder_is_opened_again_for_the_same_settings_alone(tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    open_dataset(folder, AXES)
    assert open_dataset(folder, parse_axes(["slam.min_count=9", "align.repetitions=5"])).keys
    with pytest.raises(InputError, match=r"sweep over slam\.min_count, .* over seeds alone"):
        open_dataset(folder, [])
    (folder / "sweep.json").write_text("{}")
    with pytest.raises(InputError, match=r"sweep\.json: damaged"):
        open_dataset(folder, AXES)
    (folder / "sweep.json").write_text('{"schema_version": 9, "settings": []}')
    with pytest.raises(InputError, match="schema_version is 9"):
        open_dataset(folder, AXES)


def test_a_folder_of_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(InputError, match="no folder of a sweep"):
        open_dataset(tmp_path, AXES)
