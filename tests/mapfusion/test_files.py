import errno
import hashlib
import json
import os
import pickle
import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mapfusion.errors import DamagedFileError, InputError
from mapfusion.files import (
    DIGEST,
    column,
    float_fields,
    point_columns,
    point_fields,
    points_from,
    read_json,
    read_parquet,
    read_table,
    remove_abandoned,
    require_writable,
    schema,
    write_atomically,
    write_json,
    write_table,
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
        write_atomically(path, fail)
    assert [p.name for p in tmp_path.iterdir()] == ["things.parquet"]
    assert path.read_text() == "old"


def test_a_full_disk_is_told_with_the_name_of_the_file(tmp_path):
    def full(temporary):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left") as told:
        write_atomically(tmp_path / "things.parquet", full)
    assert told.value.filename == str(tmp_path / "things.parquet")

    def elsewhere(temporary):
        (tmp_path / "not there").read_bytes()

    with pytest.raises(FileNotFoundError) as told:
        write_atomically(tmp_path / "things.parquet", elsewhere)
    assert told.value.filename == str(tmp_path / "not there")


KILLED = """
import os, signal, sys
from pathlib import Path
from mapfusion.files import write_atomically
write_atomically(Path(sys.argv[1]), lambda temporary: os.kill(os.getpid(), signal.SIGKILL))
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

    write_atomically(path, meanwhile)
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
        "folder": (folder, "is a folder"),
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


def test_a_flipped_bit_of_a_table_is_noticed_or_changes_no_value(tmp_path):
    """Every seventh byte is tried; the campaign tries thousands of bits in all kinds of files."""
    path = tmp_path / "things.parquet"
    write_table(path, COLUMNS, THINGS, {"robot": "north"})
    data, before, told = path.read_bytes(), read_table(path, THINGS), 0
    for at in range(0, len(data), 7):
        flipped = bytearray(data)
        flipped[at] ^= 1 << at % 8
        path.write_bytes(flipped)
        try:
            table, attributes = read_table(path, THINGS)
        except InputError as error:
            told += str(error).startswith(str(path))
            continue
        assert column(table, "name").tolist() == ["a", "b"]
        for name in ("weight_kg", "code"):
            assert column(table, name).tobytes() == COLUMNS[name].tobytes()
        assert attributes == before[1]
    assert told > len(data) / 14


def test_pages_carry_checksums_and_others_can_read_and_write_the_table_again(tmp_path):
    path, again = tmp_path / "things.parquet", tmp_path / "again.parquet"
    write_table(path, COLUMNS, THINGS)
    pq.write_table(pq.read_table(path), again)
    assert column(read_table(again, THINGS)[0], "name").tolist() == ["a", "b"]
    data, first = bytearray(path.read_bytes()), pq.read_metadata(path).row_group(0).column(0)
    data[first.dictionary_page_offset + first.total_compressed_size - 1] ^= 1
    with pytest.raises(OSError, match="CRC"):
        pq.read_table(pa.BufferReader(bytes(data)), page_checksum_verification=True)
    path.write_bytes(data)
    with pytest.raises(DamagedFileError, match=r"things\.parquet: damaged.*CRC"):
        read_table(path, THINGS)


def zigzag(number):
    """An integer as Thrift writes it: 7 bits a byte, the last ones first."""
    number, coded = 2 * number, b""
    while number > 127:
        coded += bytes([number & 127 | 128])
        number >>= 7
    return coded + bytes([number])


def test_a_column_that_shows_the_values_of_another_is_noticed(tmp_path):
    """Its page has a checksum that fits, so that Arrow reads it."""
    path, things = tmp_path / "xy.parquet", schema("test.xy", 1, float_fields("xyz"))
    write_table(path, {name: np.arange(40.0) + ord(name) for name in "xyz"}, things)
    group = pq.read_metadata(path).row_group(0)
    y, z = (b"\x26" + zigzag(group.column(k).data_page_offset) for k in (1, 2))
    data = path.read_bytes()
    assert (len(y), data.count(z)) == (len(z), 1)
    path.write_bytes(data.replace(z, y))
    wrong = pq.read_table(path, page_checksum_verification=True)
    assert wrong["z"].equals(wrong["y"])
    with pytest.raises(DamagedFileError, match="two of its columns overlap"):
        read_table(path, things)
    path.write_bytes(data)
    read_table(path, things)


def test_attributes_that_differ_between_the_copies_of_the_schema(tmp_path):
    path = tmp_path / "things.parquet"
    write_table(path, COLUMNS, THINGS, {"robot": "north"})
    data = path.read_bytes()
    path.write_bytes(data.replace(b"north", b"nortH"))
    with pytest.raises(DamagedFileError, match="two copies of its schema differ"):
        read_table(path, THINGS)


def test_metadata_that_is_lost_makes_no_table_of_another_program(tmp_path):
    path = tmp_path / "things.parquet"
    write_table(path, COLUMNS, THINGS, {"robot": "north"})
    data, end = path.read_bytes(), b"\x00\x19\x4c"  # of the row groups; then four texts follow
    assert data.count(end) == 1
    path.write_bytes(data.replace(end, b"\x01\x19\x4c"))
    assert not pq.read_metadata(path).metadata
    with pytest.raises(DamagedFileError, match="damaged"):
        read_parquet(path, "table")


def sealed_as_before(data, at):
    """A file's bytes with a digest at a place, as they were written before 2026-11."""
    line = b"mapfusion.sha256 " + b"0" * 64 + b"\n"
    whole = data[:at] + line + data[at:]
    return whole.replace(b"0" * 64, hashlib.sha256(whole).hexdigest().encode(), 1)


def test_tables_with_a_digest_before_their_footer_are_read(tmp_path):
    path = tmp_path / "things.parquet"
    write_table(path, COLUMNS, THINGS, {"robot": "north"})
    data, before = path.read_bytes(), read_table(path, THINGS)
    footer = len(data) - 8 - int.from_bytes(data[-8:][:4], "little")
    path.write_bytes(sealed_as_before(data, footer))
    assert len(path.read_bytes()) > len(data)
    table, attributes = read_table(path, THINGS)
    assert attributes == before[1]
    assert table["code"].equals(before[0]["code"])


@pytest.mark.parametrize("text", ["null", "[1]", "3", '{"a": ', "\xff", "[" * 100_000])
def test_json_that_is_no_object(text, tmp_path):
    path = tmp_path / "x.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DamagedFileError, match=r"x\.json: .*expected a test"):
        read_json(path, "test")


def test_a_flipped_bit_of_a_json_object_is_noticed(tmp_path):
    path, content = tmp_path / "x.json", {"a": [1.5, None], DIGEST + " ": "6" * 64, "\ud800": {}}
    write_json(path, content)
    assert read_json(path, "test") == content
    data = path.read_bytes()
    assert json.loads(data)[DIGEST] == next(iter(json.loads(data).values()))
    for at in range(0, len(data), 3):
        flipped = bytearray(data)
        flipped[at] ^= 1 << at % 8
        path.write_bytes(flipped)
        with pytest.raises(DamagedFileError) as raised:
            read_json(path, "test")
        assert raised.value.path == path


def test_json_that_somebody_edited_is_read_without_its_digest(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"a": 1})
    path.write_text(path.read_text().replace('"a": 1', '"a": 2'))
    with pytest.raises(DamagedFileError, match="if you edited it, remove its field"):
        read_json(path, "test")
    path.write_text('{"a": 2}')
    assert read_json(path, "test") == {"a": 2}


def test_a_damaged_file_is_known_in_other_processes(tmp_path):
    path = tmp_path / "x.json"
    path.write_text("{")
    with pytest.raises(DamagedFileError) as raised:
        read_json(path, "text")
    error = pickle.loads(pickle.dumps(raised.value))
    assert (error.path, str(error)) == (path, str(raised.value))
