"""One independent generator per purpose, the same whatever else is drawn, and in any order."""

import zlib

import numpy as np


def generator(seed: int, *purpose: str | int) -> np.random.Generator:
    """A generator for one purpose, for example ("odometry", "R1"), under the scenario's seed."""
    key = tuple(zlib.crc32(str(part).encode()) for part in purpose)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
