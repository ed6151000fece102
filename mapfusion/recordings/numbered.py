"""Pictures of one camera that are named by number, as KITTI's layouts have them."""

from pathlib import Path

import numpy as np

from mapfusion.errors import InputError
from mapfusion.recordings.pictures import PictureFile
from mapfusion.recordings.stereo_recording import Shot


def numbered_shots(
    folder: Path, digits: int, camera: str, time_ns: np.ndarray, times: Path
) -> list[Shot]:
    """The pictures 000...0.png, ... of a folder, each with the time that its number has.

    Args:
        folder: of the pictures.
        digits: of their names.
        camera: what it is called in messages.
        time_ns: (T,) int64 of the numbers 0 to T - 1.
        times: where these were read, for messages.

    Raises:
        InputError: there is no such folder, or a number has no time.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (pictures of a KITTI recording)")
    named = "[0-9]" * digits + ".png"
    pictures = {int(path.stem): path for path in sorted(folder.glob(named))}
    if not pictures:
        there = next((path.name for path in sorted(folder.iterdir()) if path.is_file()), "no file")
        named = f"{'0' * digits}.png, ..., expected of a KITTI recording; it holds {there}"
        raise InputError(f"{folder}: holds no picture named {named}")
    late = [number for number in pictures if number >= len(time_ns)]
    if late:
        raise InputError(f"{times}: has {len(time_ns)} times, none for {pictures[late[0]]}")
    return [
        Shot(int(time_ns[number]), f"{camera}/{path.name}", PictureFile(path))
        for number, path in pictures.items()
    ]
