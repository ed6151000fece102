"""Rows of one run of a sweep."""

from pathlib import Path

import pandas as pd
import pyarrow as pa
import pytest

from experiments.evaluation import tables
from experiments.studies.sweep_combinations import SweepRun
from experiments.studies.sweep_tables import SweepDataset

RUN = SweepRun(Path("x.yaml"), "x", 7, (("slam.min_count", "2"), ("align.repetitions", "1")))
FITS = [{"map": "R1", "n_landmarks": 5, "rmse_m": 0.1}, {"map": "R2", "n_landmarks": 6}]


@pytest.fixture
def dataset(tmp_path: Path) -> SweepDataset:
    return SweepDataset(tmp_path / "sweep", tuple(key for key, _ in RUN.settings))


def test_rows_are_preceded_by_what_run_they_are_of(dataset: SweepDataset) -> None:
    read = dataset.rows("map_fits", RUN, FITS).to_pandas()
    described = ["run_id", "scenario", "seed", "slam.min_count", "align.repetitions"]
    assert list(read) == [*described, *tables.ALL["map_fits"].names]
    assert read[described].to_numpy().tolist() == [[RUN.run_id, "x", 7, "2", "1"]] * 2
    assert read["rmse_m"].isna().tolist() == [False, True]


@pytest.mark.parametrize("none", [[], pd.DataFrame(columns=pd.Index(tables.ALL["errors"].names))])
def test_empty_tables_keep_their_types(dataset: SweepDataset, none: object) -> None:
    rows = dataset.rows("errors", RUN, none)  # type: ignore[arg-type]
    assert len(rows) == 0
    assert rows.schema.field("n_true").type == pa.int32()


def test_a_finished_run_has_a_row_in_runs_and_its_tables(dataset: SweepDataset) -> None:
    found = dataset.finished(RUN, "TinyRenderer", ["judge/2"], {"map_fits": FITS, "errors": []})
    assert list(found) == ["map_fits", "errors", "runs"]
    given = dataset.rows("map_fits", RUN, FITS)
    assert found["map_fits"].schema.equals(given.schema, check_metadata=True)
    assert found["map_fits"].to_pandas().equals(given.to_pandas())
    (run,) = found["runs"].to_pylist()
    assert (run["status"], run["renderer"], run["stages"]) == (
        "finished",
        "TinyRenderer",
        '["judge/2"]',
    )


def test_a_failed_run_has_its_reason_alone(dataset: SweepDataset) -> None:
    found = dataset.failed(RUN, "R1 drove\ninto a wall", [])
    assert list(found) == ["runs"]
    (run,) = found["runs"].to_pylist()
    assert (run["status"], run["reason"]) == ("failed", "R1 drove\ninto a wall")
