"""A sweep's errors in short."""

from math import inf, nan
from pathlib import Path

import pyarrow as pa

from experiments.evaluation import tables
from experiments.studies.sweep_combinations import SweepRun
from experiments.studies.sweep_tables import (
    ERRORS,
    GIVEN,
    JoinedTables,
    SweepDataset,
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
