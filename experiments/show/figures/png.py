"""Drawings as PNG."""

import struct
import zlib

import numpy as np

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_BITS, _COLOUR = 8, 2  # of a value, of which a pixel has three
_NO_FILTER = 0
_LEVEL = 2  # of compression, up to 9: more packs hardly better and takes several times as long
_INCH_M = 0.0254
_PER_METRE = 1  # how the resolution is given


def png(picture: np.ndarray, dpi: float) -> bytes:
    """A picture (H, W, 3) uint8 as a file's bytes.

    Pillow tries several filters on each row, which takes as long as to pack them: of lines and flat
    colours none makes less.
    """
    height, width, _ = picture.shape
    rows = np.full((height, 1 + 3 * width), _NO_FILTER, np.uint8)
    rows[:, 1:] = picture.reshape(height, 3 * width)
    per_metre = round(dpi / _INCH_M)
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, _BITS, _COLOUR, 0, 0, 0)),
        (b"pHYs", struct.pack(">IIB", per_metre, per_metre, _PER_METRE)),
        (b"IDAT", zlib.compress(rows.tobytes(), _LEVEL)),
        (b"IEND", b""),
    )
    return _SIGNATURE + b"".join(_chunk(kind, data) for kind, data in parts)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
