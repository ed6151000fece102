"""Numbered pictures get the times of their numbers even if some are missing."""

from pathlib import Path

import numpy as np
import pytest

from mapfusion.datasets.kitti import numbered_shots
from mapfusion.errors import InputError


def test_a_missing_number_leaves_the_others_their_times(tmp_path: Path) -> None:
    for number in (4, 0, 2):
        (tmp_path / f"{number:06d}.png").write_bytes(b"")
    (tmp_path / "0000000001.png").write_bytes(b"")  # of another layout
    times = np.array([10, 20, 30, 40, 50])
    shots = numbered_shots(tmp_path, 6, "left", times, tmp_path / "times.txt")
    assert [(shot.time_ns, shot.name) for shot in shots] == [
        (10, "left/000000.png"),
        (30, "left/000002.png"),
        (50, "left/000004.png"),
    ]
    with pytest.raises(InputError, match=r"times\.txt: has 4 times, none for .*000004\.png"):
        numbered_shots(tmp_path, 6, "left", times[:4], tmp_path / "times.txt")
    with pytest.raises(InputError, match="no such folder"):
        numbered_shots(tmp_path / "none", 6, "left", times, tmp_path / "times.txt")
