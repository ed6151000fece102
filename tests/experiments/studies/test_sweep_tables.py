"""Tests of the tables of a sweep."""

import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from math import inf, nan
from pathlib import Path

import duckdb
import pandas as pd
import pyarrow as pa
import pytest

from experiments.evaluation import tables
from experiments.studies import sweep_tables as dataset_module
from experiments.studies import sweep_tables as joined_module
from experiments.studies.run_tables import find_runs
from experiments.studies.sweep_tables import (
    ERRORS,
    GIVEN,
    JoinedTables,
    SweepDataset,
    SweepRun,
    locked_folder,
    medians_over_runs,
)
from mapfusion.errors import InputError, StoreRepairWarning
from mapfusion.files import write_json

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
def run_dataset(tmp_path: Path) -> SweepDataset:
    return SweepDataset(tmp_path / "sweep", tuple(key for key, _ in RUN.settings))


def test_rows_are_preceded_by_what_run_they_are_of(run_dataset: SweepDataset) -> None:
    read = run_dataset.rows("map_fits", RUN, FITS).to_pandas()
    described = ["run_id", "scenario", "seed", "slam.min_count", "align.repetitions"]
    assert list(read) == [*described, *tables.ALL["map_fits"].names]
    assert read[described].to_numpy().tolist() == [[RUN.run_id, "x", 7, "2", "1"]] * 2
    assert read["rmse_m"].isna().tolist() == [False, True]


@pytest.mark.parametrize("none", [[], pd.DataFrame(columns=pd.Index(tables.ALL["errors"].names))])
def test_empty_tables_keep_their_types(run_dataset: SweepDataset, none: object) -> None:
    rows = run_dataset.rows("errors", RUN, none)  # type: ignore[arg-type]
    assert len(rows) == 0
    assert rows.schema.field("n_true").type == pa.int32()


def test_a_finished_run_has_a_row_in_runs_and_its_tables(run_dataset: SweepDataset) -> None:
    found = run_dataset.finished(RUN, "TinyRenderer", ["judge/2"], {"map_fits": FITS, "errors": []})
    assert list(found) == ["map_fits", "errors", "runs"]
    given = run_dataset.rows("map_fits", RUN, FITS)
    assert found["map_fits"].schema.equals(given.schema, check_metadata=True)
    assert found["map_fits"].to_pandas().equals(given.to_pandas())
    (run,) = found["runs"].to_pylist()
    assert (run["status"], run["renderer"], run["stages"]) == (
        "finished",
        "TinyRenderer",
        '["judge/2"]',
    )


def test_a_failed_run_has_its_reason_alone(run_dataset: SweepDataset) -> None:
    found = run_dataset.failed(RUN, "R1 drove\ninto a wall", [])
    assert list(found) == ["runs"]
    (run,) = found["runs"].to_pylist()
    assert (run["status"], run["reason"]) == ("failed", "R1 drove\ninto a wall")


KEYS = ("slam.min_count",)
STAGES = ["drive/1", "judge/2"]


def run(seed: int, count: str = "2") -> SweepRun:
    return SweepRun(Path("x.yaml"), "x", seed, (("slam.min_count", count),))


RUNS = [run(seed) for seed in range(7)]


