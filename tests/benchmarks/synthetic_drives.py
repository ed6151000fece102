"""Synthetic drives with known truth: is every one smoothed, and do its errors obey the covariances?

    python -m tests.benchmarks.synthetic_drives --frames 100 300 1000 --seeds 10

The table gives, for each shape, length and odometry noise (as a multiple of the stated), the mean
NEES per degree of freedom over all seeds: of the landmarks, and of up to 100 poses of the path. The
frame is the first pose. Ends with 1 where a drive is not smoothed or a mean is outside its limits.
"""

import argparse
import sys
import time
from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, one_blas_thread
from mapfusion.geometry.se2 import compose, wrap
from mapfusion.smoother.elimination import memory_bytes
from mapfusion.smoother.smooth import Smoothed, SmootherParameters, smooth
from tests.helpers.synthetic_drives import SHAPES, Drive, drive

NOISES = (0.0, 0.1, 1.0, 5.0)
STRAY_M = 0.002
MOST_POSES = 100
LANDMARK_LIMITS, MOST_PATH = (0.5, 2.0), 2.0


class Nees(NamedTuple):
    """Mean NEES per degree of freedom of landmarks and poses."""

    landmark: float
    path: float


def reckoned(odometry: Float) -> Float:
    """Return the path (T, 3) by odometry alone."""
    path = np.zeros_like(odometry)
    for k in range(1, len(path)):
        path[k] = compose(path[k - 1], odometry[k])
    return path


def smoothed(driven: Drive, from_odometry: bool = False, max_memory_gb: float = np.inf) -> Smoothed:
    """Smooth a drive from the true path, which stands for a filter's, or from odometry alone."""
    label = driven.log.observations.label
    assert label is not None
    path = reckoned(driven.log.odometry) if from_odometry else driven.path
    return smooth(driven.log, label, path, SmootherParameters(stray_m=STRAY_M), max_memory_gb)


@one_blas_thread
def nees(driven: Drive, found: Smoothed) -> Nees:
    """Return how the errors compare with the covariances, in the frame of the first pose."""
    label = driven.log.observations.label
    assert label is not None
    true = driven.point_m[label[found.obs.row[found.obs.starts[:-1]]]]
    off = found.estimate.point_m - true
    of_landmarks = _mean_square(off, found.own_m2 + found.common.squares())
    frames = np.unique(np.linspace(1, len(driven.path) - 1, MOST_POSES).round().astype(int))
    off = (found.estimate.path - driven.path)[frames]
    off[:, 2] = wrap(off[:, 2])
    return Nees(of_landmarks, _mean_square(off, found.path_covariance[frames]))


def _mean_square(off: Float, covariance: Float) -> float:
    solved = np.linalg.solve(covariance, off[:, :, None])[:, :, 0]
    return float(np.mean(np.sum(off * solved, axis=1)) / 3)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 300, 1000])
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=list(SHAPES))
    parser.add_argument("--noise", type=float, nargs="+", default=NOISES)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--tracks", action="store_true", help="observations come in tracks")
    parser.add_argument("--from-odometry", action="store_true", help="start from odometry alone")
    asked = parser.parse_args()
    sys.stdout.write("shape     frames  noise  smoothed  landmarks   path  GB at most  s a drive\n")
    outside = 0
    for shape in asked.shapes:
        for n_frames in asked.frames:
            for noise in asked.noise:
                outside += _row(shape, n_frames, noise, asked)
    sys.stdout.write(f"{outside} rows outside the limits\n")
    return 1 if outside else 0


def _row(shape: str, n_frames: int, noise: float, asked: argparse.Namespace) -> bool:
    """Print one row; return True if it is outside the limits."""
    known, most_bytes, seconds = list[Nees](), 0.0, 0.0
    for seed in range(asked.seeds):
        stray_m = STRAY_M if asked.tracks else 0.0
        driven = drive(shape, n_frames, noise, seed, asked.tracks, stray_m)
        began = time.perf_counter()
        try:
            found = smoothed(driven, asked.from_odometry)
        except np.linalg.LinAlgError as error:
            sys.stdout.write(f"{shape} {n_frames} {noise:g} seed {seed}: {error}\n")
            continue
        seconds += time.perf_counter() - began
        most_bytes = max(most_bytes, memory_bytes(found.obs))
        known.append(nees(driven, found))
    landmark, path = np.mean(known, axis=0) if known else (np.nan, np.nan)
    sys.stdout.write(
        f"{shape:<9} {n_frames:>6} {noise:>6g} {len(known):>5}/{asked.seeds:<3} {landmark:>9.2f} "
        f"{path:>7.2f} {most_bytes / 1e9:>10.2f} {seconds / max(len(known), 1):>10.1f}\n"
    )
    sys.stdout.flush()
    least, most = LANDMARK_LIMITS if noise else (0.0, LANDMARK_LIMITS[1])
    inside = len(known) == asked.seeds and least <= landmark <= most and path <= MOST_PATH
    return not inside


if __name__ == "__main__":
    sys.exit(main())
