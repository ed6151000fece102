"""Random generators for each purpose, and lists of seeds."""

import zlib

import numpy as np

from mapfusion.errors import InputError


def generator(seed: int, *purpose: str | int) -> np.random.Generator:
    """Return the generator for a purpose, for example ("odometry", "R1").

    Its numbers do not depend on other generators.
    """
    key = tuple(zlib.crc32(str(part).encode()) for part in purpose)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


MAX_SEEDS = 1000  # days of computation; more is probably a typing error


def parse_seeds(text: str) -> list[int]:
    """Parse `3`, `0..4` (both ends included) or `0,2,5`; raise InputError for other texts."""
    try:
        if ".." in text:
            first, last = (int(part) for part in text.split(".."))
            seeds = range(first, last + 1)[: MAX_SEEDS + 1]
        else:
            seeds = [int(part) for part in text.split(",")]
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise InputError(f"--seeds {text}: expected a number, a range 0..4 or a list 0,2,5")
    if len(seeds) > MAX_SEEDS:
        raise InputError(f"--seeds {text}: more than {MAX_SEEDS} seeds")
    return list(seeds)
