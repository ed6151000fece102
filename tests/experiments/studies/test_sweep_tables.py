"""Tests of `experiments.studies.sweep_tables`."""

from math import inf, nan
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pytest

from experiments.evaluation import tables
from experiments.studies.sweep_tables import (
    ERRORS,
    GIVEN,
    JoinedTables,
    SweepDataset,
    SweepRun,
    medians_over_runs,
)

EMPTY = {pa.string(): "", pa.bool_(): False}


def row(aligner: str, n_true: int, error_m: float) -> dict[str, object]:
    blank = {field.name: EMPTY.get(field.type, 0) for field in tables.ALL["errors"]}
    errors = {"translation_error_m": error_m, "refined_translation_error_m": error_m / 8}
    return blank | {"aligner": aligner, "n_true": n_true} | errors


def _joined(
    folder: Path, keys: tuple[str, ...], made: dict[SweepRun, list[dict[str, object]]]
) -> SweepDataset:
    dataset = SweepDataset(folder / "sweep", keys)
    tables_of = JoinedTables(dataset)
    tables_of.ask_for(list(made))
    for run, rows in made.items():
        tables_of.add(run, dataset.finished(run, "", [], {"errors": rows}))
    tables_of.write()
    return dataset


def test_medians_over_runs_of_the_runs_own_medians(tmp_path: Path) -> None:
    """A run counts once, however many rows it has; maps with fewer than 3 true pairs do not."""
    written = {
        (0, "2"): [row("svd", 3, error) for error in (1.0, 2.0, 9.0)] + [row("svd", 2, 99.0)],
        (1, "2"): [row("svd", 30, 4.0)],
        (2, "2"): [row("svd", 30, 90.0)],
        (0, "3"): [row("svd", 30, 5.0), row("ransac", 2, 7.0)],
    }
    made = {
        SweepRun(Path("x.yaml"), "x", seed, (("slam.min_count", count),)): rows
        for (seed, count), rows in written.items()
    }
    found = medians_over_runs(_joined(tmp_path, ("slam.min_count",), made), list(made))
    assert found.drop(columns=GIVEN).values.tolist() == [
        ["x 2", "svd", 4.0, 0.5, 3],
        ["x 3", "svd", 5.0, 0.625, 1],
    ]
    assert (found[GIVEN] == 1).all(axis=None)


def test_what_has_no_estimate_is_infinitely_far_off(tmp_path: Path) -> None:
    run = SweepRun(Path("x.yaml"), "x", 0)
    made = {run: [row("svd", 9, error) for error in (1.0, nan, 2.0, nan, nan)]}
    made[SweepRun(Path("x.yaml"), "x", 1)] = [row("svd", 9, 5.0)]  # not asked for
    (found,) = medians_over_runs(_joined(tmp_path, (), made), [run]).to_dict("records")
    assert [found[name] for name in (*ERRORS, *GIVEN)] == [inf, inf, 0.4, 0.4]


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
