"""No bit of a file can change unseen, wherever it is."""

import hashlib
import pickle
import warnings

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mapfusion import files
from mapfusion.errors import DamagedFileError, UnsealedWarning
from mapfusion.files import (
    float_fields,
    read_json,
    read_parquet,
    read_table,
    schema,
    write_json,
    write_sealed,
    write_table,
)

THINGS = schema("test.things", 1, float_fields(["x_m", "y_m"]))


@pytest.fixture
def table(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "t.parquet"
    write_table(path, {"x_m": rng.normal(size=40), "y_m": rng.normal(size=40)}, THINGS, {"a": "b"})
    return path


@pytest.mark.filterwarnings("ignore::mapfusion.errors.UnsealedWarning")
def test_every_bit_of_a_table_is_guarded(table):
    data, before, seen = table.read_bytes(), read_table(table, THINGS), 0
    for at in range(len(data)):
        flipped = bytearray(data)
        flipped[at] ^= 1 << at % 8
        table.write_bytes(flipped)
        try:
            after = read_table(table, THINGS)
        except DamagedFileError as error:
            seen += error.path == table
        else:  # the mark of the seal was hit: then nothing else was
            seen += after[0].equals(before[0]) and after[1] == before[1]
    assert seen == len(data)


def test_the_digest_is_that_of_the_file_with_zeros_in_its_place(table):
    data = table.read_bytes()
    assert data.count(files.SEAL.encode()) == 1
    at = data.index(files.SEAL.encode()) + len(files.SEAL) + 1
    empty = data[:at] + b"0" * 64 + data[at + 64 :]
    assert hashlib.sha256(empty).hexdigest().encode() == data[at : at + 64]


def test_pages_carry_checksums_and_others_can_read_and_write_the_table_again(table, tmp_path):
    assert len(pd.read_parquet(table)) == 40
    again = tmp_path / "again.parquet"
    pq.write_table(pq.read_table(table), again)  # keeps our metadata, but no digest of other bytes
    assert read_table(again, THINGS)[0].equals(read_table(table, THINGS)[0])
    data, column = bytearray(table.read_bytes()), pq.read_metadata(table).row_group(0).column(0)
    begin = column.dictionary_page_offset or column.data_page_offset
    data[begin + column.total_compressed_size - 1] ^= 1  # the last byte of the column's last page
    with pytest.raises(OSError, match="CRC"):
        pq.read_table(pa.BufferReader(bytes(data)), page_checksum_verification=True)


def test_without_a_digest_the_checksums_of_pages_tell_of_damage(table, tmp_path):
    path = tmp_path / "of_others.parquet"
    pq.write_table(pq.read_table(table), path, write_page_checksum=True, compression="none")
    data, column = bytearray(path.read_bytes()), pq.read_metadata(path).row_group(0).column(0)
    begin = column.dictionary_page_offset or column.data_page_offset
    data[begin + column.total_compressed_size - 1] ^= 1
    path.write_bytes(data)
    with pytest.raises(DamagedFileError, match="CRC"):
        read_parquet(path, "table")


def test_what_only_looks_like_a_seal_does_no_harm(tmp_path):
    path = tmp_path / "x.json"
    text = f'{files.SEAL}": "{"5" * 64}'
    write_json(path, {"text": text, files.SEAL + " ": "6" * 64})
    assert read_json(path, "test") == {"text": text, files.SEAL + " ": "6" * 64}
    path.write_bytes(path.read_bytes().replace(b"555", b"565", 1))
    with pytest.raises(DamagedFileError):
        read_json(path, "test")


@pytest.mark.parametrize("text", ["null", "[1]", "3", '{"a": ', "\xff", "[" * 100_000])
def test_json_that_is_no_object(text, tmp_path):
    path = tmp_path / "x.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DamagedFileError, match=r"x\.json: .*expected a test"):
        read_json(path, "test")


def test_without_a_digest_it_is_said_once(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_told", [])
    for name in ("a.parquet", "b.parquet"):
        pd.DataFrame({"x_m": [1.0]}).to_parquet(tmp_path / name)
    with pytest.warns(UnsealedWarning, match=r"a\.parquet: carries no digest"):
        assert read_parquet(tmp_path / "a.parquet", "table").num_rows == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_parquet(tmp_path / "b.parquet", "table").num_rows == 1
    with pytest.raises(DamagedFileError):  # of a kind that no other program writes
        files.read_sealed(tmp_path / "a.parquet", "table", only_ours=True)


def test_a_damaged_file_is_known_in_other_processes(tmp_path):
    path = tmp_path / "x.txt"
    write_sealed(path, files.LINE + b"text")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DamagedFileError) as raised:
        files.read_sealed(path, "text")
    error = pickle.loads(pickle.dumps(raised.value))
    assert (error.path, str(error)) == (path, str(raised.value))
    assert "damaged" in str(error)
