"""Tests of `experiments.evaluation.tables`."""

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pytest

from experiments.evaluation import tables
from experiments.evaluation.result import require_result
from experiments.evaluation.tables import read_provenance, read_scenario, read_world
from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.report.document import contents_of
from experiments.reports.result_export import export_result
from experiments.studies.comparison import compare
from experiments.studies.run_tables import find_runs
from mapfusion.errors import InputError

READERS: dict[str, Callable[[Path], object]] = {
    "report": contents_of,
    "export": lambda result: export_result(result, "tum"),
    "statistics": find_runs,
    "compare": lambda result: compare(result, result),
    "figures": require_result,
}


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A result folder of tables without rows, and the files that describe it."""
    folder = tmp_path / "quick-0"
    described = {"schema_version": 1, "name": "quick", "seed": 0}
    for name in tables.ALL:
        tables.write(tables.table_path(folder, name), name, [])
    for name, content in {
        "scenario": described,
        "world": {},
        "provenance": {"schema_version": 1, "tables": sorted(tables.ALL)},
    }.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("command", READERS)
@pytest.mark.parametrize("name", ["errors", "frame_times", "team_pairs", "tracks"])
def test_a_missing_table_is_named(result: Path, command: str, name: str) -> None:
    tables.table_path(result, name).unlink()
    with pytest.raises(InputError, match=rf"{name}\.parquet: is missing, but the run wrote it"):
        READERS[command](result)


def test_results_that_do_not_name_their_tables_may_lack_some(result: Path) -> None:
    (result / "provenance.json").write_text('{"schema_version": 1}')
    tables.table_path(result, "team").unlink()
    require_result(result)
    assert not find_runs(result).has("team")


@pytest.mark.parametrize("version", [99, 2, 0, "1", None, True, 1.0])
@pytest.mark.parametrize(
    ("name", "read"),
    [("scenario", read_scenario), ("world", read_world), ("provenance", read_provenance)],
)
def test_a_version_that_is_not_known_is_refused(
    result: Path, name: str, read: Callable[[Path], object], version: object
) -> None:
    path = result / f"{name}.json"
    read(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"schema_version": version}))
    with pytest.raises(InputError, match=rf"{name}\.json: schema_version is .*reads up to 1"):
        read(path)


def test_a_sweep_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sweep.json").write_text('{"schema_version": 99, "settings": [], "runs": []}')
    with pytest.raises(InputError, match=r"sweep\.json: schema_version is 99"):
        find_runs(tmp_path)


def test_tables_that_disagree_on_a_robot_are_refused(result: Path) -> None:
    write_names(result, "robots", "robot", ["R1", "R2"])
    for name, column in (("paths", "robot"), ("fused_motions", "robot"), ("errors", "robot_b")):
        others = {other: "R1" for other in ("robot", "robot_a", "robot_b") if other != column}
        write_names(result, name, column, ["R2", "R7", ""], **others)
        found = rf"{name}\.parquet: column {column}: robot R7 is not in robots.*R1, R2"
        with pytest.raises(InputError, match=found):
            ResultTables(result).table(name)


def write_names(result: Path, table: str, column: str, names: list[str], **others: str) -> None:
    """A table with these names in a column; whatever else it has is empty, or zero."""
    none = {pa.string(): "", pa.binary(): b"", pa.bool_(): False}
    rows = {field.name: [none.get(field.type, 0)] * len(names) for field in tables.ALL[table]}
    rows |= {name: [value] * len(names) for name, value in others.items() if name in rows}
    path = tables.table_path(result, table)
    tables.write(path, table, pd.DataFrame(rows | {column: names}))


@pytest.mark.parametrize("name", sorted(tables.ALL))
def test_no_column_of_a_finished_run_is_empty(tiny_result: Path, name: str) -> None:
    """A column whose writer uses another name would be filled with nulls without an error."""
    path = tables.table_path(tiny_result, name)
    if not path.exists():
        pytest.skip("the tiny run does not write this table")
    table = tables.read(path, name)
    if len(table) == 0:
        pytest.skip("the tiny run has no rows for this table")
    assert [column for column in table.columns if table[column].isna().all()] == []
