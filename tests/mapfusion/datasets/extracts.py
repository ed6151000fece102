"""Extracts of public recordings in the folder MAPFUSION_RECORDINGS."""

import itertools
import os
from pathlib import Path

import numpy as np
import pytest

from mapfusion.datasets.stereo_import import RecordingPart
from mapfusion.geometry import se2

RECORDINGS = Path(os.environ.get("MAPFUSION_RECORDINGS", "none"))
WHOLE = RecordingPart("R1", slice(None))
needs_recordings = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="MAPFUSION_RECORDINGS is not set"
)


def laid_out_as_kitti(root: Path) -> Path:
    """Lay out `kitti_extract` as a KITTI sequence and return its folder."""
    extract, sequence = RECORDINGS / "kitti_extract", root / "sequences" / "06"
    sequence.mkdir(parents=True)
    for camera, name in enumerate(("image_l", "image_r")):
        (sequence / f"image_{camera}").symlink_to((extract / name).resolve())
    numbers = (extract / "calib.txt").read_text().split()
    lines = [f"P{k}: {' '.join(numbers[12 * k : 12 * k + 12])}" for k in (0, 1)]
    (sequence / "calib.txt").write_text("\n".join(lines))
    (sequence / "times.txt").write_text("\n".join(f"{0.1 * k:e}" for k in range(26)))
    (sequence / "poses.txt").write_text((extract / "poses.txt").read_text())
    return sequence


def dead_reckoned(odometry: np.ndarray) -> np.ndarray:
    """Return poses (T, 3) in the first frame."""
    return np.array(list(itertools.accumulate(odometry, se2.compose)))
