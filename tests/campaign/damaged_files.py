"""Files damaged in every way, and of every kind.

Half of them have digests that fit, as if they had been written so, and meet the doors' own checks.
Each must be read, or give one line that names its file or its folder.
"""

import json
import random
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mapfusion.errors import InputError
from mapfusion.files import DIGEST, json_bytes
from tests.campaign.doors import Door, doors, doors_of_others
from tests.campaign.parts import Found

Random = random.Random


def _cut(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _without_a_piece(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + data[at + rng.randint(1, 100) :]


def _overwritten(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data))
    piece = rng.choice([b"\0" * 64, rng.randbytes(64), b"\xff" * 8, b"null"])
    return data[:at] + piece + data[at + len(piece) :]


def _added(data: bytes, rng: Random) -> bytes:
    return rng.choice([data + rng.randbytes(100), rng.randbytes(100) + data, data + data])


def _something_else(data: bytes, rng: Random) -> bytes:
    return rng.choice(
        [b"", b"null", b"[]", b"{}", b"PAR1", b"a,b\n1,2\n", rng.randbytes(len(data))]
    )


BYTES = (_cut, _without_a_piece, _overwritten, _added, _something_else)
_STRANGE: list[Any] = [None, -1, 1e300, "x", [], {}, [[1]], True, "\ud800", 10**30]


def _json(data: bytes, rng: Random) -> bytes:
    """An object with other values, and a digest that fits."""
    content = json.loads(data)
    del content[DIGEST]
    name = rng.choice(sorted(content))
    if rng.random() < 0.1:
        content["schema_version"] = rng.choice(_VERSIONS)
    elif rng.random() < 0.3:
        del content[name]
    else:
        content[name] = rng.choice(_STRANGE)
    return json_bytes(content)


def _table(data: bytes, rng: Random) -> bytes:
    """A table with other rows, columns, cells or metadata."""
    table = pq.read_table(pa.BufferReader(data))
    change: Callable[[pa.Table, Random], pa.Table] = rng.choice(
        [_other_rows, _other_column, _other_cells, _other_metadata]
    )
    stream = pa.BufferOutputStream()
    pq.write_table(change(table, rng), stream)
    return stream.getvalue().to_pybytes()


def _other_rows(table: pa.Table, rng: Random) -> pa.Table:
    rows = [rng.randrange(len(table)) for _ in range(rng.randrange(2 * len(table)))]
    return table.take(pa.array(rows, pa.int64()))


def _other_column(table: pa.Table, rng: Random) -> pa.Table:
    at = rng.randrange(table.num_columns)
    if rng.random() < 0.5:
        return table.remove_column(at)
    cells = pa.array([rng.choice(["x", "", "1"])] * len(table))
    return table.set_column(at, table.column_names[at], cells)


def _other_cells(table: pa.Table, rng: Random) -> pa.Table:
    at = rng.randrange(table.num_columns)
    field, cells = table.schema.field(at), table.column(at).to_pylist()
    strange = [None, 0, -1, 7]
    if pa.types.is_floating(field.type):
        strange += [np.nan, np.inf, -np.inf, 1e30, 1e-320, 1e300]
    if not (pa.types.is_integer(field.type) or pa.types.is_floating(field.type)):
        strange = [None]
    for _ in range(rng.randint(1, 3)):
        cells[rng.randrange(len(cells))] = rng.choice(strange)
    return table.set_column(at, field, pa.array(cells, field.type))


def _other_metadata(table: pa.Table, rng: Random) -> pa.Table:
    metadata = dict(table.schema.metadata)
    name = rng.choice(sorted(metadata))
    metadata[name] = rng.choice([b"", b"\xff\xfe", b"99", b"none", b"true"])
    if rng.random() < 0.3:
        del metadata[name]
    return table.replace_schema_metadata(metadata)


def _array(data: bytes, rng: Random) -> bytes:
    """An array with another header or other numbers."""
    body = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        body[rng.randrange(len(body))] = rng.randrange(256)
    return bytes(body)


def _text(data: bytes, rng: Random) -> bytes:
    """A file of text in which some words are others, or which is of another dialect."""
    if rng.random() < 0.3:
        return rng.choice(_DIALECTS)(data)
    words = re.split(rb"([ ,\n]+)", data)
    for _ in range(rng.randint(1, 3)):
        words[2 * rng.randrange(len(words) // 2)] = rng.choice(_WORDS)
    return b"".join(words)


_DIALECTS: list[Callable[[bytes], bytes]] = [
    lambda data: data.replace(b",", b";"),
    lambda data: data.replace(b",", b"\t"),
    lambda data: data.replace(b",", b", "),
    lambda data: data.replace(b".", b","),
    lambda data: data.replace(b"\n", b"\r\n"),
    lambda data: data.upper(),
    lambda data: data.partition(b"\n")[2],  # no header
    lambda data: b"\n".join(reversed(data.splitlines())),
    lambda data: b"\xef\xbb\xbf" + data,  # a mark of the order of bytes
    lambda data: data.decode().encode("utf-16"),
    lambda data: b"".join(b'"' + line + b'"\n' for line in data.splitlines()),
]
_WORDS = [*(b"", b"x", b"nan", b"inf", b"-1", b"0", b"1e300", b"-1e18", b"1e-320", b"\xff", b'"')]
_WORDS += [b"18446744073709551616", b"9223372036854775808", b"-9223372036854775809", b"1e9", b"1.5"]
_VERSIONS: list[Any] = [99, 0, -1, 2**64, "1", 1.0, True, None, [1]]
# Half of all damages: what was written so.
WRITTEN = {".json": _json, ".parquet": _table, ".npy": _array}
WRITTEN |= dict.fromkeys((".csv", ".dat", ".txt", ".tum", ".yaml"), _text)


def explore(seed: str, each: int, folder: Path) -> Found:
    """Damage every file so many times."""
    rng, counts, faults = Random(seed), Counter[str](), list[str]()
    for door in doors(folder) + doors_of_others(folder):
        whole = door.path.read_bytes()
        counts["kinds"] += 1
        for number in range(each):
            way = rng.choice(BYTES) if number % 2 else WRITTEN.get(door.path.suffix, _cut)
            door.path.write_bytes(way(whole, rng))
            counts["damaged"] += 1
            if wrong := _wrong(door):
                faults.append(f"{door.path.name}, {way.__name__}, number {number}: {wrong}")
        door.path.write_bytes(whole)
    return Found(counts, faults)


def _wrong(door: Door) -> str:
    try:
        door.read()
    except InputError as error:
        named = str(door.path.parent) in str(error) and "\n" not in str(error)
        return "" if named else f"is told without its file or in several lines: {error}"
    except Exception as error:
        return f"a traceback: {type(error).__name__} {error}"
    return ""
