import errno
import os
import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mapfusion.errors import DamagedFileError, InputError
from mapfusion.files import (
    column,
    point_columns,
    point_fields,
    points_from,
    read_parquet,
    read_table,
    remove_abandoned,
    require_writable,
    schema,
    write_table,
    write_whole,
)

THINGS = schema(
    "test.things",
    2,
    [
        pa.field("name", pa.string()),
        pa.field("weight_kg", pa.float64()),
        pa.field("code", pa.list_(pa.float32(), 3)),
    ],
)
COLUMNS = {
    "name": np.array(["a", "b"]),
    "weight_kg": np.array([1.5, np.nan]),
    "code": np.arange(6, dtype=np.float32).reshape(2, 3),
}


def test_round_trip(tmp_path):
    path = tmp_path / "new" / "things.parquet"
    write_table(path, COLUMNS, THINGS, {"robot": "north"})
    table, attributes = read_table(path, THINGS)
    assert attributes["robot"] == "north"
    assert list(column(table, "name")) == ["a", "b"]
    np.testing.assert_array_equal(column(table, "weight_kg"), COLUMNS["weight_kg"])
    np.testing.assert_array_equal(column(table, "code"), COLUMNS["code"])
    assert list(pd.read_parquet(path).columns) == list(COLUMNS)


def test_of_some_columns_each_is_read_in_the_order_asked_for(tmp_path):
    path = tmp_path / "things.parquet"
    write_table(path, COLUMNS, THINGS)
    some = read_parquet(path, "table of things", ["code", "name"])
    assert some.column_names == ["code", "name"]
    np.testing.assert_array_equal(column(some, "code"), COLUMNS["code"])
    with pytest.raises(DamagedFileError, match=r"things.parquet.*colour"):
        read_parquet(path, "table of things", ["name", "colour"])


def test_rows_of_bytes_come_back_as_bytes(tmp_path):
    things = schema("test.bytes", 1, [pa.field("patch", pa.binary(5))])
    rows = np.arange(35, dtype=np.uint8).reshape(7, 5)[::-1]
    for written in (rows, rows[:0]):
        write_table(tmp_path / "b.parquet", {"patch": written}, things)
        table, _ = read_table(tmp_path / "b.parquet", things)
        np.testing.assert_array_equal(column(table, "patch"), written)
        np.testing.assert_array_equal(column(table.slice(2), "patch"), written[2:])


def test_all_but_bytes_is_packed(tmp_path):
    """Lists as well, of which Parquet knows the values' column by another name."""
    kinds = {"x": pa.float64(), "looks": pa.list_(pa.float32(), 64), "bytes": pa.binary(4)}
    fields = schema("test.kinds", 1, [pa.field(*item) for item in kinds.items()])
    nothing = {"x": np.zeros(9), "looks": np.full((9, 64), np.nan), "bytes": np.zeros((9, 4))}
    write_table(tmp_path / "k.parquet", nothing, fields)
    group = pq.read_metadata(tmp_path / "k.parquet").row_group(0)
    packed = {(own := group.column(i)).path_in_schema: own.compression for i in range(3)}
    assert packed == {"x": "LZ4", "looks.list.element": "LZ4", "bytes": "UNCOMPRESSED"}


def test_empty_table_keeps_its_types(tmp_path):
    path = tmp_path / "things.parquet"
    write_table(path, {name: values[:0] for name, values in COLUMNS.items()}, THINGS)
    table, _ = read_table(path, THINGS)
    assert table.schema.equals(THINGS, check_metadata=False)
    assert column(table, "code").shape == (0, 3)


def test_points_round_trip(tmp_path):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 3, 3))
    position, covariance = rng.normal(size=(7, 3)), root @ np.swapaxes(root, 1, 2)
    points = schema("test.points", 1, point_fields())
    write_table(tmp_path / "p.parquet", point_columns(position, covariance), points)
    table, _ = read_table(tmp_path / "p.parquet", points)
    for read, written in zip(points_from(table), (position, covariance), strict=True):
        np.testing.assert_array_equal(read, written)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "things.parquet"
    path.write_text("old")

    def fail(temporary):
        temporary.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(path, fail)
    assert [p.name for p in tmp_path.iterdir()] == ["things.parquet"]
    assert path.read_text() == "old"


