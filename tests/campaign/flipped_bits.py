"""Bits flipped in every kind of file: `python -m tests.campaign.flipped_bits --seed 0`.

Each flip must give the same values, or one line that names the file.
"""

import argparse
import random
import sys
import tempfile
import warnings
from pathlib import Path

from mapfusion.errors import InputError, UnsealedWarning
from tests.campaign.doors import Door, doors, same

SHARE_IN_FOOTERS = 1 / 3
FOOTER = 0.3  # of a file, at its end: where Parquet keeps names, types, places


def flips(folder: Path, seed: int, count: int) -> list[str]:
    """What went wrong in `count` flips, one line each."""
    rng, found = random.Random(seed), list[str]()
    known = [(door, door.read()) for door in doors(folder)]
    for _ in range(count):
        door, before = rng.choice(known)
        data = door.path.read_bytes()
        first = (1 - FOOTER) if rng.random() < SHARE_IN_FOOTERS else 0
        at, bit = rng.randrange(int(first * len(data)), len(data)), rng.randrange(8)
        flipped = bytearray(data)
        flipped[at] ^= 1 << bit
        door.path.write_bytes(flipped)
        if wrong := _wrong(door, before):
            found.append(f"{door.path.name}, bit {bit} of byte {at} of {len(data)}: {wrong}")
        door.path.write_bytes(data)
    return found


def _wrong(door: Door, before: object) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnsealedWarning)
            after = door.read()
    except InputError as error:
        named = str(door.path) in str(error) and "\n" not in str(error)
        return "" if named else f"is told without its file or in several lines: {error}"
    except Exception as error:
        return f"a traceback: {type(error).__name__} {error}"
    return "" if same(before, after) else "other values, without a word"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=2000)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = flips(Path(folder), asked.seed, asked.count)
    sys.stdout.writelines(f"{line}\n" for line in [*found, f"{len(found)} of {asked.count} wrong"])
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
