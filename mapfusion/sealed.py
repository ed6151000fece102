"""Files that carry a digest of themselves, so that no changed byte goes unseen.

A file of ours holds `mapfusion.sha256` and 64 hexadecimal digits: the SHA-256 of the whole file
with these digits as zeros. Where it stands is up to the format, always where other readers pass it
by: between the pages and the footer of Parquet (so that a table which another program reads and
writes again keeps no stale one), as the first field of JSON, behind the end of PNG, BMP and NPY, in
the first line of OBJ.
"""

import hashlib
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

from mapfusion.errors import DamagedFileError, UnsealedWarning

SEAL = "mapfusion.sha256"
NO_DIGEST = "0" * 64
LINE = f"{SEAL} {NO_DIGEST}\n".encode()  # an empty seal, for formats that pass over bytes or lines
_SEAL = re.compile(re.escape(SEAL.encode()) + rb'[": ]+(?=(.{64}))', re.DOTALL)
_PARQUET_TAIL = 8  # bytes: the length of the footer, and the magic number
_told: list[Path] = []  # the file that was said to carry no digest, once a process


def seal(data: bytes) -> bytes:
    """Fill in the digest of a file's bytes, which hold an empty seal."""
    return b"".join(sealed_pieces(data))


def sealed_pieces(data: bytes) -> tuple[memoryview, bytes, memoryview]:
    """The same as what comes before the digest, the digest, and what comes after."""
    empty, view = NO_DIGEST.encode(), memoryview(data)
    at = next(at for at in _digests(data) if view[at : at + len(empty)] == empty)
    return view[:at], hashlib.sha256(data).hexdigest().encode(), view[at + len(empty) :]


def _digests(data: bytes) -> Iterator[int]:
    """Where digests begin, from the last to the first: tables and pictures have theirs at the end.

    To look for a text from the end is also much faster than what a pattern's search is.
    """
    name, end = SEAL.encode(), len(data)
    while (end := data.rfind(name, 0, end)) >= 0:
        if match := _SEAL.match(data, end):
            yield match.start(1)


def is_intact(data: bytes) -> bool | None:
    """Whether a file's bytes are those that were sealed; None where they carry no seal.

    One seal that fits is enough: a text in a table may look like one.
    """
    found = None
    for at in _digests(data):
        digest = hashlib.sha256(memoryview(data)[:at])
        digest.update(NO_DIGEST.encode())
        digest.update(memoryview(data)[at + len(NO_DIGEST) :])
        if digest.hexdigest().encode() == data[at : at + len(NO_DIGEST)]:
            return True
        found = False
    return found


def carries_seal(data: bytes) -> bool:
    """Whether a file's bytes carry a seal, fitting or not."""
    return next(_digests(data), None) is not None


def read_sealed(path: Path, what: str, only_ours: bool = False) -> bytes:
    """A file's bytes, checked before anybody looks at them.

    Args:
        path: of the file.
        what: is expected there, for messages.
        only_ours: no other program writes such files: one without digest is damaged.

    Raises:
        DamagedFileError: it is missing, or not as it was written.
    """
    if not path.is_file():
        raise DamagedFileError(path, f"no such file (expected a {what})")
    data = path.read_bytes()
    intact = is_intact(data)
    if intact is False or (intact is None and only_ours):
        by_hand = f"or changed by other means: then take {SEAL} out of it"
        raise DamagedFileError(path, f"damaged, it does not fit its digest ({by_hand})")
    return data


def tell_unsealed(path: Path, data: bytes) -> None:
    """Warn, once a process, that a file which could be read is of unknown soundness."""
    if not _told and not carries_seal(data):
        _told.append(path)
        why = "made by another program or an earlier version, so damage to it may go unseen"
        text = f"{path}: carries no digest ({why}); said of the first such file alone"
        warnings.warn(text, UnsealedWarning, stacklevel=2)


def say_again() -> None:
    """Let `tell_unsealed` warn once more: a new command begins."""
    _told.clear()


def parquet_with_seal(data: bytes | memoryview) -> bytes:
    """A Parquet file with an empty seal in front of its footer, which points at nothing behind."""
    view = memoryview(data)
    footer = _PARQUET_TAIL + int.from_bytes(view[-_PARQUET_TAIL:][:4], "little")
    return b"".join((view[:-footer], LINE, view[-footer:]))