@pytest.fixture(autouse=True)
def few_runs_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three runs a file, of which two are a row group."""
    monkeypatch.setattr(joined_module, "RUNS_PER_FILE", 3)
    monkeypatch.setattr(joined_module, "_RUNS_PER_GROUP", 2)


@pytest.fixture
def dataset(tmp_path: Path) -> SweepDataset:
    return SweepDataset(tmp_path / "sweep", KEYS)


def opened(dataset: SweepDataset, runs: Sequence[SweepRun]) -> JoinedTables:
    """Return the tables as a new command opens them."""
    joined = JoinedTables(dataset)
    joined.ask_for(runs)
    return joined


def finish(joined: JoinedTables, runs: Iterable[SweepRun], n_landmarks: int = 9) -> None:
    """Add runs: as many fits as the seed says, so that files differ; and a table without a row."""
    for each in runs:
        fits = [{"map": f"R{i}", "n_landmarks": n_landmarks, "rmse_m": 0.1 * i} for i in range(3)]
        made = {"map_fits": fits[: 1 + each.seed % 3], "errors": []}
        joined.add(each, joined.dataset.finished(each, "TinyRenderer", STAGES, made))


def files(dataset: SweepDataset) -> dict[str, bytes]:
    return {str(path.relative_to(dataset.folder)): path.read_bytes() for path in _all(dataset)}


def _all(dataset: SweepDataset) -> Iterator[Path]:
    return dataset.folder.rglob("*.*")


def test_runs_stand_in_their_order_and_nothing_waits(dataset: SweepDataset) -> None:
    joined = opened(dataset, RUNS)
    finish(joined, RUNS[::-1])
    joined.write()
    assert [path.name for path in dataset.files("map_fits")] == [
        f"0000{i}.parquet" for i in (0, 1, 2)
    ]
    fits = pd.read_parquet(dataset.folder / "map_fits")
    assert fits["seed"].tolist() == [0, 1, 1, 2, 2, 2, 3, 4, 4, 5, 5, 5, 6]
    counted = duckdb.sql(f"SELECT count(*) FROM '{dataset.folder}/map_fits/*.parquet'").fetchall()
    assert counted == [(len(fits),)]
    assert pd.read_parquet(dataset.folder / "runs")["seed"].tolist() == list(range(7))
    assert pd.read_parquet(dataset.folder / "errors")["n_true"].dtype == "int32"
    assert joined.waiting_bytes == 0


@pytest.mark.parametrize("steps", [[7], [1] * 7, [2, 4, 1]])
def test_the_same_bytes_in_whatever_order_and_steps(
    steps: list[int], dataset: SweepDataset, tmp_path: Path
) -> None:
    other = SweepDataset(tmp_path / "other", KEYS)
    at_once = opened(other, RUNS)
    finish(at_once, RUNS)
    at_once.write()
    left = [RUNS[place] for place in (4, 1, 6, 3, 2, 0, 5)]
    for step in steps:
        joined = opened(dataset, RUNS)
        finish(joined, left[:step])
        joined.write()
        left = left[step:]
    assert files(dataset) == files(other)


def test_more_runs_come_behind_and_others_stay(dataset: SweepDataset) -> None:
    joined = opened(dataset, RUNS[:2])
    finish(joined, RUNS[:2])
    joined.write()
    more = [run(0, "3"), RUNS[1], RUNS[5]]
    joined = opened(dataset, more)
    finish(joined, [more[0], more[2]])
    joined.write()
    expected = [run.run_id for run in (*RUNS[:2], more[0], more[2])]
    assert joined.run_ids == expected
    assert pd.read_parquet(dataset.folder / "runs")["run_id"].tolist() == expected


def test_readers_find_whole_runs_once_at_any_moment(
    dataset: SweepDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looked at after each file that is put into place or removed, as after a kill there."""
    joined = opened(dataset, RUNS)
    finish(joined, RUNS[:2])
    joined.write()
    finish(joined, RUNS[1:5], n_landmarks=4)  # one of them made again, with other rows
    looks = []

    def look(path: Path) -> None:
        told = pd.read_parquet(dataset.folder / "runs")["seed"].tolist()
        assert len(told) == len(set(told))
        fits = pd.read_parquet(dataset.folder / "map_fits")
        assert not fits.duplicated(["seed", "map"]).any()
        for seed in told:
            assert (fits["seed"] == seed).sum() == 1 + seed % 3, path
        by_ours = find_runs(dataset.folder).read("map_fits")
        assert sorted(by_ours["seed"].unique()) == sorted(told)
        looks.append(sorted(told))

    for name in ("replace", "unlink"):
        monkeypatch.setattr(Path, name, _then(getattr(Path, name), look))
    joined.write()
    monkeypatch.undo()
    assert looks[-1] == [0, 1, 2, 3, 4]
    assert [0] in looks  # while the tables of the other one were replaced
    fits = pd.read_parquet(dataset.folder / "map_fits")
    assert (fits.loc[fits["seed"] == 1, "n_landmarks"] == 4).all()


def _then(work: object, look: object) -> object:
    def both(path: Path, *more: object, **options: object) -> object:
        found = work(path, *more, **options)  # type: ignore[operator]
        if not path.name.endswith(".part") or more:
            look(path)  # type: ignore[operator]
        return found

    return both


