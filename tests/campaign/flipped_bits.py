"""Bits flipped in every kind of file.

Each flip must give the same values, or one line that names the file.
"""

import random
from collections import Counter
from pathlib import Path

from mapfusion.errors import InputError
from tests.campaign.doors import Door, doors, same
from tests.campaign.parts import Found

IN_FOOTERS = 3  # every third flip
_TAIL = 8  # bytes at a Parquet file's end: the length of the footer, and the magic number


def explore(seed: str, count: int, folder: Path) -> Found:
    """Flip so many bits, one at a time."""
    rng, counts, faults = random.Random(seed), Counter[str](), list[str]()
    known = [(door, door.read()) for door in doors(folder)]
    tables = [each for each in known if each[0].path.suffix == ".parquet"]
    for number in range(count):
        footer = number % IN_FOOTERS == 0
        door, before = rng.choice(tables if footer else known)
        data = door.path.read_bytes()
        first = _start_of_footer(data) if footer else 0
        at, bit = rng.randrange(first, len(data)), rng.randrange(8)
        flipped = bytearray(data)
        flipped[at] ^= 1 << bit
        door.path.write_bytes(flipped)
        counts.update(["flips", "in footers"] if footer else ["flips"])
        if wrong := _wrong(door, before):
            faults.append(f"{door.path.name}, bit {bit} of byte {at} of {len(data)}: {wrong}")
        door.path.write_bytes(data)
    return Found(counts, faults)


def _start_of_footer(data: bytes) -> int:
    """Return the offset of the Parquet footer, which holds names, types and offsets."""
    return len(data) - _TAIL - int.from_bytes(data[-_TAIL:][:4], "little")


def _wrong(door: Door, before: object) -> str:
    try:
        after = door.read()
    except InputError as error:
        named = str(door.path) in str(error) and "\n" not in str(error)
        return "" if named else f"is told without its file or in several lines: {error}"
    except Exception as error:
        return f"a traceback: {type(error).__name__} {error}"
    return "" if same(before, after) else "other values, without a word"
