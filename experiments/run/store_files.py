"""Files that never change, at a second place."""

import shutil
from pathlib import Path

from mapfusion.sealed import read_sealed
from mapfusion.storage import write_whole


def link_or_copy(source: Path, target: Path) -> None:
    """Put a finished, immutable file at a second place without a second copy where possible.

    Raises:
        DamagedFileError: there is none, or it is not as it was written.
    """
    read_sealed(source, "finished file")

    def place(temporary: Path) -> None:
        temporary.unlink()
        try:
            temporary.hardlink_to(source)
        except OSError:
            shutil.copyfile(source, temporary)

    write_whole(target, place)
