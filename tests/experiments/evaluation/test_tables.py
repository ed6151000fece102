"""Every declared column of a result's tables is written."""

from pathlib import Path

import pytest

from experiments.evaluation import tables


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
