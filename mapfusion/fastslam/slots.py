"""The landmarks of all particles, side by side: what the kernels read and write."""

from typing import NamedTuple

import numpy as np

from mapfusion.robot_log import DESCRIPTOR_LENGTH, NO_LABEL

NEVER = -1  # the generation of a free slot


class Slots(NamedTuple):
    """Landmark-major state of S slots and M particles. Rows of free slots mean nothing."""

    mean_m: np.ndarray  # (S, M, 3)
    covariance_m2: np.ndarray  # (S, M, 6) upper entries
    count: np.ndarray  # (S, M) int32 observations; 0: the particle does not have it
    generation: np.ndarray  # (S,) in which the particle axis was written; NEVER: free
    source: np.ndarray  # (S,) the observation it came from
    box_m: np.ndarray  # (S, 4) min_x, min_y, max_x, max_y of mean and gate over all particles
    descriptor: np.ndarray  # (S, 64) float32
    label: np.ndarray  # (S,) int32


def allocate(capacity: int, n_particles: int) -> Slots:
    """Free slots."""
    return Slots(
        np.empty((capacity, n_particles, 3)),
        np.empty((capacity, n_particles, 6)),
        np.empty((capacity, n_particles), dtype=np.int32),
        np.full(capacity, NEVER, dtype=np.int64),
        np.full(capacity, NEVER, dtype=np.int64),
        np.empty((capacity, 4)),
        np.full((capacity, DESCRIPTOR_LENGTH), np.nan, dtype=np.float32),
        np.full(capacity, NO_LABEL, dtype=np.int32),
    )