def test_a_full_disk_is_told_with_the_name_of_the_file(tmp_path):
    def full(temporary):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left") as told:
        write_whole(tmp_path / "things.parquet", full)
    assert told.value.filename == str(tmp_path / "things.parquet")

    def elsewhere(temporary):
        (tmp_path / "not there").read_bytes()

    with pytest.raises(FileNotFoundError) as told:
        write_whole(tmp_path / "things.parquet", elsewhere)
    assert told.value.filename == str(tmp_path / "not there")


KILLED = """
import os, signal, sys
from pathlib import Path
from mapfusion.files import write_whole
write_whole(Path(sys.argv[1]), lambda temporary: os.kill(os.getpid(), signal.SIGKILL))
"""


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path):
    path = tmp_path / "figures" / "fig.01.png"
    subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False)
    (left,) = path.parent.iterdir()
    assert left.suffix == ".part"
    kept = [path, path.with_name("other.part"), path.with_name(".fig.elsewhere-1.ab12.part")]
    for file in kept:
        file.write_text("kept")

    def meanwhile(temporary):
        remove_abandoned(tmp_path)
        assert temporary.exists()
        temporary.write_text("kept")

    write_whole(path, meanwhile)
    assert sorted(path.parent.iterdir()) == sorted(kept)
    remove_abandoned(tmp_path / "not there")


def test_a_folder_that_cannot_be_written_is_told_before(tmp_path, monkeypatch):
    require_writable(tmp_path / "new" / "newer")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/new: cannot be written \(.*file is no folder\)"):
        require_writable(tmp_path / "file" / "new")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(InputError, match="no right to write"):
        require_writable(tmp_path / "new")


def damaged(path):
    """Ways to spoil a table, with what the message must say."""
    write_table(path, COLUMNS, THINGS)
    whole = path.read_bytes()

    def missing():
        path.unlink()

    def truncated():
        path.write_bytes(whole[: len(whole) // 2])

    def empty():
        path.write_bytes(b"")

    def foreign():
        path.write_text("name,weight_kg\na,1\n")

    def folder():
        path.unlink()
        path.mkdir()

    def no_metadata():
        pd.DataFrame({"name": ["a"]}).to_parquet(path)

    def other_kind():
        write_table(path, COLUMNS, schema("test.others", 2, list(THINGS)))

    def other_version():
        write_table(path, COLUMNS, schema("test.things", 1, list(THINGS)))

    def column_lost():
        write_table(path, COLUMNS, schema("test.things", 2, list(THINGS)[:2]))

    def other_type():
        fields = [
            pa.field("name", pa.string()),
            pa.field("weight_kg", pa.float32()),
            THINGS.field(2),
        ]
        write_table(path, COLUMNS, schema("test.things", 2, fields))

    return {
        "missing": (missing, "no such file"),
        "truncated": (truncated, "damaged"),
        "empty": (empty, "damaged"),
        "foreign": (foreign, "not a Parquet file"),
        "folder": (folder, "no such file"),
        "no metadata": (no_metadata, "kind is none, expected test.things"),
        "other kind": (other_kind, "kind is test.others, expected test.things"),
        "other version": (other_version, "schema_version is 1"),
        "column lost": (column_lost, "columns are not those of test.things"),
        "other type": (other_type, "columns are not those of test.things"),
    }


@pytest.mark.parametrize(
    "case",
    [
        "missing",
        "truncated",
        "empty",
        "foreign",
        "folder",
        "no metadata",
        "other kind",
        "other version",
        "column lost",
        "other type",
    ],
)
def test_damaged_file_is_one_clear_line(tmp_path, case):
    path = tmp_path / "things.parquet"
    spoil, message = damaged(path)[case]
    spoil()
    with pytest.raises(InputError) as caught:
        read_table(path, THINGS)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert message in text
    assert "\n" not in text


@pytest.mark.parametrize("position", [0.1, 0.5, 0.9])
def test_flipped_bytes_never_pass_unnoticed_as_another_error(tmp_path, position):
    """Whatever is hit, a reader sees an InputError or a table of the right schema."""
    path = tmp_path / "things.parquet"
    write_table(path, COLUMNS, THINGS)
    spoilt = bytearray(path.read_bytes())
    at = int(position * len(spoilt))
    spoilt[at : at + 8] = bytes(255 - b for b in spoilt[at : at + 8])
    path.write_bytes(bytes(spoilt))
    try:
        table, _ = read_table(path, THINGS)
    except InputError:
        return
    assert table.schema.equals(THINGS, check_metadata=False)
