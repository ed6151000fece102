"""The parts of the campaign: how much each must have tried, and what does it."""

import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from experiments.pipeline.stage import use_kernel_cache

ROOM = 1.1  # of what the bar asks for: shares may fall short of theirs


class Found(NamedTuple):
    """Counts of what was tried, by what it was, and the faults, one line each."""

    counts: Counter[str]
    faults: list[str]


class Part(NamedTuple):
    """A part of the campaign.

    Attributes:
        least: how much must have been tried.
        shares: how many pieces it is done in, so that all processes have work.
        explore: does one piece, given its seed, its size as 1 / `shares`, and an empty folder.
    """

    least: dict[str, int]
    shares: int
    explore: Callable[[str, int, Path], Found]


def _scenarios(seed: str, shares: int, folder: Path) -> Found:
    from tests.campaign import mutated_scenarios

    return mutated_scenarios.explore(seed, 10_000 // shares, int(ROOM * 500) // shares, folder)


def _kills(seed: str, shares: int, folder: Path) -> Found:
    from tests.campaign import killed_runs

    return killed_runs.explore(seed, 100 // shares, folder)


def _plugins(seed: str, shares: int, folder: Path) -> Found:
    from tests.campaign import misbehaving_plugins

    return misbehaving_plugins.explore(folder)


def _damage(seed: str, shares: int, folder: Path) -> Found:
    from tests.campaign import damaged_files

    return damaged_files.explore(seed, 70, folder)


def _surroundings(seed: str, shares: int, folder: Path) -> Found:
    from tests.campaign import surroundings

    return surroundings.explore(seed, 40, folder)


def _flips(seed: str, shares: int, folder: Path) -> Found:
    from tests.campaign import flipped_bits

    return flipped_bits.explore(seed, 2000, folder)


# The longest first: what is left for the end is short.
PARTS = {
    "mutated_scenarios": Part({"mutants": 10_000, "run": 500}, 4, _scenarios),
    "killed_runs": Part({"kills": 100}, 2, _kills),
    "misbehaving_plugins": Part({"misbehaviours": 60}, 1, _plugins),
    "flipped_bits": Part({"flips": 2000, "in footers": 666}, 1, _flips),
    "surroundings": Part(
        {"tables deleted": 100, "versions": 18, "outputs": 40, "environments": 40}, 1, _surroundings
    ),
    "damaged_files": Part({"damaged": 1000}, 1, _damage),
}


def one_share(name: str, seed: str, folder: Path) -> tuple[Found, float]:
    """A piece of a part, and the seconds that it took."""
    use_kernel_cache()  # shared with the tests
    started = time.monotonic()
    folder.mkdir(parents=True)
    try:
        found = PARTS[name].explore(seed, PARTS[name].shares, folder)
    except Exception:  # what was not thought of is a finding too
        found = Found(Counter(), [traceback.format_exc()])
    return found, time.monotonic() - started
