"""Pictures of recordings as grey levels of 8 bit, whatever they were stored as."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mapfusion.errors import InputError

_BITS = 8
_SILENT = 0  # OpenCV's level of logging
_SAMPLED = 8  # pictures whose brightest level tells how many of 16 bits a camera uses

Load = Callable[[], np.ndarray]


@dataclass(frozen=True)
class PictureFile:
    """A picture on disk; calling it reads it as it is stored."""

    path: Path

    def __call__(self) -> np.ndarray:
        """(H, W) or (H, W, 3), uint8 or uint16; raises InputError."""
        try:
            data = np.frombuffer(self.path.read_bytes(), np.uint8)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{self.path}: cannot be read ({reason})") from error
        image = _decoded(data) if len(data) else None
        if image is None:
            raise InputError(f"{self.path}: damaged or no picture")
        if image.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self.path}: holds {image.dtype}, expected 8 or 16 bits a channel")
        return image


def _decoded(data: np.ndarray) -> np.ndarray | None:
    """None where it is no picture, of which OpenCV would say so on the terminal, too."""
    before = cv2.utils.logging.setLogLevel(_SILENT)
    try:
        return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(before)


def grey(image: np.ndarray) -> np.ndarray:
    """(H, W) of a picture in grey, or in colour in OpenCV's order (BGR, BGRA)."""
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return image[:, :, 0]
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)


def unused_bits(loads: Iterable[Load]) -> int:
    """By how much 16-bit levels are to be shifted right so that 8 bits hold the brightest seen."""
    brightest = max((int(grey(load()).max()) for load in loads), default=0)
    return max(brightest.bit_length() - _BITS, 0)


def sampled(n: int) -> list[int]:
    """Some of n pictures, evenly spread, the first and the last among them."""
    return sorted(set(np.linspace(0, n - 1, min(n, _SAMPLED)).astype(int).tolist()))


def eight_bit(image: np.ndarray, shift: int) -> np.ndarray:
    """Grey levels (H, W) uint8; 16-bit ones shifted, and what is brighter than 255 cut."""
    levels = grey(image)
    if levels.dtype == np.uint8:
        return levels
    return np.minimum(levels >> shift, 255).astype(np.uint8)