def test_writing_that_is_killed_anywhere_is_made_up_for(
    dataset: SweepDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = SweepDataset(tmp_path / "other", KEYS)
    for one in (dataset, other):
        joined = opened(one, RUNS[:5])
        finish(joined, RUNS[:2])
        joined.write()
    finish(joined, RUNS[1:5], n_landmarks=4)
    joined.write()
    for n_files in itertools.count():
        left = iter(range(n_files))
        with monkeypatch.context() as patch:
            for name in ("replace", "unlink"):
                patch.setattr(os, name, _killed_when_none_is(left, getattr(os, name)))
            joined = JoinedTables(dataset)  # the next command makes the same runs again
            finish(joined, RUNS[1:5], n_landmarks=4)
            try:
                joined.write()
            except KeyboardInterrupt:
                continue
        break
    assert n_files > 5
    assert files(dataset) == files(other)


def _killed_when_none_is(left: Iterator[int], work: object) -> object:
    def perhaps(*given: object, **options: object) -> object:
        of_ours = not str(given[0]).endswith(".part") or len(given) > 1
        if of_ours and next(left, None) is None:
            raise KeyboardInterrupt
        return work(*given, **options)  # type: ignore[operator]

    return perhaps


def test_a_run_is_held_once_it_is_finished_from_the_same_stages(
    dataset: SweepDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    joined = opened(dataset, RUNS)
    assert not joined.holds(RUNS[0], STAGES)
    finish(joined, RUNS[:2])
    for _ in ("waiting", "written"):
        assert joined.holds(RUNS[0], STAGES)
        assert not joined.holds(RUNS[0], ["drive/1", "judge/3"])
        assert not joined.holds(RUNS[2], STAGES)
        assert not joined.holds(run(99), STAGES)
        joined.write()
        joined = JoinedTables(dataset)
    monkeypatch.setattr(dataset_module, "source_hash", lambda: "other")
    assert not joined.holds(RUNS[0], STAGES)


@pytest.mark.parametrize("table", ["runs", "map_fits"])
def test_damaged_tables_are_told_and_made_again(dataset: SweepDataset, table: str) -> None:
    joined = opened(dataset, RUNS)
    finish(joined, RUNS)
    joined.write()
    before, path = files(dataset), dataset.path(table, 1)
    path.write_bytes(path.read_bytes()[:-20] + b"!" + path.read_bytes()[-19:])
    joined = JoinedTables(dataset)
    with pytest.warns(StoreRepairWarning, match=rf"{table}/00001\.parquet: damaged"):
        held = [joined.holds(each, STAGES) for each in RUNS]
    assert held == [True] * 3 + [False] * 3 + [True]
    assert path.is_file()  # only looked at, as by --dry-run
    finish(joined, RUNS[3:6])
    joined.write()
    assert files(dataset) == before


def test_a_failed_run_is_one_row_and_nothing_else(dataset: SweepDataset) -> None:
    joined = opened(dataset, RUNS)
    finish(joined, RUNS[:2])
    joined.write()
    joined.add(RUNS[0], dataset.failed(RUNS[0], "R1 drove into a wall", []))
    joined.add(RUNS[2], dataset.failed(RUNS[2], "no reason\nin one line", []))
    joined.write()
    read = pd.read_parquet(dataset.folder / "runs").set_index("seed")
    assert read["status"].tolist() == ["failed", "finished", "failed"]
    assert read.loc[0, "reason"] == "R1 drove into a wall"
    assert pd.read_parquet(dataset.folder / "map_fits")["seed"].unique().tolist() == [1]
    assert not joined.holds(RUNS[0], STAGES)


def test_rows_of_an_earlier_version_lack_its_columns(
    dataset: SweepDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = dataset_module._OWN_FIELDS
    fewer = {name: fields[:-1] for name, fields in own.items() if name == "run_times"}
    joined = opened(dataset, RUNS)
    times = {"run_times": [{"stage": "slam", "key": "k", "figure": "elapsed_s", "seconds": 1.5}]}
    for each, known in ((RUNS[0], own | fewer), (RUNS[1], own)):
        monkeypatch.setattr(dataset_module, "_OWN_FIELDS", known)
        joined.add(each, dataset.finished(each, "", STAGES, times))
        joined.write()
    read = pd.read_parquet(dataset.folder / "run_times")
    assert read["seconds"].fillna(-1).tolist() == [-1, 1.5]


def test_a_folder_is_opened_again_for_the_same_settings_alone(dataset: SweepDataset) -> None:
    opened(dataset, RUNS)
    assert JoinedTables(dataset).run_ids == [each.run_id for each in RUNS]
    with pytest.raises(InputError, match=r"sweep over slam\.min_count, .* over seeds alone"):
        JoinedTables(SweepDataset(dataset.folder, ()))
    write_json(dataset.folder / "sweep.json", {})
    with pytest.raises(InputError, match=r"sweep\.json: damaged"):
        JoinedTables(dataset)
    write_json(dataset.folder / "sweep.json", {"schema_version": 1, "settings": []})
    with pytest.raises(InputError, match=r"schema_version is 1, .*; give it another --output"):
        JoinedTables(dataset)


def test_a_folder_of_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(InputError, match="no folder of a sweep"):
        JoinedTables(SweepDataset(tmp_path, ()))


def test_one_command_alone_writes(tmp_path: Path) -> None:
    with (
        locked_folder(tmp_path),
        pytest.raises(InputError, match="another sweep writes"),
        locked_folder(tmp_path),
    ):
        pass
    with locked_folder(tmp_path):
        pass
